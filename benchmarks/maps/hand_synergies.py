"""The Adroit hand as a source of maps: how much of 30 motors' motion k directions explain.

    OMP_NUM_THREADS=1 python benchmarks/maps/hand_synergies.py

The demonstrations are synthetic: the arm follows smooth random paths; the fingers close together, spread and oppose the
thumb with strengths that come and go smoothly, each joint of a finger following the one before it more the further the
hand is closed, as a grasp does; some tremor. They show that everything runs and what the numbers look like; they say
nothing of human hands.
"""

from __future__ import annotations

from contextlib import closing
from pathlib import Path

import mujoco
import numpy as np
import pandas
import torch
from numpy.typing import NDArray

import nht
from nht.envs import make_gymnasium

TASK, EPISODES, STEPS = "AdroitHandRelocate-v1", 60, 100
RESULTS = Path(__file__).parents[1] / "results" / "hand_synergies" / "hand_synergies.csv"


def smooth(rng: np.random.Generator, count: int) -> NDArray[np.float64]:
    """``(STEPS, count)`` sums of slow sines, within [-1, 1]."""
    clock = np.linspace(0, 2 * np.pi, STEPS)[:, None, None]
    phase, weight = rng.uniform(0, 2 * np.pi, (count, 3)), rng.dirichlet(np.ones(3), count)
    return (weight * np.sin(np.array([0.5, 1.0, 1.5]) * clock + phase)).sum(-1)


def synergies(names: list[str], rng: np.random.Generator) -> NDArray[np.float64]:
    """An episode's actuations ``(STEPS, n)``, in [-1, 1]: desired joint angles in units of their ranges."""
    closing, spread, thumb = smooth(rng, 3).T
    arm = smooth(rng, 6)
    actuation = 0.02 * rng.standard_normal((STEPS, len(names)))
    for i, name in enumerate(names):
        if name.startswith(("A_AR", "A_WR")):
            actuation[:, i] += 0.3 * arm[:, i % 6]
        elif name.startswith("A_TH"):
            actuation[:, i] += 0.6 * thumb + 0.3 * closing
        elif name.endswith("3"):  # sideways
            actuation[:, i] += 0.5 * spread * {"FF": -1.0, "MF": -0.3, "RF": 0.3, "LF": 1.0}[name[2:4]]
        else:  # the finger's joints from its root to its tip
            behind = 2 - int(name[-1])
            actuation[:, i] += 0.8 * closing - 0.15 * behind * (1 - closing) ** 2
    return np.clip(actuation, -1, 1)


def hand_made_demos() -> nht.Demos:
    rng, rows = np.random.default_rng(0), []
    with closing(make_gymnasium(TASK, seed=0)) as env:
        model = env.task.copies[0].model
        names = [mujoco.mj_id2name(model, mujoco.mjtObj.mjOBJ_ACTUATOR, i) for i in range(model.nu)]
        for episode in range(EPISODES):
            current = env.reset()
            for actuation in torch.tensor(synergies(names, rng), dtype=torch.float32):
                frame, current = env.step_and_maybe_reset(current.set("action", actuation[None]))
                rows.append((frame["observation"][0], actuation, torch.tensor(episode)))
    context, actuation, index = (torch.stack(column) for column in zip(*rows, strict=True))
    return nht.Demos.from_tensors(context={"observation": context}, actuation=actuation, episode=index)


def main() -> None:
    torch.set_num_threads(1)
    demos = hand_made_demos()
    n, width = demos.actuation.shape[-1], demos.context(["observation"]).shape[-1]
    energy = torch.linalg.svdvals(demos.actuation.double()).square()
    rows = []
    for k in range(2, 10):
        row = {"k": k, "energy": float(energy[:k].sum() / energy.sum())}
        for name, map in (("svd", nht.SVD(n, k, width)), ("nht", nht.NHT(width, n, k, hidden=(128, 128)))):
            metrics = nht.train_map(demos, map, context_keys=["observation"], max_steps=3_000).metrics
            row[f"{name}_error"] = metrics["validation_error"]
        rows.append(row)
        print({name: round(value, 4) for name, value in row.items()})
    pandas.DataFrame(rows).round(5).to_csv(RESULTS, index=False)


if __name__ == "__main__":
    main()
