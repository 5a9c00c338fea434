"""What a learner costs alone and in a population: core-seconds per learner and 1,000,000 environment steps.

The whole recipes run, physics, replay and evaluations included, in one process with one torch thread, each in a process
of its own. Settings:

- ``search``: DDPG of the search on WAMWipe through NHT: networks of 2 x 128, 40 updates per 400 steps, learning rates,
  noise, batch sizes and so on drawn from the paper's Table 2; 25 test episodes every 20,000 steps. As packs of a
  search, learners are of nearly one batch size, here around its mean.
- ``paper``: the paper's own DDPG: 3 x 256, 40 updates of 256 per 200 steps.
- ``ppo``: OpenAI's ppo2 on HalfCheetah: 2 x 64, 32 x 10 minibatches of 64 per 2,048 steps, 16 copies a learner.

Beside them one learner with the same networks, batch and ratio, of stable-baselines3, and of SBX and CleanRL where it
is said which Python has them (``other_libraries.py``). Every figure is the difference of two lengths of the run, so
that starting does not count; an evaluation is measured apart. Rounds take turns; the median counts, the spread is
printed. Writes CSV, table and figure to ``results/population``.

    OMP_NUM_THREADS=1 python benchmarks/speed/population.py [search | paper | ppo ...] [rounds=3] \
        [sbx=PYTHON] [cleanrl=PYTHON:CHECKOUT]
"""

from __future__ import annotations

import contextlib
import csv
import io
import json
import resource
import subprocess
import sys
import tempfile
import time
from copy import deepcopy
from dataclasses import replace
from pathlib import Path
from typing import Any

import matplotlib.pyplot as plt
import pandas
import torch
from omegaconf import OmegaConf
from taking_turns import provenance

import nht
from nht.recipes.agents.table import find_algorithm
from nht.recipes.figure_style import PAGE, save_figure, style
from nht.recipes.launch import configure
from nht.recipes.sections import Training
from nht.recipes.study.space import draw_settings

HERE = Path(__file__).parents[1]
OUT = HERE / "results" / "population"
OTHERS = Path(__file__).with_name("other_libraries.py")
SPACE = OmegaConf.to_container(OmegaConf.load(HERE.parent / "configs" / "search" / "wam.yaml"))["space"]
EVERY, EVALUATIONS = 20_000, 50  # steps between evaluations, evaluations in 1,000,000 steps
QUIET = ["evaluation.video=false", "run.wandb=false", "run.checkpoint_every=${algo.total_frames}"]

SETTINGS: dict[str, list[str]] = {
    "search": [
        "env=wam_wipe",
        "env.num_envs=40",
        "algo.hidden=[128,128]",
        "algo.frames_per_batch=400",
        "algo.updates_per_batch=40",
        "algo.warmup_frames=0",
        "evaluation.episodes=25",
    ],
    "paper": ["env=wam_wipe", "algo=ddpg_paper", "evaluation.episodes=25"],
    "ppo": ["env=half_cheetah", "map=none", "algo=ppo_paper", "env.num_envs=16", "evaluation.episodes=10"],
}
LENGTHS = {"search": (400, 2_000), "paper": (200, 800), "ppo": (2_048, 4_096)}  # steps
COLUMNS = ("setting", "who", "learners", "bfloat16", "round", "core_seconds", "evaluations", "memory")
MEAN_BATCH = 144  # of Table 2
COUNTS = (1, 4, 16, 64, 256)
PLAN = {
    "search": [(1, False), (16, False), *((count, True) for count in COUNTS)],
    "paper": [(1, False), (1, True), (4, True), (16, True)],
    "ppo": [(count, False) for count in COUNTS],
}


def drawn(learners: int) -> list[dict[str, Any]]:
    """Draws from Table 2 for a pack's learners: of many, those with batch sizes nearest to the mean."""
    many = [draw_settings(SPACE, 0, number, "nht") for number in range(8 * learners)]
    many.sort(key=lambda one: abs(one["algo.batch_size"] - MEAN_BATCH))
    return [
        {name.removeprefix("algo."): value for name, value in one.items() if name.startswith("algo.")}
        for one in many[:learners]
    ]


def train(setting: str, learners: int, half: bool, steps: int, every: int) -> float:
    """Processor seconds of a run."""
    with tempfile.TemporaryDirectory() as scratch:
        folder = Path(scratch)
        configs = configured(
            setting, learners, folder, [f"algo.total_frames={steps}", f"evaluation.every={every}"], half
        )
        with contextlib.redirect_stdout(io.StringIO()), contextlib.redirect_stderr(io.StringIO()):
            began = time.process_time()
            together = str(folder / "together") if learners > 1 else None
            find_algorithm(algorithm(setting)).train(*configs, together=together)
            return time.process_time() - began


def algorithm(setting: str) -> str:
    """What learns in a setting."""
    return "ppo" if setting == "ppo" else "ddpg"


def configured(setting: str, learners: int, folder: Path, more: list[str], half: bool) -> list[Training]:
    """The settings of every learner."""
    told = [*SETTINGS[setting], *QUIET, *more, f"run.folder={folder}/none"]
    if setting != "ppo":
        map = nht.NHT(10, 7, 2, hidden=(64, 64)).eval()
        map.context_keys = ("tool_position", "joint_angle")
        nht.save_map(map, folder / "map.safetensors")
        told += [f"map.file={folder}/map.safetensors", f"algo.bfloat16={half}"]
    base = configure(find_algorithm(algorithm(setting)).schema, algorithm(setting), told)
    draws = drawn(learners) if setting == "search" else learners * [{}]
    return [
        replace(
            deepcopy(base),
            algo=replace(base.algo, **own),
            seed=seed,
            run=replace(base.run, folder=str(folder / str(seed))),
        )
        for seed, own in enumerate(draws)
    ]


def cost(setting: str, learners: int, half: bool) -> dict[str, float]:
    """Core-seconds per learner and 1,000,000 steps, and the largest memory [MB]."""
    few = max(1, 16 // learners)  # whose runs are longer: starting takes seconds, and not always as many
    short, long = (few * steps for steps in LENGTHS[setting])
    train(setting, learners, half, short, short)  # warm-up
    before, after = (train(setting, learners, half, steps, steps) for steps in (short, long))
    often = train(setting, learners, half, long, short)
    a_test = (often - after) / (long / short - 1)
    stepping = (after - before) / (long - short)
    million = (stepping * 1e6 + a_test * EVALUATIONS) / learners
    memory = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024
    return {"core_seconds": million, "evaluations": a_test * EVALUATIONS / learners, "memory": memory}


def measured(
    who: str, setting: str, learners: int, half: bool, pythons: dict[str, list[str]]
) -> dict[str, float]:
    """A measurement in a process of its own; of another library in the Python that has it."""
    if who == "nht":
        command = [sys.executable, __file__, "measure", setting, str(learners), str(half)]
    else:
        python, *checkout = pythons.get(who, [sys.executable])
        command = [python, str(OTHERS), who, setting, *(checkout or [str(learners)])]
    found = subprocess.run(command, capture_output=True, text=True)
    if found.returncode:
        raise RuntimeError(found.stderr)
    return json.loads(found.stdout.strip().splitlines()[-1])


def benchmark(chosen: list[str], rounds: int, pythons: dict[str, list[str]]) -> None:
    """All measurements in turn, round after round."""
    plan: list[tuple[str, str, int, bool]] = []
    for setting in chosen:
        plan += [(setting, "nht", learners, half) for learners, half in PLAN[setting]]
        for who in ("stable-baselines3", *pythons):
            many = 16 if setting == "ppo" else 10
            plan += [(setting, who, copies, False) for copies in ((1,) if who == "cleanrl" else (1, many))]
    OUT.mkdir(parents=True, exist_ok=True)
    file = OUT / "rounds.csv"
    fresh = not file.exists()
    with file.open("a", newline="") as handle:
        writer = csv.writer(handle)
        if fresh:
            writer.writerow(COLUMNS)
        for number in range(rounds):
            for setting, who, learners, half in plan:
                found = measured(who, setting, learners, half, pythons)
                writer.writerow(
                    (setting, who, learners, half, number, *(round(v, 2) for v in found.values()))
                )
                handle.flush()
                print(setting, who, learners, half, {k: round(v, 1) for k, v in found.items()}, flush=True)
    show(file)
    (OUT / "provenance.json").write_text(json.dumps(provenance(rounds), indent=1))


def show(file: Path) -> None:
    """Medians and spreads as a table, and the figure."""
    rows = pandas.read_csv(file)
    groups = rows.groupby(["setting", "who", "learners", "bfloat16"])
    table = groups["core_seconds"].agg(["median", "min", "max", "count"])
    table["of them evaluations"] = groups["evaluations"].median()
    table["memory [MB]"] = groups["memory"].median()
    print(table.round(0).to_string())
    draw(rows)


@style()
def draw(rows: pandas.DataFrame) -> None:
    """How cost and memory grow with the learners."""
    figure, (left, right) = plt.subplots(1, 2, figsize=(PAGE, 0.38 * PAGE), layout="constrained")
    for (setting, half), own in rows[rows["who"] == "nht"].groupby(["setting", "bfloat16"]):
        medians = own.groupby("learners")[["core_seconds", "memory"]].median()
        if len(medians) > 2:
            label = f"{setting}{', bfloat16' if half else ''}"
            left.plot(medians.index, medians["core_seconds"], "o-", label=label)
            right.plot(medians.index, medians["memory"], "o-", label=label)
    left.set(ylabel="core-seconds per learner and 1M steps")
    right.set(ylabel="memory of the process [MB]")
    left.legend()
    for axes in (left, right):
        axes.set(xscale="log", xlabel="learners", ylim=(0, None))
        axes.set_xticks(COUNTS, [str(count) for count in COUNTS])
        axes.minorticks_off()
    save_figure(figure, OUT / "growth.png")


def main() -> None:
    """Measure everything that was asked for, or one population."""
    torch.set_num_threads(1)
    words = sys.argv[1:]
    if words[:1] == ["measure"]:
        _, setting, learners, half = words
        print(json.dumps(cost(setting, int(learners), half == "True")))
        return
    told = dict(word.split("=", 1) for word in words if "=" in word)
    pythons = {who: told[who].split(":") for who in ("sbx", "cleanrl") if who in told}
    benchmark([word for word in words if word in PLAN] or list(PLAN), int(told.get("rounds", 3)), pythons)


if __name__ == "__main__":
    main()
