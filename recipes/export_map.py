"""Export a saved map for a robot, as a program that does not need nht.

python -m nht.recipes.export_map file=runs/nht.safetensors out=runs/nht.onnx
"""

from __future__ import annotations

import torch

import nht
from nht.recipes.config import ExportMap
from nht.recipes.launch import launch


def main(config: ExportMap) -> None:
    """Export a map, and print which inputs the program takes."""
    map = nht.load_map(config.file, allow=config.allow)
    low, high = (None if limits is None else torch.tensor(limits) for limits in (config.low, config.high))
    out = nht.export_map(
        map, config.out, action_scale=config.action_scale, low=low, high=high, compiled=config.compiled
    )
    keys = "" if map.context_keys is None else f": {list(map.context_keys)}, side by side"
    print(f"{out}: action (batch, {map.action_dim}), context (batch, {map.context_dim}){keys}")


if __name__ == "__main__":
    launch(main, ExportMap, "export_map")
