"""How long each map takes to fit 100,000 demonstrated transitions, and which share of it is arithmetic.

    OMP_NUM_THREADS=1 python benchmarks/speed/map_training.py

WAMWipe, random starts (swivel 1.0 rad), k = 2, the recipes' default network and budget, one thread. "Share in the
network" compares the time of gradient steps as training makes them (batches drawn, projected onto the Lipschitz limit,
scheduled) with loss, gradient and Adam alone on one batch that stays the same; medians of interleaved rounds. CPU
seconds, which on a free core are seconds.
"""

from __future__ import annotations

import statistics
import time
from pathlib import Path
from tempfile import TemporaryDirectory

import pandas
import torch
from tensordict import TensorDict

import nht
from nht.recipes.data.recording import record_expert
from nht.recipes.maps.interface import trained_map
from nht.recipes.sections import DemosConfig, EnvConfig, MapConfig
from nht.train import _gradient_steps

TRANSITIONS = 100_000
ENV = EnvConfig(
    context_keys=["tool_position", "joint_angle"], options={"start": "random", "swivel_range": 1.0}
)
MAPS = {
    "nht": MapConfig("nht"),
    "nht, L = 10": MapConfig("nht", lipschitz=10.0),
    "nht, heads": MapConfig("nht", multi_head=True),
    "scl": MapConfig("scl"),
    "laser": MapConfig("laser"),
    "cae": MapConfig("cae"),
    "svd": MapConfig("svd"),
}
ROUNDS, STEPS = 7, 250
RESULTS = Path(__file__).parents[1] / "results" / "map_training" / "map_training.csv"


def seconds_of_training(map: nht.ActionMap, data: TensorDict) -> float:
    start = time.process_time()
    for _ in _gradient_steps(map, data, 256, 1e-3, STEPS, seed=0):
        pass
    return time.process_time() - start


def seconds_of_arithmetic(map: nht.ActionMap, batch: TensorDict) -> float:
    optimiser = torch.optim.Adam(map.parameters(), lr=1e-3, fused=True)
    start = time.process_time()
    for _ in range(STEPS):
        loss = map.loss(batch)
        optimiser.zero_grad()
        loss.backward()
        optimiser.step()
    return time.process_time() - start


def share_in_network(map: nht.ActionMap) -> float:
    map = map.train().requires_grad_()
    width, n = map.context_dim, map.actuation_dim
    generator = torch.Generator().manual_seed(0)

    def normal(size: int) -> torch.Tensor:
        return torch.randn(TRANSITIONS, size, generator=generator)

    data = TensorDict(
        {"context": normal(width), "actuation": normal(n), ("next", "context"): normal(width)}, TRANSITIONS
    )
    shares = []
    for _ in range(ROUNDS + 1):
        shares.append(seconds_of_arithmetic(map, data[:256]) / seconds_of_training(map, data))
    return statistics.median(shares[1:])


def main() -> None:
    torch.set_num_threads(1)
    rows = []
    with TemporaryDirectory() as scratch:
        demos = DemosConfig(str(Path(scratch) / "demos"))
        record_expert(ENV, DemosConfig(transitions=TRANSITIONS), 0, str(demos.path))
        for name, config in MAPS.items():
            start = time.process_time()
            map, metrics = trained_map(config, ENV, demos, seed=0)
            seconds = time.process_time() - start
            rows.append(
                {
                    "map": name,
                    "CPU seconds": round(seconds, 1),
                    "steps": int(metrics["steps"]),
                    "best step": int(metrics["best_step"]),
                    "held-out error": f"{metrics['validation_error']:.1e}",
                    "certificate": f"{metrics['certificate']:.1f}",
                    "share in the network": "-" if name == "svd" else f"{share_in_network(map):.2f}",
                }
            )
            print(rows[-1])
    table = pandas.DataFrame(rows)
    table.to_csv(RESULTS, index=False)
    print(table.to_string(index=False))


if __name__ == "__main__":
    main()
