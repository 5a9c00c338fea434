"""HalfCheetah through interfaces: settings found with equal care for each, then five fresh seeds at 1,003,520 steps.

PPO through raw torques, SVD's plane and NHT (k = 2), the latter two with and without corrections (a residual of 0.3).

1. *Demonstrations*: the committed episode, as the paper has it; and ten episodes of three stages of an expert's
   learning, after 307,200, 614,400 and 1,003,520 steps.
2. *Trials*: eight settings for each interface, two seeds each, 307,200 steps. Raw torques have one setting, the action
   scale; SVD two, all pairs of which are tried; NHT four of two levels each, of which every other combination is tried,
   so that each level is seen four times and what a pair of settings does together is not taken for what one does.
   Of each of NHT's four settings the level that did better in the mean is kept; otherwise, where all combinations were
   tried, the best of them.
3. *A second round*, for maps: what happens at the motors' limits, with the scale (SVD) or the Lipschitz limit (NHT),
   all pairs, from what the first round kept.
4. What was kept is taken to 1,003,520 steps.

Each stage trains the seeds and settings of an interface as one population. Writes trials, curves, a table and a figure
to ``results/half_cheetah_interfaces``.

    python benchmarks/learning/half_cheetah_interfaces.py FOLDER [INTERFACE ...]
"""

from __future__ import annotations

import itertools
import sys
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import pandas
import torch

import nht
from nht.recipes.run.metrics import FRAMES, RETURN, SECONDS, tested
from nht.recipes.study.curves import plot, summarise
from nht.recipes.study.report import to_markdown
from populations import made, trained_runs, trained_together

RESULTS = Path(__file__).parents[1] / "results" / "half_cheetah_interfaces"
DEMOS = Path(__file__).parents[1] / "demos"
EPISODES = {"one": DEMOS / "half_cheetah", "sac": DEMOS / "half_cheetah_sac"}
"""One episode of a policy that PPO learned, and of one that SAC learned; ``ten`` are recorded here."""
EXPERT = {307_200: 3, 614_400: 3, 1_003_520: 4}
"""Steps of learning, and the number of episodes that are recorded after them."""

TASK = ["env=half_cheetah", "evaluation.episodes=10"]
TRIAL = [*TASK, "algo.total_frames=307_200", "evaluation.every=102_400", "run.checkpoint_every=102_400"]
WHOLE = [
    *TASK,
    "algo.total_frames=1_003_520",
    "evaluation.every=71_680",
    "evaluation.final_episodes=50",
    "run.checkpoint_every=143_360",
]
TRIED, FRESH = range(2), range(100, 105)
"""Seeds of the trials, and of the experiment."""

Setting = Mapping[str, Any]
PLANE = {"scale": (1.0, 1.75, 2.5, 3.5), "episodes": ("one", "ten")}
BASIS = {
    "scale": (1.75, 3.5),
    "episodes": ("one", "ten"),
    "lipschitz": (0.03, 0.1),
    "context": ("observation", "joint_angle"),
}
LIMITS = {"saturation": ("scale", "clip")}
PLANE_AGAIN = {"scale": (2.5, 3.5, 5.0)} | LIMITS
BASIS_AGAIN = {"lipschitz": (0.03, 0.1, 0.3, "no limit")} | LIMITS
Levels = Mapping[str, tuple[Any, ...]]
INTERFACES: dict[str, tuple[Levels, ...]] = {
    "raw": ({"scale": (1.0, 1.5, 2.0, 2.5, 3.0, 3.5, 5.0, 7.0)},),
    "svd": (PLANE, PLANE_AGAIN),
    "svd, corrected": (PLANE, PLANE_AGAIN),
    "nht": (BASIS, BASIS_AGAIN),
    "nht, corrected": (BASIS, BASIS_AGAIN),
}
"""Of each interface the rounds of its trials: settings, and their levels."""


def main() -> None:
    """Record, try and train what is missing, and show what was learned."""
    folder = Path(sys.argv[1]).resolve()
    record_ten_episodes(folder)
    trials, curves = [], []
    for interface in sys.argv[2:] or INTERFACES:
        best: dict[str, Any] = {}
        for round, levels in enumerate(INTERFACES[interface], start=1):
            tried = try_out(interface, levels, best, round, folder)
            trials.append(tried)
            best |= chosen(tried, levels)
            print(interface, best, flush=True)
        run = folder / "whole" / "-".join([interface.replace(", ", "-"), *map(str, best.values())])
        found = trained_runs(run, [*WHOLE, *told(interface, best, folder)], FRESH, "ppo")
        curves.append(found.assign(interface=interface))
        save(trials, curves, RESULTS)


def record_ten_episodes(folder: Path) -> None:
    """Ten episodes of three stages of an expert's learning, in ``folder/ten``."""
    if (folder / "ten").exists():
        return
    parts, episodes = [], 0
    for steps, count in EXPERT.items():
        learning = [*TASK, "map=none", "map.action_scale=3.0", f"algo.total_frames={steps}"]
        every = [f"evaluation.every={steps}", "run.checkpoint_every=102_400"]
        trained_runs(folder / "experts" / str(steps), [*learning, *every], range(10, 11), "ppo")
        (source,) = (folder / "experts" / str(steps)).rglob("policy.safetensors")
        asked = ["env=half_cheetah", "source=policy", f"source.path={source.parent}"]
        recorded = made(
            folder / f"stage-{steps}", "collect_demos", [*asked, f"demos.transitions={1_000 * count}"]
        )
        data = nht.load_demos(recorded).data.clone()
        data["episode"] += episodes
        episodes += count
        parts.append(data)
    nht.save_demos(torch.cat(parts), folder / "ten", env="half_cheetah")


def try_out(interface: str, levels: Levels, kept: Setting, round: int, folder: Path) -> pandas.DataFrame:
    """The trials of a round, beside what earlier ones kept: settings, seed and return."""
    settings, rows = [{**kept, **setting} for setting in half_of(levels)], []
    # Learners share every call, so maps of a population have contexts and actions of one width.
    for width in dict.fromkeys(map(widths, settings)):
        learners, tried = {}, []
        for setting, seed in itertools.product(settings, TRIED):
            if widths(setting) == width:
                name = "-".join([*(f"{name}={value}" for name, value in setting.items()), f"seed={seed}"])
                learners[name] = [*TRIAL, *told(interface, setting, folder), f"seed={seed}"]
                tried.append({"interface": interface, "round": round, **setting, "seed": seed})
        name = f"{interface.replace(', ', '-')}-{width}{'-again' * (round - 1)}"
        runs = trained_together(folder / "trials" / name, learners, "ppo")
        for row, found in zip(tried, runs.values(), strict=True):
            rows.append(row | {tested(RETURN): float(found[tested(RETURN)].iloc[-1])})
    return pandas.DataFrame(rows)


def widths(setting: Setting) -> str:
    """What the widths of a map's context and action depend on."""
    return f"{setting.get('context', '')}{setting.get('k', '')}"


def half_of(levels: Levels) -> list[Setting]:
    """All combinations; of four settings every other one, those whose levels' places add up to an even number."""
    places = itertools.product(*(range(len(values)) for values in levels.values()))
    kept = [each for each in places if not halved(levels) or sum(each) % 2 == 0]
    return [
        {name: values[place] for (name, values), place in zip(levels.items(), each, strict=True)}
        for each in kept
    ]


def halved(levels: Levels) -> bool:
    """Whether not all of the combinations are tried."""
    return len(levels) == 4


def chosen(trials: pandas.DataFrame, levels: Levels) -> Setting:
    """The combination with the highest mean return; of half of them, of every setting the level."""
    names = list(levels)
    if halved(levels):
        return {name: trials.groupby(name, sort=False)[tested(RETURN)].mean().idxmax() for name in names}
    best = trials.groupby(names, sort=False)[tested(RETURN)].mean().reset_index()
    return dict(best.loc[best[tested(RETURN)].idxmax(), names])


def told(interface: str, setting: Setting, folder: Path) -> list[str]:
    """What a run is told of its interface, whose map is trained first if need be."""
    scale = f"map.action_scale={setting['scale']}"
    kind, _, corrected = interface.partition(", ")
    if kind == "raw":
        return ["map=none", scale]
    k, shown = setting.get("k", 2), setting["episodes"]
    name = f"{kind}-{shown}{f'-{k}' if k != 2 else ''}"
    asked = [f"map={kind}", f"map.action_dim={k}", f"demos.path={EPISODES.get(shown, folder / shown)}"]
    if kind == "nht":
        limit = "null" if setting["lipschitz"] == "no limit" else setting["lipschitz"]
        name += f"-{limit}-{setting['context']}"
        asked += [f"map.lipschitz={limit}", f"env.context_keys=[{setting['context']}]"]
    map = made(folder / f"{name}.safetensors", "train_map", ["env=half_cheetah", *asked])
    more = ["map.residual=0.3"] if corrected else []
    more += [f"map.saturation={setting['saturation']}"] if "saturation" in setting else []
    return [f"map={kind}", f"map.file={map}", scale, *more]


def save(trials: Sequence[pandas.DataFrame], parts: Sequence[pandas.DataFrame], out: Path) -> None:
    """Write rows, table and figure."""
    out.mkdir(parents=True, exist_ok=True)
    pandas.concat(trials, ignore_index=True).to_csv(out / "trials.csv", index=False)
    curves = pandas.concat(parts, ignore_index=True)
    columns = ["task", "interface", "seed", FRAMES, tested(RETURN), SECONDS]
    curves[columns].to_csv(out / "curves.csv", index=False)
    table = summarise(curves, RETURN)
    (out / "table.md").write_text(to_markdown(table))
    draw(curves, out)
    print(table.to_string(index=False), flush=True)


def draw(curves: pandas.DataFrame, out: Path) -> None:
    """The figure of ``out``; what is corrected, which does not pay, is in the table only."""
    shown = curves[~curves["interface"].str.endswith("corrected")]
    plot(shown, RETURN, "HalfCheetah, PPO", out / "return.png")


if __name__ == "__main__":
    main()
