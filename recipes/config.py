"""The settings of each recipe: one dataclass per command, checked before anything runs.

Those of the algorithms are in ``nht.recipes.agents``.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

from nht.recipes.agents.ddpg import DDPG
from nht.recipes.agents.ppo import PPO
from nht.recipes.agents.table import find_algorithm
from nht.recipes.run.metrics import check_outcome
from nht.recipes.sections import (
    ChartsConfig,
    DemosConfig,
    EnvConfig,
    MapConfig,
    RunConfig,
    SourceConfig,
    Training,
    path_field,
)

__all__ = [
    "DDPG",
    "PPO",
    "CollectDemos",
    "CompareMaps",
    "Evaluate",
    "ExportMap",
    "InspectDemos",
    "Report",
    "RunConfig",
    "Search",
    "TrainMap",
    "Training",
    "Workspace",
]


@dataclass
class CollectDemos:
    """``python -m nht.recipes.collect_demos``."""

    env: EnvConfig = field(default_factory=EnvConfig)
    demos: DemosConfig = field(default_factory=DemosConfig)
    source: SourceConfig = field(default_factory=SourceConfig)
    seed: int = 0  # of every random draw
    out: str = path_field("")  # folder of the demonstrations; never overwritten


@dataclass
class InspectDemos:
    """``python -m nht.recipes.inspect_demos PATH``."""

    demos: str = path_field("")  # folder of demonstrations, or what source.path of collect_demos may be
    directions: int = 10  # global directions whose energy is shown, at most
    out: str | None = path_field(None)  # of the figure; None puts it beside the demonstrations


@dataclass
class TrainMap:
    """``python -m nht.recipes.train_map``."""

    env: EnvConfig = field(default_factory=EnvConfig)
    demos: DemosConfig = field(default_factory=DemosConfig)
    map: MapConfig = field(default_factory=MapConfig)
    align: str | None = None  # tool: action axis 1 moves the arm's tool along x, 2 along y, 3 along z
    seed: int = 0  # of the weights, batches and held-out episodes
    device: str = "cpu"  # where it is trained: cpu, cuda or cuda:1
    torch_threads: int = 1  # on cores that others use, too, one is often fastest
    out: str = path_field("")  # file of the map; never overwritten
    run: ChartsConfig = field(default_factory=ChartsConfig)

    def __post_init__(self) -> None:
        """Raise ValueError for an alignment that does not exist."""
        if self.align not in (None, "tool"):
            raise ValueError(f"align must be tool, or null for axes as they come out, got {self.align!r}.")


@dataclass
class Evaluate:
    """``python -m nht.recipes.evaluate``."""

    run: str = path_field("")  # folder of a finished run
    episodes: int = 100  # to test on
    seed: int = 1_000_000  # of the test episodes
    video: bool = True  # film some of them
    video_episodes: int = 6  # how many
    env_options: dict[str, Any] = field(default_factory=dict)  # laid over those of the run
    allow: list[str] = field(default_factory=list)  # packages whose code a run's configuration may name


@dataclass
class CompareMaps:
    """``python -m nht.recipes.compare_maps``."""

    env: EnvConfig = field(default_factory=EnvConfig)
    demos: DemosConfig = field(default_factory=DemosConfig)
    map: MapConfig = field(default_factory=MapConfig)  # what all maps have in common
    maps: list[str] = field(default_factory=lambda: ["nht", "laser", "svd", "scl"])  # kinds to compare
    action_dims: list[int] = field(default_factory=lambda: [1, 2, 3])  # with so many action axes each
    seed: int = 0  # of the weights, batches and held-out episodes
    torch_threads: int = 1  # on cores that others use, too, one is often fastest
    out: str = path_field("")  # folder of tables, figures and maps; never overwritten
    run: ChartsConfig = field(default_factory=ChartsConfig)


@dataclass
class SearchConfig:
    """Settings of a search: interfaces x configurations x seeds, each a run of a recipe."""

    recipe: str = "ddpg"  # that every run is of: ddpg, td3, sac, ppo or another algorithm
    env: str = "wam_wipe"  # choice of the task
    action_dim: int = 2  # of learned maps
    metric: str = "success"  # or return: of a run's last evaluation
    interfaces: list[str] = field(default_factory=list)  # kinds of maps; raw is the actuation itself
    configs: int = 128  # drawn for each interface
    seeds: int = 5  # runs of each configuration
    seed: int = 0  # of the draw
    total_frames: int = 1_000_000  # environment steps of a run
    best_seeds: int = 5  # fresh ones, on which the best configuration of each interface is run again
    best_frames: int = 1_000_000  # environment steps of those runs
    learners: int = 1  # runs that train together in one process, as far as their learners are of one shape
    base: list[str] = field(default_factory=list)  # what every run is told, as on the recipe's command line
    space: dict[str, Any] = field(default_factory=dict)  # see recipes/study/space.py

    def __post_init__(self) -> None:
        """Raise ValueError for a search without runs, or by a metric that runs do not report."""
        for name in ("configs", "seeds", "total_frames", "best_frames", "learners"):
            if getattr(self, name) < 1:
                raise ValueError(f"search.{name} must be at least 1, got {getattr(self, name)}.")
        if self.best_seeds < 0:
            raise ValueError(f"search.best_seeds must not be negative, got {self.best_seeds}.")
        check_outcome("search.metric", self.metric)
        find_algorithm(self.recipe)


@dataclass
class Search:
    """``python -m nht.recipes.search``."""

    search: SearchConfig = field(default_factory=SearchConfig)
    demos: DemosConfig = field(default_factory=DemosConfig)
    folder: str = path_field("")  # several machines may share it
    ray_address: str | None = None  # of a cluster, host:port or auto; None starts Ray on this machine
    num_workers: int | None = None  # runs at a time on this machine; None is one for each core
    tasks_per_gpu: int = (
        1  # runs, or packs, that share a GPU with device=cuda: while one simulates, another learns
    )
    retry_failed: bool = False  # runs that failed or diverged before

    def __post_init__(self) -> None:
        """Raise ValueError for fewer than one task on a GPU."""
        if self.tasks_per_gpu < 1:
            raise ValueError(f"tasks_per_gpu must be at least 1, got {self.tasks_per_gpu}.")


@dataclass
class Report:
    """``python -m nht.recipes.report DIR``."""

    folder: str = path_field("")  # of a search, or of runs
    # folders of runs, or folders that hold them
    runs: list[str] = field(default_factory=list, metadata={"path": True})
    out: str = path_field("")  # "" is a folder called report in the first of these
    title: str = ""  # of figures and page; "" is what they show
    metric: str = "success"  # or return: what the table and the curves show of every evaluation
    lines: str = "interface"  # or algorithm: what is compared in a table and a figure
    video: bool = True  # film the best policy of each, side by side, where there are policies
    run: ChartsConfig = field(default_factory=ChartsConfig)

    def __post_init__(self) -> None:
        """Raise ValueError for a metric that evaluations do not have, or an unknown choice of lines."""
        check_outcome("metric", self.metric)
        if self.lines not in ("interface", "algorithm"):
            raise ValueError(f"lines must be interface or algorithm, got {self.lines!r}.")


@dataclass
class Workspace:
    """``python -m nht.recipes.workspace``."""

    entity: str = ""  # your name on W&B, or your team's
    project: str = "nht"  # whose runs are shown
    name: str = "nht: training"  # of the view
    group_by: str | None = None  # Group or "Job Type": one line for the runs of each, with a band


@dataclass
class ExportMap:
    """``python -m nht.recipes.export_map``."""

    file: str = path_field("")  # a saved map
    out: str = path_field("")  # name.onnx or name.pt2; replaced if it exists
    action_scale: float | None = None  # what an action of 1 is worth; None is what the map says
    low: list[float] | None = (
        None  # of each motor: then the program saturates as the map does; None is no limit
    )
    high: list[float] | None = None  # of each motor; None is no limit
    compiled: bool = False  # .pt2 only: machine code, for C++
    allow: list[str] = field(default_factory=list)  # packages whose classes the file may name
