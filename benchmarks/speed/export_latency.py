"""What one call of a map costs a control loop: batch 1, default NHT (context 10, n 7, k 2, hidden 256 x 256), one core.

    OMP_NUM_THREADS=1 python benchmarks/speed/export_latency.py

Every method is called 20 times in turn in each of many rounds, after a warm-up, so that a busy machine slows all alike.
C++ runs on its own, afterwards, the same number of calls. Prints the table and writes ``results/export_latency``:
wall-clock microseconds of a call (median, 10 % and 90 % of the calls), the mean CPU time of the thread where it is
known, and the largest difference from the float32 map. Takes g++; two minutes, mostly for compiling.
"""

from __future__ import annotations

import csv
import os
import platform
import statistics
import subprocess
import tempfile
import time
from collections.abc import Callable
from pathlib import Path

import onnxruntime
import torch
from torch import Tensor
from torch._inductor import aoti_load_package

import nht

HERE = Path(__file__).parents[1]
WARM_UP, ROUNDS, CALLS = 10, 200, 20
Method = Callable[[Tensor, Tensor], Tensor]


def methods(map: nht.ActionMap, folder: Path) -> dict[str, Method]:
    """Every way to call the map from Python, by name."""
    program = torch.export.load(nht.export_map(map, folder / "program.pt2")).module()
    package = aoti_load_package(str(nht.export_map(map, folder / "compiled.pt2", compiled=True)))
    return {
        "map, in Python": map,
        "torch.compile, in Python": torch.compile(map),
        "exported program (.pt2), in Python": program,
        "compiled package (.pt2), in Python": package,
        "ONNX Runtime (.onnx), in Python": onnx(nht.export_map(map, folder / "map.onnx")),
    }


def onnx(path: Path) -> Method:
    options = onnxruntime.SessionOptions()
    options.intra_op_num_threads = options.inter_op_num_threads = 1
    session = onnxruntime.InferenceSession(path, options, providers=["CPUExecutionProvider"])

    def run(action: Tensor, context: Tensor) -> Tensor:
        return torch.from_numpy(session.run(None, {"action": action.numpy(), "context": context.numpy()})[0])

    return run


def call_times(method: Method, action: Tensor, context: Tensor) -> tuple[list[float], float]:
    """Microseconds on the wall clock of each call, and of the thread for all."""
    wall = []
    thread = time.thread_time()
    for _ in range(CALLS):
        before = time.perf_counter()
        method(action, context)
        wall.append(1e6 * (time.perf_counter() - before))
    return wall, 1e6 * (time.thread_time() - thread)


def build_loop(folder: Path) -> Path:
    """Compiles control_loop.cpp against the installed PyTorch."""
    torch_folder = Path(torch.__path__[0])
    include, library = torch_folder / "include", torch_folder / "lib"
    command = ["g++", "-O2", "-std=c++20", f"-I{include}", f"-I{include}/torch/csrc/api/include"]
    command += [str(HERE / "speed" / "control_loop.cpp"), "-o", str(folder / "control_loop")]
    command += [
        f"-L{library}",
        f"-Wl,-rpath,{library}",
        "-Wl,--no-as-needed",
        "-ltorch",
        "-ltorch_cpu",
        "-lc10",
    ]
    subprocess.run(command, check=True)
    return folder / "control_loop"


def run_loop(program: Path, package: Path, map: nht.ActionMap, calls: int) -> tuple[Tensor, list[float]]:
    """Actuation for ones, and microseconds of each call, from C++."""
    sizes = [str(map.action_dim), str(map.context_dim), str(calls)]
    done = subprocess.run([program, package, *sizes], check=True, capture_output=True, text=True)
    _, actuation, times = done.stdout.splitlines()
    return torch.tensor([[float(value) for value in actuation.split()]]), [float(t) for t in times.split()]


def row(name: str, wall: list[float], cpu: float | None, error: float) -> dict[str, object]:
    commit = subprocess.run(["git", "rev-parse", "--short", "HEAD"], cwd=HERE, capture_output=True, text=True)
    deciles = statistics.quantiles(wall, n=10)
    return {
        "method": name,
        "median_us": round(statistics.median(wall), 1),
        "tenth_us": round(deciles[0], 1),
        "ninetieth_us": round(deciles[-1], 1),
        "cpu_us": "" if cpu is None else round(cpu, 1),
        "largest_error": f"{error:.1e}",
        "commit": commit.stdout.strip(),
        "cores": os.cpu_count(),
        "machine": platform.machine(),
        "torch": torch.__version__,
    }


@torch.inference_mode()
def measure(map: nht.ActionMap, folder: Path) -> list[dict[str, object]]:
    action, context = torch.ones(1, map.action_dim), torch.ones(1, map.context_dim)
    expected = map(action, context)
    ways = methods(map, folder)
    wall: dict[str, list[float]] = {name: [] for name in ways}
    cpu = dict.fromkeys(ways, 0.0)
    for turn in range(WARM_UP + ROUNDS):
        for name, method in ways.items():
            times, thread = call_times(method, action, context)
            if turn >= WARM_UP:
                wall[name] += times
                cpu[name] += thread
    rows = [
        row(
            name,
            wall[name],
            cpu[name] / len(wall[name]),
            float((method(action, context) - expected).abs().max()),
        )
        for name, method in ways.items()
    ]
    actuation, times = run_loop(build_loop(folder), folder / "compiled.pt2", map, CALLS * (WARM_UP + ROUNDS))
    error = float((actuation - expected).abs().max())
    return [*rows, row("compiled package (.pt2), in C++", times[CALLS * WARM_UP :], None, error)]


def main() -> None:
    torch.set_num_threads(1)
    map = nht.NHT(context_dim=10, actuation_dim=7, action_dim=2).requires_grad_(False).eval()
    with tempfile.TemporaryDirectory() as folder:
        rows = measure(map, Path(folder))
    for entry in rows:
        print(
            f"{entry['method']:<36} {entry['median_us']:>7} us  ({entry['tenth_us']} .. {entry['ninetieth_us']})  "
            f"CPU {entry['cpu_us']:>6}  error {entry['largest_error']}"
        )
    with open(HERE / "results" / "export_latency" / "export_latency.csv", "w", newline="") as file:
        table = csv.DictWriter(file, rows[0])
        table.writeheader()
        table.writerows(rows)


if __name__ == "__main__":
    main()
