"""What it costs to train 64 maps together, beside one after the other.

    OMP_NUM_THREADS=1 python benchmarks/speed/map_population.py

NHT on 10,000 demonstrated transitions of WAMWipe, 500 gradient steps each (100 of the whole table), k = 2, one thread.
Widths, depths, activations, limits, learning rates and batch sizes are the first draws of Table 2
(``configs/search/wam.yaml``); once as they are, 16 to 1,024 units, and once those of at most 256 and 64. Beside these
sixteen seeds of the recipes' default. Processor seconds per map and 1,000 steps, fit and measuring included; ways take
turns, in both directions, and the median of the rounds counts. "products" is the time of the gradient steps' matrix
products alone, which no sharing of calls saves.
"""

from __future__ import annotations

import argparse
import statistics
import sys
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import torch
from omegaconf import OmegaConf

import nht
from nht.recipes.data.recording import record_expert
from nht.recipes.sections import DemosConfig, EnvConfig
from nht.recipes.study.space import draw_settings

sys.path.insert(0, str(Path(__file__).parent))
from taking_turns import Row, provenance, show, write

TRANSITIONS, MAPS = 10_000, 64
SPACE = Path(__file__).parents[2] / "configs" / "search" / "wam.yaml"
RESULTS = Path(__file__).parents[1] / "results" / "map_population"
WHOLE = "Table 2"  # a round of as many steps takes a quarter of an hour: fewer, and one, have to do
STEPS = {WHOLE: 100}
KEYS = ["tool_position", "joint_angle"]


@dataclass(frozen=True)
class Drawn:
    """What a map is made of and how it is trained."""

    hidden: tuple[int, ...]
    activation: str
    lipschitz: float | None
    batch_size: int
    learning_rate: float
    seed: int = 0

    def make(self, demos: nht.Demos, device: str) -> nht.NHT:
        """The untrained map."""
        widths = demos.context(KEYS).shape[-1], demos.actuation.shape[-1], 2
        activation: Any = self.activation
        map = nht.NHT(*widths, self.hidden, activation, lipschitz=self.lipschitz, seed=self.seed)
        return map.to(device)


def drawn(widest: int) -> list[Drawn]:
    """The first draws of Table 2 that have no more units in a layer."""
    space: Any = OmegaConf.to_container(OmegaConf.load(SPACE))
    found, configuration = [], 0
    while len(found) < MAPS:
        told: dict[str, Any] = draw_settings(space["space"], 0, configuration, "nht")
        told = {name.removeprefix("map."): value for name, value in told.items()}
        configuration += 1
        if told["hidden_units"] <= widest:
            hidden = told["hidden_layers"] * (told["hidden_units"],)
            numbers = told["lipschitz"], told["batch_size"], told["learning_rate"]
            found.append(Drawn(hidden, told["activation"], *numbers))
    return found


SETS: dict[str, Callable[[], list[Drawn]]] = {
    "Table 2, at most 64 units": lambda: drawn(64),
    "16 seeds of the default": lambda: [
        Drawn((256, 256), "tanh", None, 256, 1e-3, seed) for seed in range(16)
    ],
    "Table 2, at most 256 units": lambda: drawn(256),
    WHOLE: lambda: drawn(1024),
}


def one_after_the_other(demos: nht.Demos, maps: Sequence[nht.NHT], told: Sequence[Drawn], steps: int) -> None:
    for map, own in zip(maps, told, strict=True):
        nht.train_map(
            demos,
            map,
            context_keys=KEYS,
            batch_size=own.batch_size,
            learning_rate=own.learning_rate,
            max_steps=steps,
            seed=own.seed,
        )


def together(demos: nht.Demos, maps: Sequence[nht.NHT], told: Sequence[Drawn], steps: int) -> None:
    found = nht.train_maps(
        demos,
        maps,
        context_keys=KEYS,
        batch_size=[own.batch_size for own in told],
        learning_rate=[own.learning_rate for own in told],
        max_steps=steps,
        seed=[own.seed for own in told],
    )
    assert all(isinstance(each, nht.MapTraining) for each in found)


def products(_: nht.Demos, maps: Sequence[nht.NHT], told: Sequence[Drawn], steps: int) -> None:
    """The products of all gradient steps: of every layer one forward, one for its weights, one for its input."""
    for map, own in zip(maps, told, strict=True):
        weights = [map.network.linear(index).weight.detach() for index in range(len(map.network.layers))]
        values = [weights[0].new_ones(own.batch_size, weight.shape[1]) for weight in weights]
        results = [weights[0].new_ones(own.batch_size, weight.shape[0]) for weight in weights]
        gradients = [torch.empty_like(weight) for weight in weights]
        below = [torch.empty_like(value) for value in values]
        for _ in range(steps):
            for layer, weight in enumerate(weights):
                torch.mm(values[layer], weight.mT, out=results[layer])
                torch.mm(results[layer].mT, values[layer], out=gradients[layer])
                if layer:
                    torch.mm(results[layer], weight, out=below[layer])


WAYS = {"one after the other": one_after_the_other, "together": together, "products": products}


def seconds(way: str, demos: nht.Demos, told: Sequence[Drawn], steps: int, device: str) -> float:
    """Per map and 1,000 steps: of the processor, or on a GPU on the clock."""
    maps = [own.make(demos, device) for own in told]
    clock = time.process_time if device == "cpu" else time.perf_counter
    start = clock()
    WAYS[way](demos, maps, told, steps)
    if device != "cpu":
        torch.cuda.synchronize()
    return (clock() - start) / len(told) / steps * 1000


def main() -> None:
    parser = argparse.ArgumentParser()
    parser.add_argument("--rounds", type=int, default=3)
    parser.add_argument("--device", default="cpu")
    parser.add_argument("--sets", nargs="*", default=list(SETS), choices=list(SETS))
    told = parser.parse_args()
    torch.set_num_threads(1)
    rows: list[Row] = []
    with TemporaryDirectory() as scratch:
        record_expert(EnvConfig(), DemosConfig(transitions=TRANSITIONS), 0, str(Path(scratch) / "demos"))
        demos = nht.load_demos(Path(scratch) / "demos")
    for name in told.sets:
        maps, steps = SETS[name](), STEPS.get(name, 500)
        taken: dict[str, list[float]] = {way: [] for way in WAYS}
        for number in range(1 if name == WHOLE else told.rounds):
            for way in WAYS if number % 2 else reversed(WAYS):
                taken[way].append(seconds(way, demos, maps, steps, told.device))
        ratios = [a / b for a, b in zip(taken["one after the other"], taken["together"], strict=True)]
        row: Row = {"maps": name, "count": len(maps), "steps": steps, "device": told.device}
        row |= {f"{way} [s]": round(statistics.median(values), 3) for way, values in taken.items()}
        row |= {"ratio": round(statistics.median(ratios), 2)}
        if len(ratios) > 1:
            row |= {"ratio from": round(min(ratios), 2), "ratio to": round(max(ratios), 2)}
        rows.append(row)
        print(row, flush=True)
        write(RESULTS / f"{told.device}.csv", rows, provenance(told.rounds))
    show(rows)


if __name__ == "__main__":
    main()
