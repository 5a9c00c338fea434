"""Maps of a position-controlled arm, whose actuations rest at its joint angles: held-out errors by kind of offset.

WAMWipe's expert gives joint velocities v at joint angles q; a position servo that closes a gap within ``LEAD`` seconds
makes the same motion of targets q + LEAD v, which are the demonstrated actuations here. "error" is relative to the
targets, as everywhere; "motion error" to LEAD v, the part of them that moves the arm.

20,000 transitions, networks of 2 x 128, 3,000 steps, one thread. Writes ``benchmarks/results/offset/offset.csv``.

    python benchmarks/maps/offset.py
"""

from __future__ import annotations

import csv
import logging
import tempfile
from itertools import product
from pathlib import Path

import torch
from omegaconf import OmegaConf

import nht
from nht.recipes.data.recording import record_expert
from nht.recipes.maps.kinds import task_context_keys
from nht.recipes.sections import DemosConfig, EnvConfig
from nht.training_data import split_episodes

LEAD = 0.2  # [s]
KINDS = ("svd", "scl", "nht")
OFFSETS = ("none", "constant", "contextual")
SEEDS = range(3)
HERE = Path(__file__).parents[1]
OUT = HERE / "results" / "offset" / "offset.csv"


def main() -> None:
    torch.set_num_threads(1)
    logging.disable(logging.INFO)
    demos, motion, keys = demonstrations()
    with OUT.open("w", newline="") as file:
        writer = csv.writer(file)
        writer.writerow(["map", "offset", "seed", "error", "motion error", "action_scale", "seconds"])
        for seed, kind, offset in product(SEEDS, KINDS, OFFSETS):
            width = demos.context(keys).shape[-1]
            if kind == "svd":
                map = nht.SVD(7, 2, width, offset=offset)
            else:
                make = nht.NHT if kind == "nht" else nht.SCL
                map = make(width, 7, 2, (128, 128), offset=offset, normalise=True, seed=seed)
            found = nht.train_map(demos, map, context_keys=keys, max_steps=3_000, seed=seed).metrics
            held_out = split_episodes(demos.episode, 0.1, seed)
            error = found["validation_error"]
            share = demos.actuation[held_out].square().sum() / motion[held_out].square().sum()
            row = [
                kind,
                offset,
                seed,
                error,
                error * float(share),
                found["action_scale"],
                round(found["seconds"], 1),
            ]
            writer.writerow(row)
            file.flush()
            print(row, flush=True)


def demonstrations() -> tuple[nht.Demos, torch.Tensor, list[str]]:
    """Joint targets as actuations; beside them LEAD v and the context's keys."""
    env = EnvConfig(**OmegaConf.to_container(OmegaConf.load(HERE.parent / "configs/env/wam_wipe.yaml")))
    with tempfile.TemporaryDirectory() as scratch:
        recorded = record_expert(env, DemosConfig(transitions=20_000), seed=0, path=Path(scratch) / "demos")
        context = {key: recorded.data[key].clone() for key in task_context_keys(env)}
        motion = LEAD * recorded.actuation.clone()
        target = recorded.data["joint_angle"].to(motion) + motion
        episode = recorded.episode.clone()
    return (
        nht.Demos.from_tensors(actuation=target, episode=episode, context=context),
        motion,
        task_context_keys(env),
    )


if __name__ == "__main__":
    main()
