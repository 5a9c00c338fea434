"""How the rate of stepping grows with the number of copies and of threads, and how much memory the copies take.

    OMP_NUM_THREADS=1 python benchmarks/speed/batch_scaling.py [--task half_cheetah]

Bare ``mujoco.rollout`` and the batched environment in TorchRL, as in ``stepping.py``, take turns at every number of
copies on one thread and on two. Memory is what a fresh process holds after the imports, and after making the copies
and stepping them. Writes CSV and PNG to ``results/batch_scaling``; fails if 1,024 copies take over 300 MB.
"""

import argparse
import statistics
import subprocess
import sys
from pathlib import Path

import matplotlib.pyplot as plt
import torch
from stepping import bare, torchrl
from taking_turns import Method, Row, measure, provenance, show, tenths, write

from nht.envs import TASKS, make_env
from nht.recipes.figure_style import BLUE, GREY, PAGE, save_figure, style

COPIES = (1, 4, 16, 64, 256, 1024)
THREADS = (1, 2)
MEMORY_LIMIT = 300.0  # MB, of 1,024 copies beyond the imports
RESULTS = Path(__file__).parents[1] / "results" / "batch_scaling" / "batch_scaling"
MEMORY = """
import sys
from nht.envs import make_env

def resident():
    with open("/proc/self/status") as file:
        return next(int(line.split()[1]) for line in file if line.startswith("VmRSS")) / 1024

before = resident()
env = make_env(sys.argv[1], num_envs=int(sys.argv[2]), seed=0)
env.rollout(10)
print(resident() - before)
"""


def make_methods(name: str) -> list[Method]:
    methods = []
    for copies in COPIES:
        for threads in THREADS:
            methods.append(Method("bare", copies, threads, bare(name, copies, threads)))
            env = make_env(name, copies, threads, seed=0)
            methods.append(Method("TorchRL", copies, threads, torchrl(name, env, copies)))
    return methods


def memory(name: str, copies: int) -> float:
    """Megabytes that the copies take."""
    command = [sys.executable, "-c", MEMORY, name, str(copies)]
    result = subprocess.run(command, capture_output=True, text=True, check=True)
    return float(result.stdout.split()[-1])


def summarise(name: str, methods: list[Method]) -> list[Row]:
    rows: list[Row] = []
    for method in methods:
        rates = [1 / seconds for seconds in method.seconds]
        cpu = statistics.median(method.cpu_seconds)
        rows.append(
            {
                "task": name,
                "method": method.name,
                "copies": method.copies,
                "threads": method.threads,
                "env steps/s": round(statistics.median(rates)),
                "10 %": round(tenths(rates)[0]),
                "90 %": round(tenths(rates)[1]),
                "env steps/CPU s": round(1 / cpu),
            }
        )
    return rows


@style()
def plot(rows: list[Row], name: str) -> None:
    figure, axes = plt.subplots(1, 2, figsize=(PAGE, 0.42 * PAGE), sharey=True, layout="constrained")
    for axis, unit, title in zip(
        axes,
        ("90 %", "env steps/CPU s"),
        ("per second (best tenth)", "per processor second"),
        strict=True,
    ):
        for method, colour in (("TorchRL", BLUE), ("bare", GREY)):
            for threads, line_style in zip(THREADS, ("o-", "s--"), strict=True):
                line = [row for row in rows if row["method"] == method and row["threads"] == threads]
                label = f"{method}, {threads} thread{'s' * (threads > 1)}"
                axis.plot(
                    [row["copies"] for row in line],
                    [row[unit] for row in line],
                    line_style,
                    c=colour,
                    label=label,
                )
        axis.set(xscale="log", yscale="log", xlabel="copies", title=f"env steps {title}")
        axis.set_xticks(COPIES, [str(copies) for copies in COPIES])
    axes[0].set_ylabel(name)
    axes[0].legend()
    save_figure(figure, RESULTS.with_suffix(".png"))


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--task", choices=sorted(TASKS), default="half_cheetah")
    parser.add_argument("--rounds", type=int, default=20)
    parser.add_argument("--env-steps", type=int, default=1024, help="of every method in a round")
    options = parser.parse_args()
    torch.set_num_threads(1)
    taken = memory(options.task, COPIES[-1])
    header = provenance(options.rounds) | {"memory": f"{COPIES[-1]} copies take {taken:.0f} MB"}

    methods = make_methods(options.task)
    measure(methods, options.rounds, options.env_steps)
    rows = summarise(options.task, methods)
    write(RESULTS.with_suffix(".csv"), rows, header)
    plot(rows, options.task)
    print("\n".join(f"{key}: {value}" for key, value in header.items()) + "\n")
    show(rows)
    if taken > MEMORY_LIMIT:
        sys.exit(f"{COPIES[-1]} copies take {taken:.0f} MB, more than {MEMORY_LIMIT:.0f}")


if __name__ == "__main__":
    main()
