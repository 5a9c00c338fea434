"""What stepping through TorchRL costs over bare ``mujoco.rollout``, and beside stepping copies one by one.

    OMP_NUM_THREADS=1 python benchmarks/speed/stepping.py [--tasks half_cheetah hopper] [--envpool PYTHON]

- bare: one native call of ``mujoco.rollout`` for all N copies, with the same model and substeps, from states and with
  controls that the task went through in random motion, into preallocated arrays; and nothing else: no kinematics,
  observation, reward or tensors.
- TorchRL: ``step_and_maybe_reset`` of the batched environment. Random actuations are drawn beforehand; handing them
  over counts, and so do the resets of finished episodes.
- SyncVectorEnv(8), SerialEnv(8): eight Gymnasium environments, stepped one by one by Gymnasium and by TorchRL
  (``GymEnv``): Gymnasium's own, or for a task that it does not have, ours.
- EnvPool, only where asked for: HalfCheetah-v5, in a process of the Python that has ``envpool``.

After a warm-up all take turns in every round, so that a busy machine slows all alike. A ratio is the median over the
rounds of (env steps/s) / (env steps/s of the bare call with as many copies on one thread). Other programs on the same
cores disturb it, but hardly the CPU ratio, of processor times, which means the same on one thread. Writes
``benchmarks/results/stepping/stepping.csv`` and fails if a CPU ratio on one thread is below its floor.
"""

import argparse
import statistics
import subprocess
import sys
from collections.abc import Iterator
from functools import partial
from pathlib import Path

import gymnasium
import mujoco
import numpy as np
import torch
from mujoco import rollout
from taking_turns import Method, Row, measure, provenance, quotients, show, tenths, write
from tensordict import TensorDictBase
from torchrl.envs import EnvBase, GymEnv, SerialEnv

from nht.envs import TASKS, BatchedTask, gymnasium_id, make_env, make_task

ORIGINALS = {
    "ant": "Ant-v5",
    "half_cheetah": "HalfCheetah-v5",
    "hopper": "Hopper-v5",
    "walker2d": "Walker2d-v5",
}
FLOORS = {64: 0.7, 256: 0.8}  # of TorchRL over bare by number of copies, on one thread
SERIAL_FLOOR = 4.0  # of TorchRL over SerialEnv(8), at 64 copies on one thread
ENVPOOL = """
import sys, time, envpool, numpy
copies, threads = map(int, sys.argv[1:])
env = envpool.make("HalfCheetah-v5", env_type="gymnasium", num_envs=copies, num_threads=threads, seed=0)
actions = numpy.random.default_rng(0).uniform(-1, 1, (256, copies, 6))
env.reset()
for line in sys.stdin:
    wall, cpu = time.perf_counter(), time.process_time()
    for call in range(int(line)):
        env.step(actions[call % 256])
    print(time.perf_counter() - wall, time.process_time() - cpu, flush=True)
"""
RESULTS = Path(__file__).parents[1] / "results" / "stepping" / "stepping.csv"


class EnvPool(Method):
    """HalfCheetah in EnvPool, in a process of another Python."""

    def __init__(self, python: str, copies: int, threads: int) -> None:
        super().__init__("EnvPool", copies, threads, iter(()))
        command = [python, "-c", ENVPOOL, str(copies), str(threads)]
        self.process = subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True)

    def run(self, calls: int) -> tuple[float, float]:
        """Seconds and processor seconds of ``calls`` calls, as the process measured them."""
        print(calls, file=self.process.stdin, flush=True)
        wall, cpu = map(float, self.process.stdout.readline().split())
        return wall, cpu


def bare(name: str, copies: int, threads: int) -> Iterator[None]:
    task = make_task(name, num_envs=copies, seed=0)
    visited = random_motion(task)
    trajectory = np.zeros((copies, task.substeps, task.state.shape[1]))
    models, data = [task.model] * copies, [mujoco.MjData(task.model) for _ in range(threads)]
    with rollout.Rollout(nthread=threads if threads > 1 else 0) as pool:
        while True:
            for state, control in visited:
                pool.rollout(
                    models, data, state, control, skip_checks=True, nstep=task.substeps, state=trajectory
                )
                yield


def random_motion(task: BatchedTask) -> list[tuple[np.ndarray, np.ndarray]]:
    """States of all copies amid random motion, and the controls that carried them on."""
    visited = []
    for actuation in random_actuations(task, 64):
        state = task.state.copy()
        outcome = task.step(actuation)
        visited.append((state, task._control[:, :1].repeat(task.substeps, axis=1)))
        task.reset(np.flatnonzero(outcome.terminated | outcome.truncated))
    return visited[32:]


def random_actuations(task: BatchedTask, count: int) -> np.ndarray:
    low, high = task.actuation_bounds
    return np.random.default_rng(0).uniform(low, high, (count, task.num_envs, low.size))


def torchrl(name: str, env: EnvBase, copies: int) -> Iterator[None]:
    drawn = random_actuations(make_task(name, num_envs=copies, seed=0), 256)
    actions = torch.tensor(drawn, dtype=torch.float32).unbind()
    tensordict: TensorDictBase = env.reset()
    while True:
        for action in actions:
            _, tensordict = env.step_and_maybe_reset(tensordict.set("action", action))
            yield


def sync_vector(name: str, copies: int) -> Iterator[None]:
    actions = random_actuations(make_task(name, num_envs=copies, seed=0), 256).astype(np.float32)
    make = partial(gymnasium.make, original_id(name), disable_env_checker=True)
    env = gymnasium.vector.SyncVectorEnv([make] * copies)
    env.reset(seed=0)
    while True:
        for action in actions:
            env.step(action)
            yield


def original_id(name: str) -> str:
    return ORIGINALS.get(name, gymnasium_id(name))


def make_methods(name: str, envpool: str | None) -> list[Method]:
    sizes = [(copies, threads) for copies in FLOORS for threads in (1, 2)]
    methods = [Method("bare", *size, bare(name, *size)) for size in sizes]
    methods += [
        Method("TorchRL", *size, torchrl(name, make_env(name, *size, seed=0), size[0])) for size in sizes
    ]
    serial = SerialEnv(8, partial(GymEnv, original_id(name)))
    methods.append(Method("SyncVectorEnv", 8, 1, sync_vector(name, 8)))
    methods.append(Method("SerialEnv", 8, 1, torchrl(name, serial, 8)))
    if envpool and name == "half_cheetah":
        methods += [EnvPool(envpool, *size) for size in sizes]
    return methods


def summarise(name: str, methods: list[Method]) -> list[Row]:
    baselines = {method.copies: method for method in methods if method.name == "bare" and method.threads == 1}
    rows = []
    for method in methods:
        baseline = baselines.get(method.copies, baselines[min(baselines)])
        ratios = quotients(baseline.seconds, method.seconds)
        cpu_ratios = quotients(baseline.cpu_seconds, method.cpu_seconds)
        rates = [1 / seconds for seconds in method.seconds]
        rows.append(
            {
                "task": name,
                "method": method.name,
                "copies": method.copies,
                "threads": method.threads,
                "env steps/s": round(statistics.median(rates)),
                "10 %": round(tenths(rates)[0]),
                "90 %": round(tenths(rates)[1]),
                "ratio": round(statistics.median(ratios), 3),
                "ratio 10 %": round(tenths(ratios)[0], 3),
                "ratio 90 %": round(tenths(ratios)[1], 3),
                "CPU ratio": round(statistics.median(cpu_ratios), 3),
                "CPU us/env step": round(1e6 * statistics.median(method.cpu_seconds), 1),
            }
        )
    return rows


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--tasks", nargs="+", choices=sorted(TASKS), default=sorted(TASKS))
    parser.add_argument("--rounds", type=int, default=30)
    parser.add_argument("--env-steps", type=int, default=4096, help="of every method in a round")
    parser.add_argument("--envpool", help="a Python that has envpool, to measure its HalfCheetah too")
    options = parser.parse_args()
    torch.set_num_threads(1)
    header = provenance(options.rounds)

    rows: list[Row] = []
    for name in options.tasks:
        methods = make_methods(name, options.envpool)
        measure(methods, options.rounds, options.env_steps)
        rows += summarise(name, methods)
        write(RESULTS, rows, header)
    print("\n".join(f"{key}: {value}" for key, value in header.items()) + "\n")
    show(rows)
    check_floors(rows)


def check_floors(rows: list[Row]) -> None:
    cpu = {
        (row["task"], row["method"], row["copies"]): float(row["CPU us/env step"])
        for row in rows
        if row["threads"] == 1
    }
    ratios = {(row["task"], row["copies"]): row["CPU ratio"] for row in rows if is_ours(row)}
    missed = [
        f"{task}: {ratio} of bare at {copies} copies, floor {FLOORS[copies]}"
        for (task, copies), ratio in ratios.items()
        if ratio < FLOORS[copies]
    ]
    for task in {task for task, _ in ratios}:
        over_serial = cpu[task, "SerialEnv", 8] / cpu[task, "TorchRL", 64]
        print(f"{task}: {over_serial:.1f} times SerialEnv(8)")
        if over_serial < SERIAL_FLOOR:
            missed.append(f"{task}: {over_serial:.1f} times SerialEnv(8), floor {SERIAL_FLOOR}")
    if missed:
        sys.exit("TorchRL is too slow: " + "; ".join(missed))
    print(f"\nTorchRL over bare on one thread is above its floors: {FLOORS}")


def is_ours(row: Row) -> bool:
    return row["method"] == "TorchRL" and row["threads"] == 1


if __name__ == "__main__":
    main()
