"""An action map from demonstrations.

python -m nht.recipes.train_map map=nht demos.path=runs/demos-wam_wipe
"""

from __future__ import annotations

from dataclasses import asdict
from pathlib import Path

import torch

import nht
from nht.recipes.config import TrainMap
from nht.recipes.launch import launch
from nht.recipes.maps.interface import trained_map
from nht.recipes.run.artifacts import demos_files, map_files
from nht.recipes.run.dashboard import Dashboard, shown_on_dashboard, wanted
from nht.recipes.run.ranks import usable_device


def main(config: TrainMap) -> None:
    """Train a map, save it and say how well it fits."""
    out = Path(config.out)
    if out.exists():
        raise FileExistsError(f"{out} exists: maps are never overwritten. Choose another file.")
    device = usable_device(config.device)
    torch.set_num_threads(config.torch_threads)
    wanted(config.run)  # whether W&B is installed, if it is
    if config.demos.path is not None:
        nht.load_demos(
            config.demos.path, env=config.env.name
        )  # or say what is wrong, before anything is written
    out.parent.mkdir(parents=True, exist_ok=True)
    settings = {"recipe": "train_map", **asdict(config)}
    with shown_on_dashboard(out.parent, settings, config.run, name=out.stem, remembered=False) as dashboard:
        watch = None if dashboard is None else dashboard.log_map
        trained = trained_map(
            config.map, config.env, config.demos, config.seed, str(device), align=config.align, watch=watch
        )
        nht.save_map(trained.map, out)
        if dashboard is not None:
            show_map(dashboard, config, trained)
    for name, value in trained.metrics.items():
        print(f"{name:>20}  {value:.6g}")
    print(f"saved in {out}")


def show_map(dashboard: Dashboard, config: TrainMap, trained: nht.MapTraining) -> None:
    """Hand the map on, say how well it fits, and what it was trained on."""
    if config.demos.path is not None:
        dashboard.take(demos_files(Path(config.demos.path)))
    dashboard.summarise({f"map/{name}": value for name, value in trained.metrics.items()})
    dashboard.add(map_files(Path(config.out), trained.map, trained.metrics))


if __name__ == "__main__":
    launch(main, TrainMap, "train_map")
