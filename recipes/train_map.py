"""An action map from demonstrations.

python -m nht.recipes.train_map map=nht demos.path=runs/demos-wam_wipe
"""

from __future__ import annotations

from pathlib import Path

import torch

import nht
from nht.recipes.config import TrainMap
from nht.recipes.launch import launch
from nht.recipes.maps.interface import trained_map
from nht.recipes.run.ranks import usable_device


def main(config: TrainMap) -> None:
    """Train a map, save it and say how well it fits."""
    out = Path(config.out)
    if out.exists():
        raise FileExistsError(f"{out} exists: maps are never overwritten. Choose another file.")
    device = usable_device(config.device)
    torch.set_num_threads(config.torch_threads)
    trained = trained_map(config.map, config.env, config.demos, config.seed, str(device), align=config.align)
    nht.save_map(trained.map, out)
    for name, value in trained.metrics.items():
        print(f"{name:>20}  {value:.6g}")
    print(f"saved in {out}")


if __name__ == "__main__":
    launch(main, TrainMap, "train_map")
