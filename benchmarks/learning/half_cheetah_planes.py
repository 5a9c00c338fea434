"""How many dimensions the gait of raw torques needs: what is left of it when it acts through a map of k dimensions.

The five policies on raw torques of ``half_cheetah_interfaces.py``, in its folder. For each, ten episodes are recorded,
and SVD's plane and NHT are fitted to them, for every k. Then the policy acts through its own map, without any learning:
its torques u become Q Q^T u. Writes rows and a figure to ``results/half_cheetah_interfaces``.

    python benchmarks/learning/half_cheetah_planes.py FOLDER
"""

from __future__ import annotations

import itertools
import sys
from collections.abc import Callable
from contextlib import closing
from pathlib import Path
from typing import Any

import matplotlib.pyplot as plt
import numpy as np
import pandas
import torch
from half_cheetah_interfaces import RESULTS
from tensordict import TensorDictBase
from torch import Tensor
from torchrl.envs.utils import ExplorationType, set_exploration_type

import nht
from nht.recipes.agents.policy import load_policy
from nht.recipes.data.recording import record_episodes
from nht.recipes.figure_style import GREY, PAGE, save_figure, style
from nht.recipes.run.environments import mapped_env
from nht.recipes.run.saved_run import kept_map, read_config
from nht.recipes.sections import DemosConfig
from nht.recipes.study.figures import colour
from nht.recipes.study.scores import interval
from populations import made

DIMENSIONS = range(1, 6)
KINDS = ("svd", "nht")
TRANSITIONS = 10_000
EPISODES = 50
Change = Callable[[Tensor, Tensor], Tensor]


def main() -> None:
    """Fit the maps, let each policy act through its own, and show what is left of its return."""
    torch.set_num_threads(1)
    folder, rows = Path(sys.argv[1]).resolve(), []
    (raw,) = folder.glob("whole/raw-*")
    for run in sorted(raw.glob("seed-*")):
        rows += through_its_own(run, folder / "planes")
        print(pandas.DataFrame(rows).to_string(index=False), flush=True)
    table = pandas.DataFrame(rows)
    table.to_csv(RESULTS / "planes.csv", index=False)
    draw(table)


def through_its_own(run: Path, folder: Path) -> list[dict[str, Any]]:
    """What each map misses of a policy's torques, a share of their energy, and the return through it."""
    task, recorded = ["env=half_cheetah"], folder / run.name
    told = ["source=policy", f"source.path={run}", f"demos.transitions={TRANSITIONS}"]
    demos = nht.load_demos(made(recorded, "collect_demos", [*task, *told]))
    torques, context = demos.actuation, demos.data["observation"].float()
    seed = int(run.name.removeprefix("seed-"))
    rows = [{"seed": seed, "map": "none", "k": 6, "missed": 0.0, "return": acted(run, lambda own, _: own)}]
    for kind, k in itertools.product(KINDS, DIMENSIONS):
        told = [f"demos.path={recorded}", f"map={kind}", f"map.action_dim={k}"]
        map = nht.load_map(made(folder / f"{run.name}-{kind}-{k}.safetensors", "train_map", [*task, *told]))

        def projected(torques: Tensor, context: Tensor, map: nht.ActionMap = map) -> Tensor:
            return map(map.project(torques, context), context)

        missed = (torques - projected(torques, context)).square().sum() / torques.square().sum()
        rows.append(
            {"seed": seed, "map": kind, "k": k, "missed": float(missed), "return": acted(run, projected)}
        )
    return rows


@torch.no_grad()
def acted(run: Path, change: Change) -> float:
    """Mean return of a policy on raw torques when something changes these, given the observation."""
    config = read_config(run)
    own = kept_map(run, config)
    simulation = mapped_env(config.env, own, seed=0, num_envs=EPISODES)
    policy, base = load_policy(run, simulation, config), simulation.base_env
    low, high = (torch.as_tensor(bound) for bound in base.task.actuation_bounds)

    def act(current: TensorDictBase) -> TensorDictBase:
        current = policy(current)
        torques = own.decode(current["action"], current["action"][:, :0], low, high)
        changed = change(torques.float(), current["observation"].float())
        return current.set("action", torch.clamp(changed, low, high))

    with closing(simulation), set_exploration_type(ExplorationType.DETERMINISTIC):
        episodes, _ = record_episodes(
            base, base.task, act, DemosConfig(transitions=EPISODES * 1_000), judged=False
        )
    return float(episodes["reward"].sum()) / EPISODES


@style()
def draw(table: pandas.DataFrame) -> None:
    """Energy missed and return kept over k, means over the policies with their intervals."""
    figure, (left, right) = plt.subplots(1, 2, figsize=(PAGE, 0.36 * PAGE), layout="constrained")
    for kind in KINDS:
        rows = table[table["map"] == kind]
        for axes, column in ((left, "missed"), (right, "return")):
            scores = rows.groupby("k")[column]
            bands = np.array([interval(values.to_numpy()) for _, values in scores])
            axes.plot(scores.mean(), "o-", color=colour(kind), markersize=3, label=kind)
            axes.fill_between(scores.mean().index, *bands.T, color=colour(kind), alpha=0.15, linewidth=0)
    whole = table[table["map"] == "none"]["return"].mean()
    right.axhline(whole, color=GREY, linewidth=0.8, zorder=0)
    right.annotate(
        "as learned", (DIMENSIONS[0], whole), xytext=(0, 2), textcoords="offset points", color=GREY
    )
    left.set(xlabel="k", ylabel="energy of the torques missed", xticks=DIMENSIONS)
    right.set(xlabel="k", ylabel="return through the map", xticks=DIMENSIONS)
    left.legend()
    save_figure(figure, RESULTS / "planes.png")


if __name__ == "__main__":
    main()
