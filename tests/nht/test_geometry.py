"""Laws of the Householder geometry, and agreement with an explicit chain of n x n matrices in float64."""

import math
from collections.abc import Callable

import pytest
import torch
from hypothesis import example, given, settings
from hypothesis import strategies as st
from torch import Tensor
from torch.nn import functional

from nht.geometry import (
    MANY_REFLECTORS,
    SMALL_BATCH,
    householder_apply,
    householder_coordinates,
    householder_frame,
    least_squares,
    reflect,
    sphere_exp,
)

SIZES = [(2, 1), (3, 3), (7, 2), (7, 3), (12, 5), (12, 12), (64, 16)]  # (n, k)


@st.composite
def tangents(draw: st.DrawFn) -> Tensor:
    """Tangent vectors, (batch, k, n - 1), float64, of any length from far below rounding to several turns."""
    n = draw(st.integers(2, 9))
    k = draw(st.integers(1, n))
    generator = torch.Generator().manual_seed(draw(st.integers(0, 2**31)))
    length = 10 ** draw(st.floats(-200, 1.5))
    return length * torch.randn(5, k, n - 1, generator=generator, dtype=torch.float64)


def normal(*shape: int, seed: int = 0, dtype: torch.dtype = torch.float64) -> Tensor:
    return torch.randn(*shape, generator=torch.Generator().manual_seed(seed), dtype=torch.float64).to(dtype)


def matrix_chain(reflectors: Tensor) -> Tensor:
    """The first k columns of H_1 ... H_k, from n x n matrices: Eq. 7-9 to the letter."""
    k, n = reflectors.shape[-2:]
    product = torch.eye(n, dtype=reflectors.dtype)
    for i in range(k):
        v = reflectors[..., i, :]
        product = product @ (torch.eye(n, dtype=v.dtype) - 2 * v.unsqueeze(-1) * v.unsqueeze(-2))
    return product[..., :k]


@settings(deadline=None)
@given(tangents())
def test_exponential_map_gives_unit_vectors(tangent: Tensor) -> None:
    assert torch.allclose(
        sphere_exp(tangent).norm(dim=-1), torch.ones(1, dtype=torch.float64), rtol=0, atol=1e-14
    )


@settings(deadline=None)
@given(tangents())
def test_frame_is_orthonormal_and_projection_inverts_it(tangent: Tensor) -> None:
    reflectors = sphere_exp(tangent)
    k = reflectors.shape[-2]
    frame = householder_frame(reflectors)
    action = normal(5, k)
    assert torch.allclose(
        frame.mT @ frame, torch.eye(k, dtype=torch.float64).expand(5, k, k), rtol=0, atol=1e-13
    )
    back = householder_coordinates(reflectors, householder_apply(reflectors, action))[..., :k]
    assert torch.allclose(back, action, rtol=0, atol=1e-13)


@settings(deadline=None)
@given(tangents(), st.floats(-12, 1))
def test_exponential_map_keeps_its_lipschitz_constant(tangent: Tensor, exponent: float) -> None:
    other = tangent + 10**exponent * normal(*tangent.shape, seed=1)
    apart = (sphere_exp(tangent) - sphere_exp(other)).norm(dim=(-2, -1))
    assert (apart <= (tangent - other).norm(dim=(-2, -1)) + 1e-14).all()


@st.composite
def pairs_of_reflectors(draw: st.DrawFn) -> tuple[Tensor, Tensor]:
    """Two times unit vectors, (batch, k, n), from nearly the same to opposite ones."""
    n = draw(st.integers(2, 9))
    k = draw(st.integers(1, n))
    start = normal(5, k, n, seed=draw(st.integers(0, 2**31)))
    step = 10 ** draw(st.floats(-9, 3)) * normal(5, k, n, seed=draw(st.integers(0, 2**31)))
    end = draw(st.sampled_from([start + step, -start - step, step]))
    return functional.normalize(start, dim=-1), functional.normalize(end, dim=-1)


@settings(deadline=None)
@given(pairs_of_reflectors())
def test_a_reflection_keeps_its_lipschitz_constant(pair: tuple[Tensor, Tensor]) -> None:
    """|H(v) - H(w)| <= 2 |v - w| (A.3.1): to be exact, 2 |v - w| times the cosine of half the angle between them."""
    one, other = (reflectors[..., :1, :] for reflectors in pair)
    change = torch.linalg.matrix_norm(whole(one) - whole(other), ord=2)
    apart, cosine = (one - other).norm(dim=(-2, -1)), (one + other).norm(dim=(-2, -1)) / 2
    assert (change <= 2 * apart + 1e-14).all()
    assert torch.allclose(change, 2 * apart * cosine, rtol=1e-6, atol=1e-14)


@settings(deadline=None)
@given(pairs_of_reflectors())
def test_the_product_keeps_its_lipschitz_constant(pair: tuple[Tensor, Tensor]) -> None:
    """2 sqrt(k) in the spectral norm, for the whole of Q and so for its first k columns (Theorem 1)."""
    apart = (pair[0] - pair[1]).norm(dim=(-2, -1))
    for columns in (whole, householder_frame):
        change = torch.linalg.matrix_norm(columns(pair[0]) - columns(pair[1]), ord=2)
        assert (change <= 2 * math.sqrt(pair[0].shape[-2]) * apart + 1e-13).all()


def whole(reflectors: Tensor) -> Tensor:
    """All n columns of Q."""
    return reflect(reflectors.unsqueeze(-3), torch.eye(reflectors.shape[-1], dtype=torch.float64)).mT


@pytest.mark.parametrize("k", [1, 2, 5, 16])
def test_the_constant_of_the_product_is_the_smallest(k: int) -> None:
    """Reflectors in one plane that turn to and fro by the same angle: Q turns by twice the sum of all."""
    angle = 1e-4 * (-1.0) ** torch.arange(k, dtype=torch.float64)
    turned = torch.stack([angle.cos(), angle.sin()], dim=-1)
    still = torch.stack([torch.ones_like(angle), torch.zeros_like(angle)], dim=-1)
    change = torch.linalg.matrix_norm(whole(turned) - whole(still), ord=2)
    assert float(change / (turned - still).norm()) == pytest.approx(2 * math.sqrt(k), rel=1e-6)


@st.composite
def orthonormal_columns(draw: st.DrawFn) -> Tensor:
    """(n, k): some at random, others axes or their opposites, so that reflectors degenerate."""
    n = draw(st.integers(2, 9))
    k = draw(st.integers(1, n))
    axes = draw(st.integers(0, k))
    seed = draw(st.integers(0, 2**31))
    columns = torch.linalg.qr(normal(n - axes, k - axes, seed=seed)).Q if axes < k else normal(n - axes, 0)
    signs = torch.tensor(draw(st.lists(st.sampled_from([-1.0, 1.0]), min_size=axes, max_size=axes)))
    basis = torch.block_diag(torch.diag(signs.double()), columns)
    # Which entries are the axes', and where their columns stand: e_1 alone, first, last, among others.
    return basis[draw(st.permutations(range(n)))][:, draw(st.permutations(range(k)))]


def reflectors_of(basis: Tensor) -> Tensor:
    """Unit vectors (k, n) with H(v_1) ... H(v_k) [I; 0] = basis; with k = n, but perhaps for the last column's sign."""
    n, k = basis.shape
    rest, reflectors = basis, []
    for i in range(k):
        below = rest[i + 1 :, i].norm()
        reflector = torch.zeros(n, dtype=basis.dtype)
        if below > 0:
            # x - e_i, its i-th entry without cancellation.
            reflector[i:] = rest[i:, i]
            reflector[i] = rest[i, i] - 1 if rest[i, i] < 0 else -(below**2) / (rest[i, i] + 1)
            reflector /= reflector.norm()
        else:
            # x = -e_i wants v = e_i. x = e_i is done; but reflect we must: by a vector that leaves it alone.
            reflector[min(i + (rest[i, i] > 0), n - 1)] = 1
        reflectors.append(reflector)
        rest = rest - 2 * torch.outer(reflector, reflector @ rest)
    return torch.stack(reflectors)


def sphere_log(vector: Tensor) -> Tensor:
    """The shortest tangent at e_1 that leads to the vector; one of them for -e_1: (*batch, n) -> (*batch, n - 1)."""
    side = vector[..., 1:].norm(dim=-1, keepdim=True)
    some = functional.one_hot(torch.zeros(side.shape[:-1], dtype=torch.long), vector.shape[-1] - 1)
    direction = torch.where(side > 0, vector[..., 1:] / side, some)
    return torch.atan2(side, vector[..., :1]) * direction


@settings(deadline=None, max_examples=150)
@given(orthonormal_columns(), st.integers(0, 2**31))
@example(-torch.eye(7, 3, dtype=torch.float64), 1)  # reflectors e_1 ...
@example(-torch.eye(7, 3, dtype=torch.float64), 4)  # ... and -e_1
def test_every_subspace_is_reached(basis: Tensor, seed: int) -> None:
    """And every basis of it if k < n. By v and -v alike, so that reflectors at e_1 and at -e_1 occur."""
    n, k = basis.shape
    reflectors = reflectors_of(basis) * normal(k, 1, seed=seed).sign()
    frame = householder_frame(sphere_exp(sphere_log(reflectors)))
    assert torch.allclose(frame @ frame.mT, basis @ basis.mT, rtol=0, atol=1e-12)
    assert torch.allclose(frame[:, : n - 1], basis[:, : n - 1], rtol=0, atol=1e-12)


@pytest.mark.parametrize(("n", "k"), SIZES)
def test_agrees_with_the_chain_of_matrices(n: int, k: int) -> None:
    check_agreement_with_the_chain(normal(2, 3, k, n - 1), normal(2, 3, k, seed=1), normal(2, 3, n, seed=2))
    check_agreement_with_the_chain(normal(20, k, n - 1), normal(20, k, seed=1), normal(20, n, seed=2))


def check_agreement_with_the_chain(tangents: Tensor, action: Tensor, actuation: Tensor) -> None:
    reflectors, k = sphere_exp(tangents), tangents.shape[-2]
    chain = matrix_chain(reflectors)
    assert torch.allclose(householder_frame(reflectors), chain, rtol=0, atol=1e-14)
    assert torch.allclose(householder_apply(reflectors, action), (chain @ action.unsqueeze(-1)).squeeze(-1))
    coordinates = householder_coordinates(reflectors, actuation)
    assert torch.allclose(coordinates[..., :k], (chain.mT @ actuation.unsqueeze(-1)).squeeze(-1))


def test_the_other_coordinates_are_what_the_basis_misses() -> None:
    reflectors, actuation = sphere_exp(normal(50, 2, 6)), normal(50, 7, seed=1)
    chain = matrix_chain(reflectors)
    missed = actuation.unsqueeze(-1) - chain @ (chain.mT @ actuation.unsqueeze(-1))
    others = householder_coordinates(reflectors, actuation)[..., 2:]
    assert torch.allclose(others.square().sum(-1), missed.square().sum((-2, -1)))


def test_flipped_reflectors_invert() -> None:
    reflectors, vector = sphere_exp(normal(50, 3, 6)), normal(50, 7, seed=1)
    assert torch.allclose(reflect(reflectors.flip(-2), reflect(reflectors, vector)), vector)


@pytest.mark.parametrize("length", [0.0, 1e-300, 1e-17, 1e-9, 1e-4, 0.3, math.pi, 20.0])
def test_exponential_map_is_exact_at_every_length(length: float) -> None:
    direction = torch.tensor([0.6, 0.0, -0.8], dtype=torch.float64)
    expected = torch.tensor([math.cos(length), *(math.sin(length) * direction).tolist()], dtype=torch.float64)
    assert torch.allclose(sphere_exp(length * direction), expected, rtol=1e-15, atol=1e-15)


@pytest.mark.parametrize("length", [0.0, 1e-5, 0.3, math.pi, 7.0])
def test_gradients_agree_with_finite_differences(length: float) -> None:
    """At zero too, where a norm has no derivative: a network that starts at zero must be able to leave it."""
    tangent = (length * functional.normalize(normal(3, 2, 4), dim=-1)).requires_grad_()
    action = normal(3, 2, seed=1).requires_grad_()

    def actuation(tangent: Tensor, action: Tensor) -> Tensor:
        return householder_apply(sphere_exp(tangent), action)

    assert torch.autograd.gradcheck(actuation, (tangent, action))
    assert torch.autograd.gradgradcheck(actuation, (tangent, action))


@pytest.mark.parametrize("function", [householder_frame, householder_apply, householder_coordinates, reflect])
@pytest.mark.parametrize(("n", "k"), [(2, 2), (5, 2), (MANY_REFLECTORS, MANY_REFLECTORS)])
def test_derivatives_by_the_reflectors_agree_with_finite_differences(
    function: Callable[..., Tensor], n: int, k: int
) -> None:
    """Off the sphere too; with as many reflectors as are taken all at once."""
    reflectors = normal(2, k, n).mul(0.5).requires_grad_()
    vector = normal(2, k if function is householder_apply else n, seed=1).requires_grad_()
    arguments = (reflectors,) if function is householder_frame else (reflectors, vector)
    assert torch.autograd.gradcheck(function, arguments, fast_mode=k > 5)
    assert torch.autograd.gradgradcheck(function, arguments, fast_mode=k > 5)


@pytest.mark.parametrize("length", [0.0, 1e-5, 0.3, math.pi, 7.0])
def test_derivatives_of_the_exponential_map_agree_with_finite_differences(length: float) -> None:
    tangent = (length * functional.normalize(normal(3, 4), dim=-1)).requires_grad_()
    assert torch.autograd.gradcheck(sphere_exp, tangent)
    assert torch.autograd.gradgradcheck(sphere_exp, tangent)


@pytest.mark.parametrize(("n", "k"), [(1, 1), (3, 3), (5, 2)])
def test_derivatives_of_least_squares_agree_with_finite_differences(n: int, k: int) -> None:
    basis, actuation = normal(2, n, k).requires_grad_(), normal(2, n, seed=1).requires_grad_()
    assert torch.autograd.gradcheck(least_squares, (basis, actuation))
    assert torch.autograd.gradgradcheck(least_squares, (basis, actuation))


def test_gradient_at_zero_is_the_identity_in_both_precisions() -> None:
    for dtype in (torch.float32, torch.float64):
        jacobian = torch.autograd.functional.jacobian(sphere_exp, torch.zeros(3, dtype=dtype))
        assert torch.equal(jacobian, torch.cat([torch.zeros(1, 3, dtype=dtype), torch.eye(3, dtype=dtype)]))


def test_single_precision_is_within_one_millionth() -> None:
    """For tangents up to length pi, which reach the whole sphere."""
    directions = functional.normalize(normal(4096, 2, 6), dim=-1)
    tangent = torch.linspace(0, math.pi, 4096)[:, None, None] * directions.float()
    action = functional.normalize(normal(4096, 2, seed=1), dim=-1).float()
    single = householder_apply(sphere_exp(tangent), action)
    exact = householder_apply(sphere_exp(tangent.double()), action.double())
    assert (single - exact).abs().max() < 1e-6


@pytest.mark.parametrize(
    ("n", "k"), [(7, 2), (7, 7), (24, 4), (64, 4), (MANY_REFLECTORS, MANY_REFLECTORS), (64, 16)]
)
@pytest.mark.parametrize("batch", [SMALL_BATCH, 500])
def test_columns_are_orthonormal_in_single_precision(n: int, k: int, batch: int) -> None:
    """Within a millionth in 99 of 100 frames, and not far above it in any: 4 k^2 roundings lie behind an entry."""
    lengths = math.pi * torch.rand(batch, k, 1, generator=torch.Generator().manual_seed(0))
    tangent = lengths * functional.normalize(normal(batch, k, n - 1), dim=-1).float()
    frame = householder_frame(sphere_exp(tangent)).double()
    wrong = (frame.mT @ frame - torch.eye(k)).abs().amax((-2, -1))
    assert float(wrong.quantile(0.99)) < 1e-6
    assert float(wrong.max()) < 2e-6


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_many_reflectors_give_the_same_one_by_one_and_all_at_once(dtype: torch.dtype) -> None:
    reflectors = sphere_exp(normal(4 * SMALL_BATCH, MANY_REFLECTORS, 15, dtype=dtype))
    vector = functional.normalize(normal(4 * SMALL_BATCH, 16, seed=1, dtype=dtype), dim=-1)
    parts = zip(reflectors.split(SMALL_BATCH), vector.split(SMALL_BATCH), strict=True)
    at_once = torch.cat([reflect(*part) for part in parts])
    tolerance = 1e-6 if dtype == torch.float32 else 1e-14
    assert torch.allclose(reflect(reflectors, vector), at_once, rtol=0, atol=tolerance)
    assert not torch.equal(reflect(reflectors, vector), at_once)  # or this test compares nothing


def test_many_reflectors_work_in_half_precision_and_for_no_batch_at_all() -> None:
    reflectors, action = sphere_exp(normal(2, MANY_REFLECTORS, 15)), normal(2, MANY_REFLECTORS, seed=1)
    exact = householder_apply(reflectors, action)
    half = householder_apply(reflectors.bfloat16(), action.bfloat16())
    assert half.dtype == torch.bfloat16
    assert torch.allclose(half.double(), exact, atol=0.1)
    with torch.autocast("cpu"):
        mixed = householder_apply(reflectors.float(), action.float())
    assert torch.allclose(mixed.double(), exact, atol=1e-5)
    assert householder_apply(reflectors[:0], action[:0]).shape == (0, 16)
    assert torch.allclose(householder_apply(reflectors[0], action[0]), exact[0])
    assert torch.allclose(torch.func.vmap(householder_apply)(reflectors, action), exact)


def test_the_choice_by_shape_survives_compilation_and_export() -> None:
    """One graph, without a guard on the batch: what is exported with a small one takes a large one."""

    class Map(torch.nn.Module):
        def forward(self, reflectors: Tensor, action: Tensor) -> Tensor:
            return householder_apply(reflectors, action)

    reflectors, action = sphere_exp(normal(99, MANY_REFLECTORS, 15)), normal(99, MANY_REFLECTORS, seed=1)
    exact, few = householder_apply(reflectors, action), (reflectors[:3], action[:3])
    compiled = torch.compile(householder_apply, fullgraph=True, backend="eager")
    assert torch.allclose(compiled(*few), exact[:3])
    batch = torch.export.Dim("batch")
    exported = torch.export.export(Map(), few, dynamic_shapes=({0: batch}, {0: batch}))
    assert torch.allclose(exported.module()(reflectors, action), exact)
