"""Checks that a GPU computes the same as the CPU, and how fast.

python benchmarks/speed/gpu_check.py                 # on a GPU, less than ten minutes
python benchmarks/speed/gpu_check.py --device cpu    # the same steps where there is none
"""

from __future__ import annotations

import argparse
import subprocess
import sys
import tempfile
from collections.abc import Iterator, Sequence
from pathlib import Path

import pandas
import torch

from nht.recipes.agents.table import find_algorithm
from nht.recipes.launch import configure

ROOT = Path(__file__).resolve().parents[2]
TASKS = {"wam_wipe": "nht", "half_cheetah": "none"}
"""The tasks, each with its kind of map."""
ALGORITHMS = ("ddpg", "td3", "sac", "ppo")
OFF_POLICY = ("algo.warmup_frames=0", "algo.updates_per_batch=20", "algo.random_frames=0")
ON_POLICY = ("algo.frames_per_batch=2000", "env.num_envs=10")
SHARED = (
    "algo.total_frames=4000",
    "evaluation.every=2000",
    "evaluation.episodes=5",
    "evaluation.video=false",
    "run.checkpoint_every=4000",
    "run.wandb=false",
    "demos.transitions=2000",
    "map.max_steps=200",
    "env.options.max_episode_steps=200",
)


def main() -> None:
    """Run the GPU's tests, then train a little with every algorithm, on the device and on the CPU."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--device", default="cuda")
    parser.add_argument("--algorithms", nargs="+", choices=ALGORITHMS, default=ALGORITHMS)
    parser.add_argument("--tests", action=argparse.BooleanOptionalAction, default=True)
    told = parser.parse_args()
    print(f"torch {torch.__version__}, {name_of(told.device)}")
    if told.tests:
        run_tests()
    with tempfile.TemporaryDirectory() as scratch:
        rows = list(compared(Path(scratch), told.device, told.algorithms))
    print(pandas.DataFrame(rows).to_string(index=False))


def name_of(device: str) -> str:
    """The name of the device, for messages."""
    return torch.cuda.get_device_name() if device.startswith("cuda") else device


def run_tests() -> None:
    """Run the tests that need a GPU, and those of code that must never wait for one."""
    files = ["tests/envs/test_envs.py", "tests/transforms/test_transform_specs.py"]
    files += ["tests/nht/test_maps_on_gpus.py", "tests/recipes/agents/test_updates_on_gpus.py"]
    command = [
        sys.executable,
        "-m",
        "pytest",
        "-q",
        "--import-mode=importlib",
        "-k",
        "cuda or gpu or test_device",
        *files,
    ]
    subprocess.run(command, cwd=ROOT, check=True)


def compared(scratch: Path, device: str, algorithms: Sequence[str]) -> Iterator[dict[str, object]]:
    """A row for every task and algorithm: speeds of one learner. Every device draws numbers of its own."""
    for task, map in TASKS.items():
        for algorithm in algorithms:
            slow, fast = (
                trained(scratch / f"{task}-{algorithm}-{place}", task, map, algorithm, where)
                for place, where in (("cpu", "cpu"), ("device", device))
            )
            yield {
                "task": task,
                "algorithm": algorithm,
                "frames/s": round(fast["frames"] / fast["seconds"], 1),
                "frames/s on the CPU": round(slow["frames"] / slow["seconds"], 1),
                "ms an update, all told": round(1e3 * fast["seconds"] / fast["updates"], 2),
            }


def trained(folder: Path, task: str, map: str, algorithm: str, device: str) -> pandas.Series:
    """What the second half of a short run took; in the first, kernels are loaded."""
    record = find_algorithm(algorithm)
    own = ON_POLICY if algorithm == "ppo" else OFF_POLICY
    overrides = [f"env={task}", f"map={map}", *SHARED, *own, f"device={device}", f"run.folder={folder}"]
    record.train(configure(record.schema, algorithm, overrides))
    return pandas.read_csv(folder / "metrics.csv")[["frames", "updates", "seconds"]].diff().iloc[-1]


if __name__ == "__main__":
    main()
