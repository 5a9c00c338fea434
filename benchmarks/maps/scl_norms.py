"""How large SCL's unconstrained matrices grow, and whether the environment survives them.

    OMP_NUM_THREADS=1 python benchmarks/maps/scl_norms.py

In the paper 10 % of the runs through SCL failed: matrices of large norm gave actuations that broke the simulation.
Here (A.4) SCL maps of configurations drawn from Table 2 are trained on the same demonstrations of WAMWipe, then driven
by uniform random actions of the paper's largest size, Max |a| up to 10, over 200 steps of 10 copies. NHT maps of the
same configurations stand beside them, and all of them once more without the Lipschitz limit. A row per map: the largest
spectral norm of the basis on the demonstrations and in the rollouts, the share of steps with a motor at its limit, and
the number of copies that diverged.
"""

from __future__ import annotations

import argparse
import math
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np
import pandas
import torch

import nht
from nht.recipes.data.recording import record_expert
from nht.recipes.maps.interface import trained_map
from nht.recipes.run.environments import mapped_env
from nht.recipes.sections import DemosConfig, EnvConfig, MapConfig

ENV = EnvConfig(context_keys=["tool_position", "joint_angle"])
LARGE = 10.0  # a basis this long turns an action of 0.2 into the joints' largest speed
MOST_UNITS = 256  # the paper goes to 1024; four layers of these take minutes each
RESULTS = Path(__file__).parents[1] / "results" / "scl_norms" / "scl_norms.csv"


def exponential(rng: np.random.Generator, low: float, high: float) -> float:
    return math.exp(rng.uniform(math.log(low), math.log(high)))


def draw(rng: np.random.Generator) -> dict[str, Any]:
    """A configuration of Table 2 (top), and the largest action from its last lines."""
    return {
        "learning_rate": exponential(rng, 1e-6, 1e-1),
        "batch_size": int(rng.integers(32, 257)),
        "activation": str(rng.choice(["relu", "sigmoid", "tanh"])),
        "hidden": [round(exponential(rng, 16, MOST_UNITS))] * int(rng.integers(1, 5)),
        "lipschitz": exponential(rng, 1e-1, 1e2),
        "action_scale": exponential(rng, 1, 10),
    }


@torch.no_grad()
def largest_norm(map: nht.ActionMap, context: torch.Tensor) -> float:
    assert isinstance(map, nht.LinearActionMap)
    return float(torch.linalg.matrix_norm(map.basis(context), ord=2).max())


def measured(
    kind: str, settings: dict[str, Any], steps: int, demos: DemosConfig, seed: int
) -> dict[str, Any]:
    config = MapConfig(kind, max_steps=steps, **settings)
    row = {"map": kind, "configuration": seed, **settings}
    try:
        map, metrics = trained_map(config, ENV, demos, seed)
    except FloatingPointError:
        return row | {"error": math.inf, "norm_demos": math.inf}
    map.action_scale.fill_(config.action_scale)
    env = mapped_env(ENV, map, seed=seed, num_envs=10)
    env.set_seed(seed)
    steps = env.rollout(200, break_when_any_done=False)
    actuation, limit = steps["next", "actuation"], env.base_env.action_spec.space.high[:1]
    return row | {
        "error": metrics["validation_error"],
        "norm_demos": largest_norm(map, nht.load_demos(str(demos.path)).context(ENV.context_keys)),
        "norm_rollouts": largest_norm(map, steps["context"]),
        "clipped": float((actuation.abs() >= limit).any(-1).float().mean()),
        "diverged": int(steps["next", "diverged"].sum()),
    }


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--configurations", type=int, default=30)
    parser.add_argument("--steps", type=int, default=600)
    options = parser.parse_args()
    torch.set_num_threads(1)
    rows = []
    with TemporaryDirectory() as scratch:
        demos = DemosConfig(str(Path(scratch) / "demos"))
        record_expert(ENV, DemosConfig(), 0, str(demos.path))
        rng = np.random.default_rng(0)
        for index in range(options.configurations):
            settings = draw(rng)
            for limit in (settings["lipschitz"], None):
                for kind in ("scl", "nht"):
                    own = settings | {"lipschitz": limit}
                    rows.append(measured(kind, own, options.steps, demos, index))
            pandas.DataFrame(rows).to_csv(RESULTS, index=False)
    table = pandas.DataFrame(rows)
    table["limited"] = table["lipschitz"].notna()
    print(
        table.groupby(["map", "limited"])
        .agg(
            maps=("norm_demos", "size"),
            untrained=("error", lambda errors: int(errors.isin([math.inf]).sum())),
            norm_median=("norm_rollouts", "median"),
            norm_largest=("norm_rollouts", "max"),
            large=("norm_rollouts", lambda norms: int((norms > LARGE).sum())),
            clipped=("clipped", "mean"),
            diverged=("diverged", "sum"),
        )
        .to_string()
    )


if __name__ == "__main__":
    main()
