"""Laws of the Householder geometry, and agreement with an explicit chain of n x n matrices in float64."""

import math

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from torch import Tensor

from nht.geometry import householder_apply, householder_coordinates, householder_frame, reflect, sphere_exp

SIZES = [(2, 1), (3, 3), (7, 2), (7, 3), (12, 5)]  # (n, k)


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
@given(tangents())
def test_exponential_map_and_frame_keep_their_lipschitz_constants(tangent: Tensor) -> None:
    """1 for the exponential map, 2 sqrt(k) for the frame in the spectral norm (Theorem 1)."""
    other = tangent + normal(*tangent.shape, seed=1) * tangent.abs().max() * 0.1
    reflectors, others = sphere_exp(tangent), sphere_exp(other)
    apart = (reflectors - others).norm(dim=(-2, -1))
    assert (apart <= (tangent - other).norm(dim=(-2, -1)) + 1e-14).all()
    frames_apart = torch.linalg.matrix_norm(householder_frame(reflectors) - householder_frame(others), ord=2)
    assert (frames_apart <= 2 * math.sqrt(tangent.shape[-2]) * apart + 1e-14).all()


@pytest.mark.parametrize(("n", "k"), SIZES)
def test_agrees_with_the_chain_of_matrices(n: int, k: int) -> None:
    reflectors = sphere_exp(normal(4, 3, k, n - 1))  # two batch dimensions
    action, actuation = normal(4, 3, k, seed=1), normal(4, 3, n, seed=2)
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
    tangent = (length * torch.nn.functional.normalize(normal(3, 2, 4), dim=-1)).requires_grad_()
    action = normal(3, 2, seed=1).requires_grad_()

    def actuation(tangent: Tensor, action: Tensor) -> Tensor:
        return householder_apply(sphere_exp(tangent), action)

    assert torch.autograd.gradcheck(actuation, (tangent, action))
    assert torch.autograd.gradgradcheck(actuation, (tangent, action))


def test_gradient_at_zero_is_the_identity_in_both_precisions() -> None:
    for dtype in (torch.float32, torch.float64):
        jacobian = torch.autograd.functional.jacobian(sphere_exp, torch.zeros(3, dtype=dtype))
        assert torch.equal(jacobian, torch.cat([torch.zeros(1, 3, dtype=dtype), torch.eye(3, dtype=dtype)]))


def test_single_precision_is_within_one_millionth() -> None:
    """For tangents up to length pi, which reach the whole sphere."""
    directions = torch.nn.functional.normalize(normal(4096, 2, 6), dim=-1)
    tangent = torch.linspace(0, math.pi, 4096)[:, None, None] * directions.float()
    action = torch.nn.functional.normalize(normal(4096, 2, seed=1), dim=-1).float()
    single = householder_apply(sphere_exp(tangent), action)
    exact = householder_apply(sphere_exp(tangent.double()), action.double())
    assert (single - exact).abs().max() < 1e-6
