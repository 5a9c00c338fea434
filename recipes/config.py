"""What each recipe can be told: one dataclass per command, checked before anything runs.

The YAML files under ``configs/`` hold the values; a key that is not a field here is an error.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any


@dataclass
class EnvConfig:
    """Which task, and how many copies of it."""

    name: str = "wam_wipe"
    suite: str = "nht"  # whose task it is: nht, dm_control or gymnasium
    context_keys: list[str] = field(default_factory=list)  # what a map sees, in order
    num_envs: int = 10
    num_threads: int = 1
    options: dict[str, Any] = field(default_factory=dict)  # of the task itself, in training and in evaluation


@dataclass
class DemosConfig:
    """Where demonstrations come from: a folder, or else the task's scripted expert."""

    path: str | None = None
    transitions: int = 20_000
    speed: float | None = None  # of the expert's tool [m/s]; None is its default
    max_episode_steps: int = 1_000  # a demonstration ends at success, long before
    min_return: float | None = None  # of an episode worth keeping


@dataclass
class SourceConfig:
    """What ``collect_demos`` makes demonstrations from. Keys may be nested: ``info/goal``."""

    kind: str = "expert"  # expert, policy, minari, hdf5 or tensordict
    path: str | None = None  # run folder; Minari id, folder or file; HDF5 file; TensorDict folder
    env: str | None = None  # the task's name there, where it is not ours
    context: dict[str, str] = field(default_factory=dict)  # {our name: its key there}; none: observations
    actuation_key: str | None = None  # hdf5, tensordict: None is "actions" and "action"
    episode_key: str | None = None  # hdf5, tensordict: integers that differ between episodes
    done_key: str | None = None  # hdf5, tensordict: true at an episode's last step; None takes the usual ones


@dataclass
class MapConfig:
    """Which action map, and how it is trained."""

    kind: str = "nht"  # nht, scl, laser, cae, svd, jacobian or none (raw actuation)
    file: str | None = None  # a saved map; None trains one from the demonstrations
    action_dim: int = 2
    hidden: list[int] = field(default_factory=lambda: [256, 256])
    activation: str = "tanh"
    multi_head: bool = False  # nht: each reflection has a last hidden layer of its own
    lipschitz: float | None = None  # bound L on the whole map; None leaves it free
    lipschitz_per_layer: bool = False  # L bounds each layer instead, if there is a bound
    learning_rate: float = 1e-3
    batch_size: int = 256
    max_steps: int = 6_000
    beta_kl: float = 1e-3  # laser: weight of the KL divergence of its latents
    beta_dynamics: float = 1e-3  # laser: weight of predicting the next context
    residual: float | None = None  # adds n corrections to the action, each worth this much actuation
    action_scale: float | None = 1.0  # actuation per unit of action; None takes the demonstrations' largest

    def __post_init__(self) -> None:
        """Raise ValueError for corrections without a positive size."""
        if self.residual is not None and not self.residual > 0:
            raise ValueError(
                f"map.residual must be positive, or null for no corrections, got {self.residual}."
            )


@dataclass
class AlgoConfig:
    """What every algorithm has: how many environment steps, and how many of them between two rounds of updates."""

    total_frames: int = 100_000
    frames_per_batch: int = 200


@dataclass
class DDPGConfig(AlgoConfig):
    """DDPG's settings; those of the paper are ``algo=ddpg_paper``."""

    updates_per_batch: int = 20
    warmup_frames: int = 2_000  # collected before the first update
    random_frames: int = 0  # the first ones, whose actions are uniform
    batch_size: int = 256
    buffer_size: int = 1_000_000
    hidden: list[int] = field(default_factory=lambda: [256, 256])
    actor_learning_rate: float = 1e-3
    critic_learning_rate: float = 1e-3
    gamma: float = 0.98
    n_steps: int = (
        1  # rewards that a target adds up before it trusts the critic, within a batch of the collector
    )
    polyak: float = 0.96  # share of the old target network that stays at each move
    target_update_every: int = 1  # gradient steps between two moves of the target networks
    action_l2: float = 0.05  # weight of the mean squared action in the actor's loss
    exploration_noise: float = 0.3  # standard deviation; actions lie in [-1, 1]
    noise_memory: float = 10.0  # steps after which the noise has forgotten itself; 1 is white noise
    random_action: float = 0.1  # probability of a uniform action instead
    pessimism: float = 0.8  # the critic starts at this times the lowest return that is possible
    observation_clip: float = 5.0  # of the normalised observation
    bfloat16: bool = False  # the precision of hidden layers' matrix products; weights stay float32

    def __post_init__(self) -> None:
        """Raise ValueError for a value outside its range."""
        if not 0 < self.gamma < 1:
            raise ValueError(f"algo.gamma must lie in (0, 1), got {self.gamma}.")
        for name in ("polyak", "random_action", "pessimism"):
            if not 0 <= getattr(self, name) <= 1:
                raise ValueError(f"algo.{name} must lie in [0, 1], got {getattr(self, name)}.")
        counts = ("total_frames", "frames_per_batch", "n_steps", "batch_size", "buffer_size")
        for name in (*counts, "target_update_every"):
            if getattr(self, name) < 1:
                raise ValueError(f"algo.{name} must be at least 1, got {getattr(self, name)}.")
        for name in ("action_l2", "exploration_noise", "updates_per_batch", "warmup_frames", "random_frames"):
            if getattr(self, name) < 0:
                raise ValueError(f"algo.{name} must not be negative, got {getattr(self, name)}.")
        if self.noise_memory < 1:
            raise ValueError(f"algo.noise_memory must be at least 1 step, got {self.noise_memory}.")


@dataclass
class PPOConfig(AlgoConfig):
    """PPO's settings; those of OpenAI's ppo2, which the paper ran, are ``algo=ppo_paper``."""

    total_frames: int = 1_003_520
    frames_per_batch: int = 2_048  # steps per update, of all copies together
    epochs: int = 10  # times that a batch is gone through
    minibatches: int = 16  # gradient steps in an epoch
    hidden: list[int] = field(default_factory=lambda: [256, 256])  # of the actor, and of the critic
    activation: str = "relu"  # or tanh
    initial_std: float = 0.135  # of the actions, of which the task sees those in [-1, 1]
    learning_rate: float = 3e-4
    decay_learning_rate: bool = True  # linearly, to 0 at total_frames
    gamma: float = 0.98
    lmbda: float = 0.92  # GAE's lambda
    clip: float = 0.1  # of the ratio of probabilities
    clip_value: bool = False  # holds the critic within clip of its old values, too
    critic_coeff: float = 0.58  # weight of the critic's mean squared error
    entropy_coeff: float = 4e-4
    max_grad_norm: float = 0.8
    observation_clip: float = 10.0  # of the normalised observation
    reward_clip: float = 10.0  # of the reward over the deviation of discounted returns

    def __post_init__(self) -> None:
        """Raise ValueError for a value outside its range."""
        for name in ("gamma", "lmbda"):
            if not 0 < getattr(self, name) <= 1:
                raise ValueError(f"algo.{name} must lie in (0, 1], got {getattr(self, name)}.")
        for name in ("total_frames", "frames_per_batch", "epochs", "minibatches"):
            if getattr(self, name) < 1:
                raise ValueError(f"algo.{name} must be at least 1, got {getattr(self, name)}.")
        for name in ("learning_rate", "clip", "initial_std", "max_grad_norm", "reward_clip"):
            if not getattr(self, name) > 0:
                raise ValueError(f"algo.{name} must be positive, got {getattr(self, name)}.")
        for name in ("critic_coeff", "entropy_coeff"):
            if getattr(self, name) < 0:
                raise ValueError(f"algo.{name} must not be negative, got {getattr(self, name)}.")
        if self.activation not in ("tanh", "relu"):
            raise ValueError(f"algo.activation must be tanh or relu, got {self.activation!r}.")
        if self.frames_per_batch % self.minibatches:
            raise ValueError(
                f"algo.frames_per_batch={self.frames_per_batch} must be a multiple of "
                f"algo.minibatches={self.minibatches}: all minibatches are of one size."
            )
        if self.frames_per_batch == self.minibatches:
            raise ValueError(
                f"algo.minibatches={self.minibatches} must be less than algo.frames_per_batch: "
                "advantages are normalised within a minibatch, which takes two steps at least."
            )


@dataclass
class CollectorConfig:
    """Which processes step the copies."""

    kind: str = "single"  # this one; or multi_sync, multi_async: workers beside it
    num_workers: int = 1  # of each learner, which share its copies

    def __post_init__(self) -> None:
        """Raise ValueError for an unknown kind, or a number of workers that does not go with it."""
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
    """Deterministic episodes on environments and seeds of their own."""

    every: int = 10_000  # frames between two evaluations
    episodes: int = 100
    video: bool = True  # of the final policy


@dataclass
class RunConfig:
    """Where a run writes, and whether it goes on from what it finds there."""

    folder: str = ""
    resume: Any = False  # true, or auto: go on if the folder holds a run, else begin
    checkpoint_every: int = 50_000  # frames
    wandb: bool = True
    wandb_project: str = "nht"
    wandb_group: str | None = None
    wandb_job_type: str | None = None

    def __post_init__(self) -> None:
        """Raise ValueError for another way to resume."""
        if self.resume not in (True, False, "auto"):
            raise ValueError(f"run.resume must be true, false or auto, got {self.resume!r}.")


@dataclass
class CollectDemos:
    """``python -m nht.recipes.collect_demos``."""

    env: EnvConfig = field(default_factory=EnvConfig)
    demos: DemosConfig = field(default_factory=DemosConfig)
    source: SourceConfig = field(default_factory=SourceConfig)
    seed: int = 0
    out: str = ""


@dataclass
class InspectDemos:
    """``python -m nht.recipes.inspect_demos PATH``."""

    demos: str = ""  # folder of demonstrations, or what source.path of collect_demos may be
    directions: int = 10  # global directions whose energy is shown, at most
    out: str | None = None  # of the figure; None puts it beside the demonstrations


@dataclass
class TrainMap:
    """``python -m nht.recipes.train_map``."""

    env: EnvConfig = field(default_factory=EnvConfig)
    demos: DemosConfig = field(default_factory=DemosConfig)
    map: MapConfig = field(default_factory=MapConfig)
    align: str | None = None  # tool: action axis 1 moves the arm's tool along x, 2 along y, 3 along z
    seed: int = 0
    device: str = "cpu"
    out: str = ""

    def __post_init__(self) -> None:
        """Raise ValueError for an alignment that does not exist."""
        if self.align not in (None, "tool"):
            raise ValueError(f"align must be tool, or null for axes as they come out, got {self.align!r}.")


@dataclass
class Training:
    """A run of an algorithm on a task, through an action map."""

    env: EnvConfig = field(default_factory=EnvConfig)
    demos: DemosConfig = field(default_factory=DemosConfig)
    map: MapConfig = field(default_factory=MapConfig)
    algo: AlgoConfig = field(default_factory=AlgoConfig)
    collector: CollectorConfig = field(default_factory=CollectorConfig)
    evaluation: EvaluationConfig = field(default_factory=EvaluationConfig)
    run: RunConfig = field(default_factory=RunConfig)
    seed: int = 0
    device: str = "cpu"
    torch_threads: int = 1

    def __post_init__(self) -> None:
        """Raise ValueError for settings that do not go together."""
        frames = {"algo.total_frames": self.algo.total_frames, "evaluation.every": self.evaluation.every}
        frames["run.checkpoint_every"] = self.run.checkpoint_every
        for name, value in frames.items():
            if value < self.algo.frames_per_batch or value % self.algo.frames_per_batch:
                raise ValueError(
                    f"{name} must be a multiple of algo.frames_per_batch={self.algo.frames_per_batch}, got {value}."
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


@dataclass
class DDPG(Training):
    """``python -m nht.recipes.ddpg``."""

    algo: DDPGConfig = field(default_factory=DDPGConfig)


@dataclass
class PPO(Training):
    """``python -m nht.recipes.ppo``."""

    algo: PPOConfig = field(default_factory=PPOConfig)


@dataclass
class Evaluate:
    """``python -m nht.recipes.evaluate``."""

    run: str = ""  # folder of a finished run
    episodes: int = 100
    seed: int = 1_000_000
    video: bool = True
    video_episodes: int = 6
    env_options: dict[str, Any] = field(default_factory=dict)  # laid over those of the run


@dataclass
class CompareMaps:
    """``python -m nht.recipes.compare_maps``."""

    env: EnvConfig = field(default_factory=EnvConfig)
    demos: DemosConfig = field(default_factory=DemosConfig)
    map: MapConfig = field(default_factory=MapConfig)  # what all maps have in common
    maps: list[str] = field(default_factory=lambda: ["nht", "laser", "svd", "scl"])
    action_dims: list[int] = field(default_factory=lambda: [1, 2, 3])
    seed: int = 0
    out: str = ""


@dataclass
class SearchConfig:
    """What is searched: interfaces x configurations x seeds, each a run of a recipe."""

    recipe: str = "ddpg"
    env: str = "wam_wipe"
    action_dim: int = 2  # of learned maps
    metric: str = "success"  # or return: of a run's last evaluation
    interfaces: list[str] = field(default_factory=list)  # kinds of maps; raw is the actuation itself
    configs: int = 128
    seeds: int = 5
    seed: int = 0  # of the draw
    total_frames: int = 1_000_000
    best_seeds: int = 5  # fresh ones, on which the best configuration of each interface is run again
    best_frames: int = 1_000_000
    base: list[str] = field(default_factory=list)  # what every run is told, as on the recipe's command line
    space: dict[str, Any] = field(default_factory=dict)  # see recipes/search_space.py

    def __post_init__(self) -> None:
        """Raise ValueError for a search of nothing, or by what runs do not report."""
        for name in ("configs", "seeds", "total_frames", "best_frames"):
            if getattr(self, name) < 1:
                raise ValueError(f"search.{name} must be at least 1, got {getattr(self, name)}.")
        if self.best_seeds < 0:
            raise ValueError(f"search.best_seeds must not be negative, got {self.best_seeds}.")
        if self.metric not in ("success", "return"):
            raise ValueError(f"search.metric must be success or return, got {self.metric!r}.")
        if self.recipe not in ("ddpg", "ppo", "sac", "td3"):
            raise ValueError(f"search.recipe must be ddpg, ppo, sac or td3, got {self.recipe!r}.")


@dataclass
class Search:
    """``python -m nht.recipes.search``."""

    search: SearchConfig = field(default_factory=SearchConfig)
    demos: DemosConfig = field(default_factory=DemosConfig)
    folder: str = ""  # several machines may share it
    ray_address: str | None = None  # of a cluster, host:port or auto; None starts Ray on this machine
    num_workers: int | None = None  # runs at a time on this machine; None is one for each core
    retry_failed: bool = False  # runs that failed or diverged before


@dataclass
class Report:
    """``python -m nht.recipes.report DIR``."""

    folder: str = ""  # of a search, or of runs
    runs: list[str] = field(default_factory=list)  # folders of runs, or folders that hold them
    out: str = ""  # "" is a folder called report in the first of these
    title: str = ""
    metric: str = "success"  # or return: what the table and the curves show of every evaluation

    def __post_init__(self) -> None:
        """Raise ValueError for a metric that evaluations do not have."""
        if self.metric not in ("success", "return"):
            raise ValueError(f"metric must be success or return, got {self.metric!r}.")


@dataclass
class ExportMap:
    """``python -m nht.recipes.export_map``."""

    file: str = ""  # a saved map
    out: str = ""  # name.onnx or name.pt2; replaced if it exists
    action_scale: float | None = 1.0  # as the policy was trained with, see MapConfig
    compiled: bool = False  # .pt2 only: machine code, for C++
