"""Ways of stepping that take turns, so that a busy machine slows all alike, and what goes into a file of results."""

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

Row = dict[str, str | int | float]


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
        calls = max(1, env_steps // self.copies)
        wall, cpu = self.run(calls)
        self.seconds.append(wall / (calls * self.copies))
        self.cpu_seconds.append(cpu / (calls * self.copies))

    def run(self, calls: int) -> tuple[float, float]:
        """Seconds and processor seconds of ``calls`` calls."""
        wall, cpu = time.perf_counter(), time.process_time()
        for _ in range(calls):
            next(self.stepping)
        return time.perf_counter() - wall, time.process_time() - cpu


def measure(methods: list[Method], rounds: int, env_steps: int) -> None:
    """Let all take turns, in both directions; the first two rounds are the warm-up."""
    for number in range(rounds + 2):
        for method in methods if number % 2 else reversed(methods):
            method.measure(env_steps)
    for method in methods:
        del method.seconds[:2], method.cpu_seconds[:2]


def quotients(numerators: list[float], denominators: list[float]) -> list[float]:
    return [numerator / denominator for numerator, denominator in zip(numerators, denominators, strict=True)]


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
            ["git", *arguments], cwd=Path(__file__).parents[2], capture_output=True, text=True, check=True
        ).stdout.strip()

    changed = git("status", "--porcelain", "--untracked-files=no", "--", "envs", "benchmarks")
    return git("rev-parse", "--short", "HEAD") + (" with changes" if changed else "")


def processor() -> str:
    names = [line for line in Path("/proc/cpuinfo").read_text().splitlines() if line.startswith("model name")]
    return names[0].split(":")[1].strip() if names else platform.processor()


def write(path: Path, rows: list[Row], header: dict[str, str]) -> None:
    path.parent.mkdir(exist_ok=True)
    with path.open("w", newline="") as file:
        file.writelines(f"# {key}: {value}\n" for key, value in header.items())
        writer = csv.DictWriter(file, fieldnames=list(rows[0]), lineterminator="\n")
        writer.writeheader()
        writer.writerows(rows)


def show(rows: list[Row]) -> None:
    table = [list(rows[0]), *([str(value) for value in row.values()] for row in rows)]
    widths = [max(map(len, column)) for column in zip(*table, strict=True)]
    for line in table:
        print("  ".join(cell.rjust(width) for cell, width in zip(line, widths, strict=True)))
