"""What applying reflections to the action saves: u = Q(c) a, forward and backward, against forming matrices.

    OMP_NUM_THREADS=1 python benchmarks/householder.py

Every method is timed in turn in each of many rounds, after a warm-up, so that a busy machine slows all alike; a ratio
is the median over the rounds of (time of the chain) / (time of the method). "from reflectors" starts at unit vectors
v_1 ... v_k, "from tangents" at the network's output and so includes the exponential map, which all methods share.
"""

import argparse
import platform
import statistics
import time
from collections.abc import Callable

import torch
from torch import Tensor

from nht.geometry import householder_apply, sphere_exp

Method = Callable[[Tensor, Tensor], Tensor]
WARM_UP = 10


def chain(reflectors: Tensor, action: Tensor) -> Tensor:
    """The product of n x n matrices, as in Eq. 7-9 of the paper."""
    k, n = reflectors.shape[-2:]
    matrices = torch.eye(n, dtype=action.dtype) - 2 * reflectors.unsqueeze(-1) * reflectors.unsqueeze(-2)
    product = matrices[..., 0, :, :]
    for i in range(1, k):
        product = product @ matrices[..., i, :, :]
    return (product[..., :k] @ action.unsqueeze(-1)).squeeze(-1)


def thin(reflectors: Tensor, action: Tensor) -> Tensor:
    """The n x k basis, by reflecting the columns of the thin identity, times the action."""
    k, n = reflectors.shape[-2:]
    basis = torch.eye(n, k, dtype=action.dtype).expand(*action.shape[:-1], n, k)
    for reflector in reversed(reflectors.unbind(-2)):
        column = reflector.unsqueeze(-1)
        basis = basis - 2 * column * (column.mT @ basis)
    return (basis @ action.unsqueeze(-1)).squeeze(-1)


METHODS: dict[str, Method] = {
    "chain of n x n": chain,
    "thin product": thin,
    "reflections of a": householder_apply,
}


def milliseconds(method: Method, start: Tensor, action: Tensor, upstream: Tensor) -> float:
    start, action = start.clone().requires_grad_(), action.clone().requires_grad_()
    before = time.perf_counter()
    method(start, action).backward(upstream)
    return 1e3 * (time.perf_counter() - before)


def error(method: Method, start: Tensor, action: Tensor) -> float:
    """The largest difference between float32 and the float64 chain, for actions of length 1."""
    exact = chain if method in METHODS.values() else from_tangents(chain)
    return float((method(start, action) - exact(start.double(), action.double())).abs().max())


def from_tangents(method: Method) -> Method:
    return lambda tangents, action: method(sphere_exp(tangents), action)


def report(
    title: str, methods: dict[str, Method], start: Tensor, action: Tensor, upstream: Tensor, rounds: int
) -> None:
    times: dict[str, list[float]] = {name: [] for name in methods}
    for _ in range(WARM_UP + rounds):
        for name, method in methods.items():
            times[name].append(milliseconds(method, start, action, upstream))
    print(
        f"\n{title}\n{'method':<18} {'median ms':>9} {'10-90 %':>13} {'ratio':>6} {'10-90 %':>11} {'float32 error':>14}"
    )
    baseline = times["chain of n x n"][WARM_UP:]
    for name, method in methods.items():
        own = times[name][WARM_UP:]
        ratios = [a / b for a, b in zip(baseline, own, strict=True)]
        low, high = tenths(own)
        low_ratio, high_ratio = tenths(ratios)
        print(
            f"{name:<18} {statistics.median(own):9.2f} {low:6.2f}-{high:6.2f} {statistics.median(ratios):6.1f} "
            f"{low_ratio:5.1f}-{high_ratio:5.1f} {error(method, start, action):14.1e}"
        )


def tenths(values: list[float]) -> tuple[float, float]:
    deciles = statistics.quantiles(values, n=10)
    return deciles[0], deciles[-1]


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--batch", type=int, default=4096)
    parser.add_argument("--n", type=int, default=7)
    parser.add_argument("--k", type=int, default=2)
    parser.add_argument("--rounds", type=int, default=100)
    options = parser.parse_args()
    torch.set_num_threads(1)
    generator = torch.Generator().manual_seed(0)

    def normal(*shape: int) -> Tensor:
        return torch.randn(options.batch, *shape, generator=generator)

    # Lengths up to pi, which reach the whole sphere.
    lengths = torch.pi * torch.rand(options.batch, options.k, 1, generator=generator)
    tangents = lengths * torch.nn.functional.normalize(normal(options.k, options.n - 1), dim=-1)
    action = torch.nn.functional.normalize(normal(options.k), dim=-1)
    upstream = normal(options.n)
    print(
        f"u = Q(c) a, forward and backward: batch {options.batch}, n = {options.n}, k = {options.k}, "
        f"{options.rounds} rounds, one thread; torch {torch.__version__}, {platform.machine()}"
    )
    report("from reflectors", METHODS, sphere_exp(tangents), action, upstream, options.rounds)
    with_exp = {name: from_tangents(method) for name, method in METHODS.items()}
    report("from tangents", with_exp, tangents, action, upstream, options.rounds)


if __name__ == "__main__":
    main()
