"""DDPG on WAMWipe with many learners on one GPU and all cores: learner-steps a second, and what they learn.

The search's setting, as in ``population.py``: networks of 2 x 128, 40 updates per 400 steps, everything else drawn from
the paper's Table 2. The learners are shared among processes, so that the physics of one hides the updates of another.
Prints a table and writes the learners' scores to ``results/population/scores_DEVICE.csv``.

    python benchmarks/speed/population_gpu.py --map MAP --processes 4 --steps 100000            # on a GPU
    python benchmarks/speed/population_gpu.py --map MAP --processes 2 --steps 100000 --device cpu --bfloat16

The map is one of WAMWipe, ``python -m nht.recipes.train_map env=wam_wipe map=nht``.
"""

from __future__ import annotations

import argparse
import contextlib
import json
import os
import resource
import subprocess
import sys
import tempfile
import threading
import time
from copy import deepcopy
from dataclasses import replace
from pathlib import Path

import pandas
import torch
from omegaconf import OmegaConf
from taking_turns import provenance

from nht.recipes.agents.table import find_algorithm
from nht.recipes.launch import configure
from nht.recipes.run.metrics import FRAMES, SUCCESS, tested
from nht.recipes.run.population import DIVERGED_FILE
from nht.recipes.study.space import draw_settings

HERE = Path(__file__).parents[1]
OUT = HERE / "results" / "population"
SPACE = OmegaConf.to_container(OmegaConf.load(HERE.parent / "configs" / "search" / "wam.yaml"))["space"]
SETTING = (
    "env=wam_wipe",
    "env.num_envs=40",
    "algo.hidden=[128,128]",
    "algo.frames_per_batch=400",
    "algo.updates_per_batch=40",
    "evaluation.every=20000",
    "evaluation.episodes=25",
    "evaluation.final_episodes=100",
    "evaluation.video=false",
    "run.wandb=false",
)


def learners_of(pack: int, packs: int, learners: int) -> list[int]:
    """The numbers of the learners of one pack: packs have learners of nearly the same batch size."""
    sizes = {number: draw_settings(SPACE, 0, number, "nht")["algo.batch_size"] for number in range(learners)}
    in_order = sorted(sizes, key=lambda number: sizes[number])
    return in_order[pack * learners // packs : (pack + 1) * learners // packs]


def train(pack: int, told: argparse.Namespace) -> None:
    """Train one pack; a row for each learner and evaluation goes to the folder."""
    own = learners_of(pack, told.processes, told.learners)
    schema = find_algorithm("ddpg")
    folder = Path(told.folder)
    shared = [
        *SETTING,
        f"env.num_threads={told.threads}",
        f"map.file={told.map}",
        f"algo.total_frames={told.steps}",
        f"run.checkpoint_every={told.steps}",
        f"algo.buffer_size={told.steps}",
        f"algo.bfloat16={told.bfloat16}",
        f"tf32={told.tf32}",
        f"device={told.device}",
        f"run.folder={folder}/none",
    ]
    base = configure(schema.schema, "ddpg", shared)
    configs = []
    for number in own:
        drawn = {
            name.removeprefix("algo."): value
            for name, value in draw_settings(SPACE, 0, number, "nht").items()
            if name.startswith("algo.")
        }
        run = replace(base.run, folder=str(folder / str(number)))
        configs.append(replace(deepcopy(base), algo=replace(base.algo, **drawn), seed=number, run=run))
    with (
        (folder / f"pack-{pack}.log").open("w") as log,
        contextlib.redirect_stdout(log),
        contextlib.redirect_stderr(log),
    ):
        schema.train(*configs, together=str(folder / f"pack-{pack}"))


def measure(told: argparse.Namespace) -> dict[str, object]:
    """Train all packs at once; what the machine did meanwhile, and the scores."""
    with tempfile.TemporaryDirectory() as scratch:
        words = [word for word in sys.argv[1:] if word != "--keep"]
        busy = Busy(told.device)
        began = time.time()
        packs = [
            subprocess.Popen(
                [sys.executable, __file__, *words, "--pack", str(pack), "--folder", scratch],
                env=os.environ | {"OMP_NUM_THREADS": "1"},
            )
            for pack in range(told.processes)
        ]
        failed = [pack for pack, process in enumerate(packs) if process.wait()]
        wall = time.time() - began
        if failed:
            sys.exit((Path(scratch) / f"pack-{failed[0]}.log").read_text()[-3000:])
        folders = [Path(scratch) / str(number) for number in range(told.learners)]
        rows = pandas.concat(
            pandas.read_csv(file).assign(learner=int(folder.name))
            for folder in folders
            if (file := folder / "metrics.csv").exists()
        )
        lost = {
            folder.name: json.loads(file.read_text())
            for folder in folders
            if (file := folder / DIVERGED_FILE).exists()
        }
    used = resource.getrusage(resource.RUSAGE_CHILDREN)
    # Between the first evaluation and the last: without what is done once.
    last, first = rows[FRAMES].max(), rows[FRAMES].min()
    seconds = rows[rows[FRAMES] == last]["seconds"].max() - rows[rows[FRAMES] == first]["seconds"].min()
    rate = told.learners * (last - first) / seconds if last > first else float("nan")
    final = rows[rows[FRAMES] == last][tested(SUCCESS)]
    half_width = 1.96 * final.std() / len(final) ** 0.5
    OUT.mkdir(parents=True, exist_ok=True)
    columns = ["learner", FRAMES, tested(SUCCESS), "seconds"]
    rows[columns].to_csv(OUT / f"scores_{told.device}.csv", index=False)
    return {
        "device": busy.name,
        "learners": told.learners,
        "processes": told.processes,
        "threads each": told.threads,
        "precision": "bfloat16" if told.bfloat16 else "TF32" if told.tf32 else "float32",
        "steps of a learner": told.steps,
        "learner-steps/s": round(rate),
        "wall [s]": round(wall, 1),
        "cores busy": round((used.ru_utime + used.ru_stime) / wall, 1),
        "GPU busy": busy.share(),
        "640 learners, 1,000,000 steps [min]": round(640e6 / rate / 60, 1),
        "success": f"{final.mean():.3f} +- {half_width:.3f}",
        "diverged": lost,
    }


class Busy:
    """How much of the time the GPU has work, as its driver samples it."""

    def __init__(self, device: str) -> None:
        self._samples: list[int] = []
        self.name = torch.cuda.get_device_name() if device.startswith("cuda") else "CPU"
        if device.startswith("cuda"):
            threading.Thread(target=self._sample, daemon=True).start()

    def _sample(self) -> None:
        while True:
            with contextlib.suppress(Exception):
                self._samples.append(torch.cuda.utilization())
            time.sleep(0.5)

    def share(self) -> float | None:
        """Mean share of the time."""
        return round(sum(self._samples) / len(self._samples) / 100, 2) if self._samples else None


def main() -> None:
    """Measure, or train one pack."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--map")
    parser.add_argument("--learners", type=int, default=128)
    parser.add_argument("--processes", type=int, default=4)
    parser.add_argument("--threads", type=int, default=4)
    parser.add_argument("--steps", type=int, default=100_000)
    parser.add_argument("--device", default="cuda")
    parser.add_argument("--bfloat16", action="store_true")
    parser.add_argument("--tf32", action="store_true")
    parser.add_argument("--pack", type=int)
    parser.add_argument("--folder")
    told = parser.parse_args()
    if told.map is None:
        return parser.print_help()
    if told.pack is not None:
        return train(told.pack, told)
    found = measure(told)
    print(json.dumps(found, indent=1))
    (OUT / f"gpu_{told.device}.json").write_text(json.dumps(found | {"provenance": provenance(1)}, indent=1))


if __name__ == "__main__":
    main()
