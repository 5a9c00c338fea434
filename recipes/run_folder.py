"""The folder of a run: configuration, metrics, checkpoints, videos and W&B files."""

from __future__ import annotations

import csv
import os
import time
from dataclasses import asdict
from netrc import NetrcParseError, netrc
from pathlib import Path
from typing import Any, cast

import pandas
import wandb
import yaml
from omegaconf import OmegaConf
from torchrl.record.loggers.wandb import WandbLogger

from nht.recipes.agents.sac import SAC
from nht.recipes.agents.td3 import TD3
from nht.recipes.config import DDPG, PPO, RunConfig, Training
from nht.storage import replacing

RECIPES: dict[str, type[Training]] = {"DDPG": DDPG, "PPO": PPO, "SAC": SAC, "TD3": TD3}
"""What ``config.yaml`` says of the algorithm, under ``recipe``; folders that say nothing hold DDPG."""

LASTING = (
    "recipe",
    "env.name",
    "env.context_keys",
    "env.num_envs",
    "env.options",
    "map.kind",
    "map.action_dim",
    "algo.hidden",
    "algo.activation",
    "evaluation.episodes",
    "collector.kind",
    "collector.num_workers",
)
"""Settings that a checkpoint was made for: resuming cannot change them."""


class RunFolder:
    """Where one run writes. ``metrics.csv`` has a row per evaluation; W&B gets the same numbers.

    Args:
        run: folder, resume and W&B settings.
        config: the whole configuration of the run, a dataclass, saved as ``config.yaml``.

    Raises:
        FileExistsError: if the folder holds a run already and ``run.resume`` is false.
        FileNotFoundError: if ``run.resume`` is true and there is nothing to resume.
        ValueError: if what is to be resumed is a run of another task, algorithm or network.

    Attributes:
        path: of the folder.
        resuming: whether it holds a run already, which is to go on.
    """

    def __init__(self, run: RunConfig, config: Any) -> None:
        self.path = Path(run.folder)
        self._started = time.perf_counter()
        self.metrics = self.path / "metrics.csv"
        settings = self.path / "config.yaml"
        self.resuming = settings.exists()
        if run.resume is True and not self.resuming:
            raise FileNotFoundError(f"{self.path} holds no run to resume.")
        if run.resume is False and self.resuming:
            raise FileExistsError(
                f"{self.path} holds a run already: go on with run.resume=true, or choose another run.folder."
            )
        self.path.mkdir(parents=True, exist_ok=True)
        described = {"recipe": type(config).__name__, **asdict(config)}
        if self.resuming:
            self._check_same(yaml.safe_load(settings.read_text()), described)
        else:
            with replacing(settings) as scratch:
                scratch.write_text(yaml.safe_dump(described, sort_keys=False))
        self._wandb = self._start_wandb(run, config) if run.wandb else None

    def _check_same(self, saved: dict[str, Any], described: dict[str, Any]) -> None:
        for name in LASTING:
            old, new = (_setting(settings, name) for settings in ({"recipe": "DDPG"} | saved, described))
            if old != new:
                raise ValueError(
                    f"{self.path} holds a run with {name}={old}: it cannot go on with {name}={new}."
                )

    def _start_wandb(self, run: RunConfig, config: Any) -> WandbLogger:
        os.environ.setdefault("WANDB_SILENT", "true")
        return WandbLogger(
            exp_name=self.path.name,
            save_dir=str(self.path),
            project=run.wandb_project,
            offline=not _logged_in(),
            config=asdict(config),
            group=run.wandb_group,
            job_type=run.wandb_job_type,
        )

    def log(self, frames: int, row: dict[str, float]) -> None:
        """Append a row to ``metrics.csv`` and send it to W&B, against environment steps."""
        row = {"frames": frames, **row, "seconds": time.perf_counter() - self._started}
        fresh = not self.metrics.exists()
        with self.metrics.open("a", newline="") as file:
            writer = csv.DictWriter(file, fieldnames=list(row))
            if fresh:
                writer.writeheader()
            writer.writerow(row)
        if self._wandb is not None:
            self._wandb.experiment.log(row, step=frames)

    def rewind(self, frames: int) -> None:
        """Drop the rows behind ``frames``, or cut short by a kill: a resumed run writes them again.

        Its clock goes on from the last row that stays.
        """
        if not self.metrics.exists():
            return
        with self.metrics.open(newline="") as file:
            rows = list(csv.reader(file))
        kept = [row for row in rows[1:] if len(row) == len(rows[0]) and int(row[0]) <= frames]
        if not kept:
            self.metrics.unlink()  # its heading may be cut short, too
            return
        self._started -= float(kept[-1][rows[0].index("seconds")])
        with replacing(self.metrics) as scratch, scratch.open("w", newline="") as file:
            csv.writer(file).writerows([rows[0], *kept])

    def finish(self) -> None:
        """Hand video and map to W&B, and say what happened and where the files are."""
        if self._wandb is not None:
            if (video := self.path / "video.mp4").exists():
                self._wandb.experiment.log({"video": wandb.Video(str(video), format="mp4")})
            artifact = wandb.Artifact(f"map-{self.path.name}", type="action-map")
            artifact.add_file(str(self.path / "map.safetensors"))
            self._wandb.experiment.log_artifact(artifact)
            self._wandb.experiment.finish()
        rows = pandas.read_csv(self.metrics)
        print(rows[["frames", "eval_success", "eval_failure", "eval_return"]].tail(5).to_string(index=False))
        print(f"\n{self.path}: " + ", ".join(sorted(entry.name for entry in self.path.iterdir())))


def read_config(folder: Path) -> Training:
    """The configuration that a run was started with.

    Raises:
        FileNotFoundError: if the folder holds no run.
    """
    settings = folder / "config.yaml"
    if not settings.exists():
        raise FileNotFoundError(f"{folder} holds no run: it has no config.yaml.")
    saved = yaml.safe_load(settings.read_text())
    schema = OmegaConf.structured(RECIPES[saved.pop("recipe", "DDPG")])
    return cast(Training, OmegaConf.to_object(OmegaConf.merge(schema, saved)))


def _setting(settings: dict[str, Any], name: str) -> Any:
    """The entry at a dotted name; None where there is none."""
    node: Any = settings
    for part in name.split("."):
        node = node.get(part) if isinstance(node, dict) else None
    return node


def _logged_in() -> bool:
    """Whether W&B has a key here: from the environment or from its login."""
    if mode := os.environ.get("WANDB_MODE"):
        return mode == "online"
    try:
        return "WANDB_API_KEY" in os.environ or netrc().authenticators("api.wandb.ai") is not None
    except (FileNotFoundError, NetrcParseError):
        return False
