"""What stepping WAMWipe through TorchRL costs over bare ``mujoco.rollout``, and beside stepping copies one by one.

    OMP_NUM_THREADS=1 python benchmarks/stepping.py

- bare: one native call of ``mujoco.rollout`` for all N copies, with the same model, states, substeps and preallocated
  arrays, and nothing else: no actuation, kinematics, reward or tensors.
- TorchRL: ``step_and_maybe_reset`` of the batched environment. Random actuations are drawn beforehand; handing them
  over counts, and so do the resets of finished episodes.
- SyncVectorEnv(8), SerialEnv(8): eight copies of the same task as Gymnasium environments, stepped one by one by
  Gymnasium and by TorchRL.

After a warm-up all take turns in every round, so that a busy machine slows all alike. A ratio is the median over the
rounds of (env steps/s) / (env steps/s of the bare call with as many copies on one thread). Writes
``benchmarks/results/stepping.csv`` and fails if a ratio is below its floor.
"""

import argparse
import csv
import os
import platform
import statistics
import subprocess
import sys
import time
from collections.abc import Iterator
from dataclasses import dataclass, field
from importlib.metadata import version
from pathlib import Path

import gymnasium
import mujoco
import numpy as np
import torch
from mujoco import rollout
from tensordict import TensorDictBase
from torchrl.envs import EnvBase, GymEnv, SerialEnv

from nht.envs import GYMNASIUM_IDS, BatchedTask, make_env, make_task

TASK = "wam_wipe"
FLOORS = {64: 0.7, 256: 0.8}  # of TorchRL over bare by number of copies, on one thread
RESULTS = Path(__file__).parent / "results" / "stepping.csv"


@dataclass
class Method:
    """One way to step ``copies`` environments; every ``next`` of ``stepping`` steps all of them once."""

    name: str
    copies: int
    threads: int
    stepping: Iterator[None]
    seconds: list[float] = field(default_factory=list)  # per env step, a value per round
    cpu_seconds: list[float] = field(default_factory=list)

    def measure(self, env_steps: int) -> None:
        """Take about ``env_steps`` steps and note the time of one."""
        calls = env_steps // self.copies
        wall, cpu = time.perf_counter(), time.process_time()
        for _ in range(calls):
            next(self.stepping)
        self.seconds.append((time.perf_counter() - wall) / (calls * self.copies))
        self.cpu_seconds.append((time.process_time() - cpu) / (calls * self.copies))


def bare(copies: int, threads: int) -> Iterator[None]:
    task = moving_task(copies)
    state, control, trajectory = task.state.copy(), task._control.copy(), task._trajectory.copy()
    models, data = [task.model] * copies, [mujoco.MjData(task.model) for _ in range(threads)]
    with rollout.Rollout(nthread=threads if threads > 1 else 0) as pool:
        while True:
            pool.rollout(
                models, data, state, control, skip_checks=True, nstep=task.substeps, state=trajectory
            )
            yield


def moving_task(copies: int) -> BatchedTask:
    """Copies in the midst of random motion."""
    task = make_task(TASK, num_envs=copies)
    for actuation in random_actuations(task, 20):
        task.step(actuation)
    return task


def random_actuations(task: BatchedTask, count: int) -> np.ndarray:
    low, high = task.actuation_bounds
    return np.random.default_rng(0).uniform(low, high, (count, task.num_envs, low.size))


def torchrl(env: EnvBase, copies: int) -> Iterator[None]:
    drawn = random_actuations(make_task(TASK, num_envs=copies), 256)
    actions = torch.tensor(drawn, dtype=torch.float32).unbind()
    tensordict: TensorDictBase = env.reset()
    while True:
        for action in actions:
            _, tensordict = env.step_and_maybe_reset(tensordict.set("action", action))
            yield


def sync_vector(copies: int) -> Iterator[None]:
    actions = random_actuations(make_task(TASK, num_envs=copies), 256).astype(np.float32)
    env = gymnasium.vector.SyncVectorEnv([single_env] * copies)
    env.reset(seed=0)
    while True:
        for action in actions:
            env.step(action)
            yield


def single_env() -> gymnasium.Env[np.ndarray, np.ndarray]:
    return gymnasium.make(GYMNASIUM_IDS[TASK], disable_env_checker=True)


def make_methods() -> list[Method]:
    sizes = [(copies, threads) for copies in FLOORS for threads in (1, 2)]
    methods = [Method("bare", copies, threads, bare(copies, threads)) for copies, threads in sizes]
    methods += [
        Method("TorchRL", copies, threads, torchrl(make_env(TASK, copies, threads), copies))
        for copies, threads in sizes
    ]
    serial = SerialEnv(8, lambda: GymEnv(GYMNASIUM_IDS[TASK]))
    methods.append(Method("SyncVectorEnv", 8, 1, sync_vector(8)))
    methods.append(Method("SerialEnv", 8, 1, torchrl(serial, 8)))
    return methods


def summarise(methods: list[Method]) -> list[dict[str, str | int | float]]:
    baselines = {method.copies: method for method in methods if method.name == "bare" and method.threads == 1}
    rows = []
    for method in methods:
        baseline = baselines.get(method.copies, baselines[min(baselines)])
        ratios = [base / own for base, own in zip(baseline.seconds, method.seconds, strict=True)]
        rates = [1 / seconds for seconds in method.seconds]
        rows.append(
            {
                "method": method.name,
                "copies": method.copies,
                "threads": method.threads,
                "env steps/s": round(statistics.median(rates)),
                "10 %": round(tenths(rates)[0]),
                "90 %": round(tenths(rates)[1]),
                "ratio": round(statistics.median(ratios), 3),
                "ratio 10 %": round(tenths(ratios)[0], 3),
                "ratio 90 %": round(tenths(ratios)[1], 3),
                "CPU us/env step": round(1e6 * statistics.median(method.cpu_seconds), 1),
            }
        )
    return rows


def tenths(values: list[float]) -> tuple[float, float]:
    deciles = statistics.quantiles(values, n=10)
    return deciles[0], deciles[-1]


def provenance(rounds: int) -> dict[str, str]:
    packages = ("mujoco", "torch", "torchrl", "tensordict", "gymnasium", "numpy")
    return {
        "command": " ".join(["python", os.path.relpath(sys.argv[0]), *sys.argv[1:]]),
        "commit": commit(),
        "processor": f"{processor()}, {os.cpu_count()} cores, load average {os.getloadavg()[0]:.1f}",
        "versions": ", ".join(
            [f"Python {platform.python_version()}", *(f"{p} {version(p)}" for p in packages)]
        ),
        "rounds": str(rounds),
    }


def commit() -> str:
    def git(*arguments: str) -> str:
        return subprocess.run(
            ["git", *arguments], cwd=Path(__file__).parents[1], capture_output=True, text=True, check=True
        ).stdout.strip()

    changed = git("status", "--porcelain", "--untracked-files=no", "--", "envs", "benchmarks/stepping.py")
    return git("rev-parse", "--short", "HEAD") + (" with changes" if changed else "")


def processor() -> str:
    names = [line for line in Path("/proc/cpuinfo").read_text().splitlines() if line.startswith("model name")]
    return names[0].split(":")[1].strip() if names else platform.processor()


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--rounds", type=int, default=30)
    parser.add_argument("--env-steps", type=int, default=4096, help="of every method in a round")
    options = parser.parse_args()
    torch.set_num_threads(1)
    header = provenance(options.rounds)

    methods = make_methods()
    for number in range(options.rounds + 2):
        for method in methods if number % 2 else reversed(methods):
            method.measure(options.env_steps)
    for method in methods:  # the first two rounds were the warm-up
        del method.seconds[:2], method.cpu_seconds[:2]

    rows = summarise(methods)
    write(rows, header)
    print("\n".join(f"{key}: {value}" for key, value in header.items()) + "\n")
    show(rows)
    check_floors(rows)


def write(rows: list[dict[str, str | int | float]], header: dict[str, str]) -> None:
    RESULTS.parent.mkdir(exist_ok=True)
    with RESULTS.open("w", newline="") as file:
        file.writelines(f"# {key}: {value}\n" for key, value in header.items())
        writer = csv.DictWriter(file, fieldnames=list(rows[0]), lineterminator="\n")
        writer.writeheader()
        writer.writerows(rows)


def show(rows: list[dict[str, str | int | float]]) -> None:
    table = [list(rows[0]), *([str(value) for value in row.values()] for row in rows)]
    widths = [max(map(len, column)) for column in zip(*table, strict=True)]
    for line in table:
        print("  ".join(cell.rjust(width) for cell, width in zip(line, widths, strict=True)))


def check_floors(rows: list[dict[str, str | int | float]]) -> None:
    ratios = {
        row["copies"]: row["ratio"] for row in rows if row["method"] == "TorchRL" and row["threads"] == 1
    }
    missed = [f"{ratios[n]} at {n} copies, floor {floor}" for n, floor in FLOORS.items() if ratios[n] < floor]
    if missed:
        sys.exit("TorchRL is too slow beside the bare call: " + "; ".join(missed))
    print("\nTorchRL over bare on one thread is above its floors: " + str(FLOORS))


if __name__ == "__main__":
    main()
