"""Which way to apply reflections to the action, u = Q(c) a, is the fastest for which batch, n and k.

    OMP_NUM_THREADS=1 python benchmarks/speed/householder.py [--compiled]

- library: ``nht.geometry.householder_apply``, which picks by shape between reflections and WY in double.
- reflections: one reflection of the vector [a; 0] after the other.
- WY, WY double: I - V T V^T, T from the products of the reflectors with each other by a triangular solve; in the
  precision of the reflectors, or in double precision from end to end.
- chain: the product of n x n matrices, as in Eq. 7-9 of the paper.
- thin: the n x k basis, by reflecting the columns of the thin identity, times the action.
- LAPACK: ``torch.linalg.householder_product``, which wants reflectors with zeros before a leading 1. Any k unit vectors
  fit if each gets k more entries in front: what it leaves in there no later reflection sees.
- LAPACK QR: the same without more entries, as if v_i began with i - 1 zeros, like those of a QR decomposition. It gives
  *another u*; it shows the least that this function can cost.

Regimes start from unit reflectors, but for one "from tangents", which includes the exponential map that all share.
Forward alone runs without gradients, as in a control loop. One thread. After a warm-up all methods take turns in every
round, in random order, each with a call that is not timed before the one that is; times are the processor's, in which
other programs do not count, and a ratio is the median over the rounds. Skipped is a method whose matrices would take
more than 128 MB, and twice what the reflectors take, or that takes longer than 0.5 s, and five times what the library
takes. Errors are the largest differences between float32 and float64, over 4096 actions of length 1; a method above
1e-6 cannot be the fastest. Writes ``results/householder``, and fails if at batch 4096, n = 7, k = 2, forward and
backward, the library is not 10 times as fast as the chain.
"""

import argparse
import csv
import os
import platform
import random
import statistics
import subprocess
import sys
import time
from collections.abc import Callable
from dataclasses import asdict, dataclass, replace
from pathlib import Path

import torch
from torch import Tensor
from torch.nn import functional

from nht.geometry import householder_apply, sphere_exp

Method = Callable[[Tensor, Tensor], Tensor]
Row = dict[str, str | int | float]

SIZES = [(7, 2), (7, 3), (24, 4), (64, 4), (32, 8), (32, 12), (64, 16)]  # (n, k)
BATCHES = [1, 8, 64, 1024, 4096, 65536]
SKIPPED_FROM_BYTES, SKIPPED_FROM_MS = 128e6, 500
WARM_UP, LEAST_ROUNDS = 2, 7
FLOOR = 10  # of the library over the chain
WORTH_IT = 1.3  # times faster than the library
EXACT = 1e-6
RESULTS = Path(__file__).parents[1] / "results" / "householder" / "householder.csv"


@dataclass(frozen=True)
class Regime:
    """A size of the problem, and what of it is timed."""

    batch: int
    n: int
    k: int
    backward: bool = True
    compiled: bool = False
    tangents: bool = False

    def __str__(self) -> str:
        passes = "forward and backward" if self.backward else "forward"
        return f"batch {self.batch}, n = {self.n}, k = {self.k}, {passes}{', compiled' * self.compiled}"


FLOOR_REGIME, FROM_TANGENTS = Regime(4096, 7, 2), Regime(4096, 7, 2, tangents=True)
EAGER = [Regime(batch, n, k, backward=False) for n, k in SIZES for batch in BATCHES[:2]]
EAGER += [Regime(batch, n, k) for n, k in SIZES for batch in BATCHES]
COMPILED = [Regime(1, n, k, backward=False, compiled=True) for n, k in ((7, 2), (64, 16))]
COMPILED += [Regime(batch, n, k, compiled=True) for batch, n, k in ((64, 64, 16), (4096, 7, 2))]


def reflections(reflectors: Tensor, action: Tensor) -> Tensor:
    vector = padded(reflectors, action)
    for reflector in reversed(reflectors.unbind(-2)):
        along = (reflector * vector).sum(-1, keepdim=True)
        vector = torch.addcmul(vector, reflector, along, value=-2)
    return vector


def compact_wy(reflectors: Tensor, action: Tensor) -> Tensor:
    row, doubled = padded(reflectors, action).unsqueeze(-2), 2 * reflectors
    products, along = reflectors @ doubled.mT, row @ doubled.mT
    along = torch.linalg.solve_triangular(products, along, upper=False, left=False, unitriangular=True)
    return (row - along @ reflectors).squeeze(-2)


def compact_wy_double(reflectors: Tensor, action: Tensor) -> Tensor:
    return compact_wy(reflectors.double(), action.double()).to(action.dtype)


def padded(reflectors: Tensor, action: Tensor) -> Tensor:
    return functional.pad(action, (0, reflectors.shape[-1] - action.shape[-1]))


def chain(reflectors: Tensor, action: Tensor) -> Tensor:
    k, n = reflectors.shape[-2:]
    matrices = torch.eye(n, dtype=action.dtype) - 2 * reflectors.unsqueeze(-1) * reflectors.unsqueeze(-2)
    product = matrices[..., 0, :, :]
    for i in range(1, k):
        product = product @ matrices[..., i, :, :]
    return (product[..., :k] @ action.unsqueeze(-1)).squeeze(-1)


def thin(reflectors: Tensor, action: Tensor) -> Tensor:
    k, n = reflectors.shape[-2:]
    basis = torch.eye(n, k, dtype=action.dtype).expand(*action.shape[:-1], n, k)
    for reflector in reversed(reflectors.unbind(-2)):
        column = reflector.unsqueeze(-1)
        basis = basis - 2 * column * (column.mT @ basis)
    return (basis @ action.unsqueeze(-1)).squeeze(-1)


def lapack(reflectors: Tensor, action: Tensor) -> Tensor:
    # A long v_i behind its leading 1, and a small tau: backward divides by 1 - tau |v|^2, which then is about -1.
    k, length = reflectors.shape[-2], 1024.0
    leading = torch.eye(k, dtype=action.dtype).expand(*reflectors.shape[:-2], k, k)
    columns = functional.pad(torch.cat([leading, length * reflectors], dim=-1).mT, (0, k))
    tau = torch.full(reflectors.shape[:-1], 2 / length**2, dtype=action.dtype)
    basis = torch.linalg.householder_product(columns, tau)[..., k:, k:]
    return (basis @ action.unsqueeze(-1)).squeeze(-1)


def lapack_qr(reflectors: Tensor, action: Tensor) -> Tensor:
    columns = reflectors.mT
    basis = torch.linalg.householder_product(columns, 2 / columns.square().sum(-2))
    return (basis @ action.unsqueeze(-1)).squeeze(-1)


# Name -> the method, and how many numbers its matrices hold for one entry of the batch.
METHODS: dict[str, tuple[Method, Callable[[int, int], int]]] = {
    "library": (householder_apply, lambda n, k: k * n),
    "reflections": (reflections, lambda n, k: k * n),
    "WY": (compact_wy, lambda n, k: k * n),
    "WY double": (compact_wy_double, lambda n, k: 2 * k * n),
    "chain": (chain, lambda n, k: k * n * n),
    "thin": (thin, lambda n, k: k * n * k),
    "LAPACK": (lapack, lambda n, k: k * (n + k) * 2 * k),
    "LAPACK QR": (lapack_qr, lambda n, k: k * n * k),
}
COMPILED_METHODS = ["library", "reflections", "WY", "chain"]


def contenders(regime: Regime) -> dict[str, Method]:
    allowed = max(SKIPPED_FROM_BYTES, 8 * regime.batch * regime.n * regime.k)
    methods: dict[str, Method] = {}
    for name in COMPILED_METHODS if regime.compiled else METHODS:
        method, numbers = METHODS[name]
        if 4 * regime.batch * numbers(regime.n, regime.k) <= allowed:
            methods[name] = from_tangents(method) if regime.tangents else method
            if regime.compiled:
                methods[name] = torch.compile(method, fullgraph=True, dynamic=False)
    return methods


def from_tangents(method: Method) -> Method:
    return lambda tangents, action: method(sphere_exp(tangents), action)


def inputs(regime: Regime) -> tuple[Tensor, Tensor, Tensor]:
    """Reflectors or tangents, actions of length 1, and a gradient for the actuation."""
    generator = torch.Generator().manual_seed(0)
    shape = (regime.batch, regime.k, regime.n - 1)
    # Lengths up to pi, which reach the whole sphere.
    lengths = torch.pi * torch.rand(*shape[:-1], 1, generator=generator)
    tangents = lengths * functional.normalize(torch.randn(shape, generator=generator), dim=-1)
    action = functional.normalize(torch.randn(shape[:-1], generator=generator), dim=-1)
    upstream = torch.randn(regime.batch, regime.n, generator=generator)
    return tangents if regime.tangents else sphere_exp(tangents), action, upstream


def milliseconds(method: Method, backward: bool, start: Tensor, action: Tensor, upstream: Tensor) -> float:
    with torch.set_grad_enabled(backward):
        start, action = start.clone().requires_grad_(backward), action.clone().requires_grad_(backward)
        before = time.process_time()
        actuation = method(start, action)
        if backward:
            actuation.backward(upstream)
        return 1e3 * (time.process_time() - before)


def measure(regime: Regime, rounds: int, seconds: float) -> list[Row]:
    """All methods in turn, `rounds` times or for about so many seconds."""
    torch.compiler.reset()
    methods, tensors, order = contenders(regime), inputs(regime), random.Random(0)
    times: dict[str, list[float]] = {name: [] for name in methods}
    deadline = torch.inf
    for number in range(WARM_UP + rounds):
        if number == WARM_UP:  # compilation does not count
            deadline = time.process_time() + seconds
        for name in order.sample(list(times), len(times)):
            milliseconds(methods[name], regime.backward, *tensors)
            times[name].append(milliseconds(methods[name], regime.backward, *tensors))
        allowed = max(SKIPPED_FROM_MS, 5 * times["library"][0])
        times = {name: values for name, values in times.items() if values[0] < allowed}
        if number + 1 >= WARM_UP + LEAST_ROUNDS and time.process_time() > deadline:
            break
    times = {name: values[WARM_UP:] for name, values in times.items()}
    rows = [summary(regime, name, times) for name in times]
    for row in rows:
        if row["method"] != "LAPACK QR":
            row["float32 error"] = error(methods[str(row["method"])], regime)
    skipped = [name for name in METHODS if name not in times and not regime.compiled]
    return rows + [asdict(regime) | {"method": name, "rounds": 0} for name in skipped]


def summary(regime: Regime, name: str, times: dict[str, list[float]]) -> Row:
    row = asdict(regime) | {"method": name, "rounds": len(times[name])} | spread("ms", times[name])
    for other in ("chain", "library"):
        if other in times:
            ratios = [theirs / own for theirs, own in zip(times[other], times[name], strict=True)]
            row |= spread(f"{other} / own", ratios)
    return row


def spread(label: str, values: list[float]) -> Row:
    deciles = statistics.quantiles(values, n=10, method="inclusive")
    numbers = {label: statistics.median(values), f"{label} 10 %": deciles[0], f"{label} 90 %": deciles[-1]}
    return {name: float(f"{number:.4g}") for name, number in numbers.items()}


def error(method: Method, regime: Regime) -> float:
    start, action, _ = inputs(replace(regime, batch=max(regime.batch, 4096)))
    batches = zip(start.split(regime.batch), action.split(regime.batch), strict=True)
    found = torch.cat([method(*batch) for batch in batches])[:4096]
    reference = from_tangents(reflections) if regime.tangents else reflections
    expected = reference(start[:4096].double(), action[:4096].double())
    return float(f"{(found - expected).abs().max():.2g}")


def show_detail(title: str, rows: list[Row]) -> None:
    print(
        f"\n{title}\n{'method':<12} {'median ms':>9} {'10-90 %':>13} {'ratio':>6} {'10-90 %':>11} {'float32 error':>14}"
    )
    for row in rows:
        ratio, low, high = (row[f"chain / own{tenth}"] for tenth in ("", " 10 %", " 90 %"))
        print(
            f"{row['method']:<12} {row['ms']:9.2f} {row['ms 10 %']:6.2f}-{row['ms 90 %']:6.2f} "
            f"{ratio:6.1f} {low:5.1f}-{high:5.1f} {row.get('float32 error', '-'):>14}"
        )


def show_regime(regime: Regime, rows: list[Row]) -> None:
    timed = {str(row["method"]): row for row in rows if row["rounds"]}
    cells = [f"{1 / float(timed[name]['library / own']):.2g}" if name in timed else "-" for name in METHODS]
    numbers = "".join(f"{cell:>12}" for cell in cells[1:])
    print(f"{regime!s:<58}{timed['library']['ms']:9.3f} ms{numbers}   {verdict(timed)}", flush=True)


def verdict(timed: dict[str, Row]) -> str:
    """The fastest that is exact, and by how much; the library itself where nobody is clearly faster."""
    exact = [name for name, row in timed.items() if row.get("float32 error", 1) <= EXACT]
    name = max(exact, key=lambda name: timed[name]["library / own"])
    ratio, low, high = (float(timed[name][f"library / own{tenth}"]) for tenth in ("", " 10 %", " 90 %"))
    if ratio < 1.1 or low < 1:
        return "library"
    return f"{name}: {ratio:.2f} ({low:.2f}-{high:.2f}) times as fast{' *' * (ratio >= WORTH_IT)}"


def write(rows: list[Row]) -> None:
    def git(*arguments: str) -> str:
        command = ["git", *arguments]
        return subprocess.run(command, cwd=RESULTS.parent, capture_output=True, text=True, check=True).stdout

    changed = git("status", "--porcelain", "--untracked-files=no", "--", "../../nht", "../householder.py")
    header = {
        "command": " ".join(["python", os.path.relpath(sys.argv[0]), *sys.argv[1:]]),
        "commit": git("rev-parse", "--short", "HEAD").strip() + " with changes" * bool(changed),
        "machine": f"{platform.machine()}, {os.cpu_count()} cores, load average {os.getloadavg()[0]:.1f}",
        "versions": f"Python {platform.python_version()}, torch {torch.__version__}",
    }
    names = list(dict.fromkeys(name for row in rows for name in row))
    with RESULTS.open("w", newline="") as file:
        file.writelines(f"# {name}: {value}\n" for name, value in header.items())
        writer = csv.DictWriter(file, fieldnames=names, lineterminator="\n")
        writer.writeheader()
        writer.writerows(rows)


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--rounds", type=int, default=200, help="at the most, in each regime")
    parser.add_argument("--seconds", type=float, default=3, help="after which a regime gets no more rounds")
    parser.add_argument("--compiled", action="store_true", help="torch.compile too, in a few regimes")
    options = parser.parse_args()
    torch.set_num_threads(1)

    print(f"u = Q(c) a, {FLOOR_REGIME}; one thread; torch {torch.__version__}, {platform.machine()}")
    results = {FLOOR_REGIME: measure(FLOOR_REGIME, options.rounds, options.seconds)}
    show_detail("from reflectors", results[FLOOR_REGIME])
    results[FROM_TANGENTS] = measure(FROM_TANGENTS, options.rounds, options.seconds)
    show_detail("from tangents", results[FROM_TANGENTS])

    print(f"\nThe library's time, that of others in times of it, and who is fastest; * from {WORTH_IT} on")
    print(" " * 58 + "".join(f"{name:>12}" for name in METHODS))
    for regime in EAGER + COMPILED * options.compiled:
        if regime not in results:
            results[regime] = measure(regime, options.rounds, options.seconds)
        show_regime(regime, results[regime])
    write([row for rows in results.values() for row in rows])
    ratio = next(row["chain / own"] for row in results[FLOOR_REGIME] if row["method"] == "library")
    if float(ratio) < FLOOR:
        sys.exit(f"The library is {ratio} times as fast as the chain; the floor is {FLOOR}.")


if __name__ == "__main__":
    main()
