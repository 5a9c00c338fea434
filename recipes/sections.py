"""The sections that configurations are made of: one dataclass each, checked before anything runs.

The YAML files under ``configs/`` hold what differs between choices; a key that is not a field here is an error.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from typing import Any, ClassVar

DEFAULT_SCALE = "default"
"""The value of ``map.action_scale`` that stands for the default of the kind of map."""

MOST_THREADS = 1_024
"""Limit of a task's threads, each with its own simulation, as configurations may come from strangers."""


def path_field(default: str | None) -> Any:
    """A field that holds a path: on the command line it may hold any character, and ``~`` is the user's home."""
    return field(default=default, metadata={"path": True})


@dataclass
class EnvConfig:
    """Which task, and how many copies of it."""

    name: str = "wam_wipe"  # of the table of tasks, or where it is: my_package.tasks:Pour
    suite: str = "nht"  # whose task it is: nht, dm_control, gymnasium or torchrl
    context_keys: list[str] | None = None  # what a map sees, in order; None is what the task says
    num_envs: int | None = None  # copies; None is what the algorithm says
    num_threads: int = 1  # native threads that share the copies of a task of ours
    options: dict[str, Any] = field(default_factory=dict)  # of the task itself, in training and in evaluation

    def __post_init__(self) -> None:
        """Raise ValueError for a task without a name, or more threads than any machine has."""
        if not self.name:
            raise ValueError(
                f"env.name must name a task of {self.suite}, for torchrl what makes it: "
                "env.name=my_package.robots:make."
            )
        if not 1 <= self.num_threads <= MOST_THREADS:
            raise ValueError(f"env.num_threads must be in 1 ... {MOST_THREADS}, got {self.num_threads}.")


@dataclass
class DemosConfig:
    """Where demonstrations come from: a folder, or else the task's scripted expert."""

    path: str | None = path_field(None)  # folder that collect_demos wrote; None asks the expert
    transitions: int = 20_000  # how many the expert or policy gives, in whole episodes
    speed: float | None = None  # of the expert's tool [m/s]; None is its default
    disturbance: float = 0.0  # deviation of noise on the motors, while the expert's own answer is recorded
    max_episode_steps: int = 1_000  # a demonstration ends at success, long before
    min_return: float | None = None  # of an episode worth keeping

    def __post_init__(self) -> None:
        """Raise ValueError for a negative disturbance."""
        if not 0 <= self.disturbance < math.inf:
            raise ValueError(f"demos.disturbance must be at least 0, got {self.disturbance}.")


@dataclass
class AlgoDemosConfig:
    """Which of the run's demonstrations an algorithm learns from, too."""

    transitions: int = 0  # how many, from the first on; 0 is none
    cloning_start: int = 0  # gradient steps in which the actor imitates them before anything else

    def __post_init__(self) -> None:
        """Raise ValueError for a number that is none, or nothing to imitate."""
        for name in ("transitions", "cloning_start"):
            if getattr(self, name) < 0:
                raise ValueError(f"algo.demos.{name} must be at least 0, got {getattr(self, name)}.")
        if self.cloning_start and not self.transitions:
            raise ValueError(
                f"algo.demos.cloning_start={self.cloning_start} imitates demonstrations: set algo.demos.transitions, "
                "too."
            )


@dataclass
class ReplayDemosConfig(AlgoDemosConfig):
    """Demonstrations that an algorithm with a replay buffer replays like steps of its own."""

    share: float = 0.0  # of each minibatch, from a buffer of their own; 0 puts them into the replay buffer

    def __post_init__(self) -> None:
        """Raise ValueError for a number or share that is none."""
        super().__post_init__()
        if not 0 <= self.share < 1:
            raise ValueError(f"algo.demos.share must lie in [0, 1), got {self.share}.")
        if self.share and not self.transitions:
            raise ValueError(
                f"algo.demos.share={self.share} is a share of demonstrations: set algo.demos.transitions, too."
            )


@dataclass
class SourceConfig:
    """Where ``collect_demos`` takes demonstrations from. Keys may be nested: ``info/goal``."""

    kind: str = "expert"  # expert, policy, minari, hdf5 or tensordict
    path: str | None = path_field(None)  # run folder; Minari id, folder or file; HDF5 file; TensorDict folder
    env: str | None = None  # the task's name there, where it is not ours
    context: dict[str, str] = field(default_factory=dict)  # {our name: its key there}; none: observations
    actuation_key: str | None = None  # hdf5, tensordict: None is "actions" and "action"
    episode_key: str | None = None  # hdf5, tensordict: integers that differ between episodes
    allow: list[str] = field(default_factory=list)  # policy: packages whose code the run may name
    relabel: bool = (
        False  # policy: record what the expert would do where the policy goes, and where it goes itself
    )
    done_key: str | None = None  # hdf5, tensordict: true at an episode's last step; None takes the usual ones


@dataclass
class MapConfig:
    """Which action map, and how it is trained."""

    kind: str = "nht"  # of the table of kinds, or where it is: my_package.maps:TwoSided
    file: str | None = path_field(None)  # a saved map; None trains one from the demonstrations
    allow: list[str] = field(default_factory=list)  # packages whose classes a map file may name
    args: dict[str, Any] = field(default_factory=dict)  # further arguments of the kind's own
    action_dim: int = 2  # k: how many numbers an action is
    hidden: list[int] = field(default_factory=lambda: [256, 256])  # widths of the network's hidden layers
    activation: str = "tanh"  # of the hidden layers: tanh, relu or sigmoid
    multi_head: bool = False  # nht: each reflection has a last hidden layer of its own
    offset: str = "none"  # nht, scl, svd: constant or contextual, the actuation of no action
    start: str = "svd"  # nht: training starts from the plane that SVD finds; or random
    lipschitz: float | None = None  # bound L on the whole map; None leaves it free
    lipschitz_per_layer: bool = False  # L bounds each layer instead, if there is a bound
    learning_rate: float = 1e-3  # of the map's training
    batch_size: int = 256  # transitions in a gradient step
    max_steps: int = 6_000  # gradient steps, at most
    beta_kl: float = 1e-3  # laser: weight of the KL divergence of its latents
    beta_dynamics: float = 1e-3  # laser: weight of predicting the next context
    residual: float | None = None  # adds n corrections to the action, each worth this much actuation
    saturation: str | None = None  # at the motors' limits: scale or clip; None is what the map says
    # what an action of 1 is worth: a number, null for the demonstrations' largest action, or what the kind says
    action_scale: Any = DEFAULT_SCALE

    def __post_init__(self) -> None:
        """Raise ValueError for corrections without a positive size, or an invalid action scale."""
        if self.residual is not None and not self.residual > 0:
            raise ValueError(
                f"map.residual must be positive, or null for no corrections, got {self.residual}."
            )
        scale = self.action_scale
        if scale is None or scale == DEFAULT_SCALE:
            return
        if isinstance(scale, bool) or not isinstance(scale, int | float) or not 0 < scale < math.inf:
            raise ValueError(
                "map.action_scale must be a positive, finite number, null for the demonstrations' largest action, or "
                f"{DEFAULT_SCALE!r}, got {scale!r}."
            )

    @property
    def scale_is_set(self) -> bool:
        """Whether ``action_scale`` was set, null included."""
        return self.action_scale != DEFAULT_SCALE


@dataclass
class AlgoConfig:
    """Settings of every algorithm: how many environment steps in all, and between two rounds of updates.

    ``varies`` names the settings in which learners that train together may differ; empty if they cannot train together.
    """

    varies: ClassVar[tuple[str, ...]] = ()

    total_frames: int = 100_000  # environment steps of the whole run, of all copies together
    frames_per_batch: int = 200  # environment steps between two rounds of updates
    num_envs: int = 10  # copies of the task that the settings were found with
    lasting_failures: bool = False  # a failure does not end an episode of training: it lasts


@dataclass
class CollectorConfig:
    """Which processes step the copies of the task."""

    kind: str = "single"  # this one; or multi_sync, multi_async: workers beside it
    num_workers: int = 1  # of each learner, which share its copies

    def __post_init__(self) -> None:
        """Raise ValueError for an unknown kind of collector, or a number of workers that it cannot have."""
        if self.kind not in ("single", "multi_sync", "multi_async"):
            raise ValueError(f"collector.kind must be single, multi_sync or multi_async, got {self.kind!r}.")
        if self.num_workers < 1:
            raise ValueError(f"collector.num_workers must be at least 1, got {self.num_workers}.")
        if self.kind == "single" and self.num_workers != 1:
            raise ValueError(
                f"collector=single has no workers, got collector.num_workers={self.num_workers}: "
                "choose collector=multi_sync or multi_async."
            )


@dataclass
class EvaluationConfig:
    """Settings of test episodes, which are deterministic and have their own environments and seeds."""

    every: int = 10_000  # frames between two evaluations
    episodes: int = 100  # in each, one copy of the task for every episode
    final_episodes: int | None = None  # in the last one; None is as many
    video: bool = True  # film the final policy
    video_every: int | None = (
        None  # frames between films on the way, at evaluations; None films the end alone
    )


@dataclass
class ChartsConfig:
    """What is written to Weights and Biases."""

    wandb: bool = True  # also write a Weights and Biases run: offline, unless you have logged in
    wandb_project: str = "nht"  # where it stands there
    wandb_name: str | None = None  # and under which name; None is that of its folder
    wandb_group: str | None = None  # and with which others
    wandb_job_type: str | None = None  # and as what; None is the recipe's name
    wandb_tags: list[str] = field(default_factory=list)  # to find it by
    wandb_notes: str | None = None  # a sentence about it


@dataclass
class RunConfig(ChartsConfig):
    """Where a run writes, and whether it resumes a run that it finds there."""

    folder: str = path_field("")  # of this run alone
    resume: Any = False  # true, or auto: go on if the folder holds a run, else begin
    checkpoint_every: int = 50_000  # frames
    wandb_every: int | None = (
        None  # frames between two rows of losses and rates; None is evaluation.every / 10
    )

    def __post_init__(self) -> None:
        """Raise ValueError for an unknown value of ``resume``."""
        if self.resume not in (True, False, "auto"):
            raise ValueError(f"run.resume must be true, false or auto, got {self.resume!r}.")


@dataclass
class Training:
    """All settings of a run: an algorithm on a task, through an action map."""

    env: EnvConfig = field(default_factory=EnvConfig)
    demos: DemosConfig = field(default_factory=DemosConfig)
    map: MapConfig = field(default_factory=MapConfig)
    algo: AlgoConfig = field(default_factory=AlgoConfig)
    collector: CollectorConfig = field(default_factory=CollectorConfig)
    evaluation: EvaluationConfig = field(default_factory=EvaluationConfig)
    run: RunConfig = field(default_factory=RunConfig)
    seed: int = 0  # of every random draw
    seeds: int | None = None  # learners to train together, of seed, seed + 1 ..., each in a folder of its own
    device: str = "cpu"  # where networks and batches are: cpu, cuda or cuda:1
    torch_threads: int = 1  # of each process
    tf32: bool = False  # on a GPU, whether float32 matrix products keep 10 bits of each factor, for speed

    def __post_init__(self) -> None:
        """Raise ValueError for settings that do not go together."""
        if self.env.num_envs is None:
            self.env.num_envs = self.algo.num_envs
        frames = {
            "algo.total_frames": self.algo.total_frames,
            "evaluation.every": self.evaluation.every,
            "run.checkpoint_every": self.run.checkpoint_every,
        }
        more = {
            "run.wandb_every": self.run.wandb_every,
            "evaluation.video_every": self.evaluation.video_every,
        }
        frames |= {name: value for name, value in more.items() if value is not None}
        for name, value in frames.items():
            if value < self.algo.frames_per_batch or value % self.algo.frames_per_batch:
                raise ValueError(
                    f"{name} must be a multiple of algo.frames_per_batch={self.algo.frames_per_batch}, got {value}."
                )
        if (films := self.evaluation.video_every) is not None and films % self.evaluation.every:
            raise ValueError(
                f"evaluation.video_every must be a multiple of evaluation.every={self.evaluation.every}, got {films}."
            )
        if self.evaluation.every > self.algo.total_frames:
            raise ValueError(
                f"evaluation.every={self.evaluation.every} must be at most algo.total_frames="
                f"{self.algo.total_frames}: a run without an evaluation has nothing to show."
            )
        if self.env.num_envs % self.collector.num_workers:
            raise ValueError(
                f"env.num_envs={self.env.num_envs} must be a multiple of "
                f"collector.num_workers={self.collector.num_workers}: every worker steps as many copies."
            )
        if self.algo.frames_per_batch % self.env.num_envs:
            raise ValueError(
                f"algo.frames_per_batch={self.algo.frames_per_batch} must be a multiple of "
                f"env.num_envs={self.env.num_envs}: every copy makes the same number of steps."
            )

    @property
    def charted_every(self) -> int:
        """Environment steps between two rows of losses and rates on the dashboard."""
        if self.run.wandb_every is not None:
            return self.run.wandb_every
        batch = self.algo.frames_per_batch
        return max(batch, self.evaluation.every // 10 // batch * batch)
