"""At the motors' limits: laws of ``scale`` and ``clip``, and of what an action means through a map."""

import copy
import math
import pickle
from typing import Any

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from torch import Tensor

import nht
from nht.maps import ActionMap
from nht.saturation import saturate, scale_into

CONTEXT_DIM = 3
SIZES = st.sampled_from([1e-3, 1.0, 30.0, 1e4])


@st.composite
def cases(draw: st.DrawFn) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """Actuations, limits and a rest within these: one-sided, asymmetric, infinite, some with no room at all."""
    n, seed = draw(st.integers(1, 6)), draw(st.integers(0, 10_000))
    generator = torch.Generator().manual_seed(seed)

    def uniform(*shape: int) -> Tensor:
        return torch.rand(*shape, generator=generator, dtype=torch.float64)

    low, high = -draw(SIZES) * uniform(n), draw(SIZES) * uniform(n)
    rest = low + uniform(8, n) * (high - low)
    if draw(st.booleans()):
        rest[0] = high  # no room upwards
    if draw(st.booleans()):
        low, rest = low.where(uniform(n) < 0.5, -math.inf), rest
    if draw(st.booleans()):
        high = high.where(uniform(n) < 0.5, math.inf)
    actuation = rest + draw(SIZES) * (2 * uniform(8, n) - 1)
    if draw(st.booleans()):
        actuation[1] = rest[1]
    return actuation, rest, low, high


@settings(deadline=None, max_examples=150)
@given(cases())
def test_scaling_shortens_the_way_from_rest_as_little_as_it_can(
    case: tuple[Tensor, Tensor, Tensor, Tensor],
) -> None:
    actuation, rest, low, high = case
    scaled = scale_into(actuation, low, high, rest)
    assert ((low <= scaled) & (scaled <= high)).all()
    way, full = scaled - rest, actuation - rest
    length = full.norm(dim=-1)
    share = (way * full).sum(-1) / full.square().sum(-1).clamp_min(1e-300)
    rounding = 1e-12 * (1 + rest.norm(dim=-1) + length)
    assert ((share >= -1e-9) & (share <= 1 + 1e-9)).all()
    assert ((way - share.unsqueeze(-1) * full).norm(dim=-1) <= rounding).all()  # collinear
    inside = ((low <= actuation) & (actuation <= high)).all(-1)
    assert torch.equal(scaled[inside], actuation[inside])
    further = rest + (1 + 1e-6) * way + 1e-6 * full  # t was the largest
    beyond = ((further < low) | (further > high)).any(-1)
    assert (inside | beyond | (length < 1e-9)).all()


@settings(deadline=None, max_examples=50)
@given(cases(), st.sampled_from([torch.float32, torch.float64]))
def test_clipping_is_clamping_bit_for_bit(
    case: tuple[Tensor, Tensor, Tensor, Tensor], dtype: torch.dtype
) -> None:
    actuation, rest, low, high = case
    clipped = saturate(actuation, low.to(dtype), high.to(dtype), kind="clip", rest=rest)
    assert clipped.dtype == dtype
    assert torch.equal(clipped, actuation.to(dtype).clamp(low.to(dtype), high.to(dtype)))
    assert torch.equal(saturate(actuation, None, high, kind="clip"), actuation.clamp(max=high))
    assert torch.equal(saturate(actuation, low, kind="clip"), actuation.clamp(min=low))


@pytest.mark.parametrize("kind", ["scale", "clip"])
def test_without_limits_nothing_changes(kind: Any) -> None:
    actuation = torch.randn(5, 3, generator=torch.Generator().manual_seed(0))
    assert saturate(actuation, kind=kind) is actuation
    infinite = torch.full((3,), math.inf)
    assert torch.equal(saturate(actuation, -infinite, infinite, kind=kind), actuation)


def test_a_rest_beyond_a_limit_does_not_bring_the_other_motors_to_a_halt() -> None:
    rest, low, high = torch.tensor([1.5, 0.0]), -torch.ones(2), torch.ones(2)
    assert scale_into(rest, low, high, rest).tolist() == [1.0, 0.0]
    assert scale_into(rest + torch.tensor([0.5, 0.5]), low, high, rest).tolist() == [1.0, 0.5]
    assert scale_into(rest + torch.tensor([0.5, 2.0]), low, high, rest).tolist() == [1.0, 1.0]
    assert scale_into(torch.tensor([-0.5, 0.5]), low, high, rest).tolist() == [-0.5, 0.5]  # inside: as it is
    assert scale_into(torch.tensor([-3.5, 0.5]), low, high, rest).tolist() == [-1.0, 0.25]


@pytest.mark.parametrize("dtype", [torch.float16, torch.bfloat16, torch.float32, torch.float64])
def test_numbers_at_the_ends_of_the_range(dtype: torch.dtype) -> None:
    largest = torch.finfo(dtype).max
    low, high = (
        torch.tensor([-1.0, 0.0, -math.inf], dtype=dtype),
        torch.tensor([1.0, 2.0, math.inf], dtype=dtype),
    )
    rows = [
        [math.inf, 0.5, 0.0],
        [-math.inf, math.inf, 1.0],
        [largest, largest, -largest],
        [0.0, -1e-3, 0.0],
        [0.0, 0.0, 0.0],
        [math.nan, 0.5, 0.0],
        [0.5, 0.5, math.nan],
    ]
    scaled = saturate(torch.tensor(rows, dtype=dtype), low, high, kind="scale")
    assert scaled.dtype == dtype
    assert scaled[:5].isfinite().all()
    assert ((low <= scaled[:5]) & (scaled[:5] <= high)).all()
    assert scaled[0, 0] == 1
    assert scaled[4].tolist() == [0, 0, 0]
    assert scaled[5:].isnan().any(-1).all()  # whoever executes it can see that the copy diverged
    assert math.isnan(scaled[5, 0])
    assert math.isnan(scaled[6, 2])


@pytest.mark.parametrize("dtype", [torch.float16, torch.bfloat16])
def test_half_precision_keeps_the_direction(dtype: torch.dtype) -> None:
    actuation = torch.randn(50, 4, generator=torch.Generator().manual_seed(0)).mul(100).to(dtype)
    ones = torch.ones(4, dtype=dtype)
    scaled = saturate(actuation, -ones, ones, kind="scale")
    expected = actuation.double() / actuation.double().abs().amax(-1, keepdim=True).clamp_min(1)
    assert (scaled.double() - expected).abs().max() < 2 * torch.finfo(dtype).eps


def test_gradients_agree_with_finite_differences() -> None:
    generator = torch.Generator().manual_seed(0)
    actuation = 3 * torch.randn(20, 4, generator=generator, dtype=torch.float64)
    rest = 0.1 * torch.randn(20, 4, generator=generator, dtype=torch.float64)
    low, high = (
        torch.tensor([-1.0, -0.5, -math.inf, -2.0]).double(),
        torch.tensor([1.0, 2.0, 1.0, math.inf]).double(),
    )
    inputs = actuation.requires_grad_(), rest.requires_grad_()
    assert torch.autograd.gradcheck(lambda u, r: scale_into(u, low, high, r), inputs)


def test_gradients_are_finite_where_there_is_no_room_and_no_way() -> None:
    actuation = torch.tensor([[1.0, 0.5], [0.0, 0.0], [-1.0, 3.0]], requires_grad=True)
    scaled = scale_into(actuation, torch.zeros(2), torch.tensor([0.0, 1.0]))
    scaled.sum().backward()
    assert actuation.grad is not None
    assert actuation.grad.isfinite().all()


def test_unknown_kinds_are_refused() -> None:
    with pytest.raises(ValueError, match="saturation must be 'scale' or 'clip', got 'squash'"):
        saturate(torch.ones(2), torch.zeros(2), kind="squash")  # type: ignore[arg-type]
    with pytest.raises(ValueError, match="saturation must be one of scale, clip, got 'squash'"):
        nht.SVD(4, 2).saturation = "squash"  # type: ignore[assignment]


# Through a map.


def maps() -> list[ActionMap]:
    made: list[ActionMap] = [
        nht.NHT(CONTEXT_DIM, 5, 2, (8,)),
        nht.NHT(CONTEXT_DIM, 5, 2, (8,), offset="constant"),
        nht.NHT(CONTEXT_DIM, 5, 2, (8,), offset="contextual"),
        nht.SCL(CONTEXT_DIM, 5, 2, (8,), offset="contextual"),
        nht.SVD(5, 2, CONTEXT_DIM, offset="contextual"),
        nht.LASER(CONTEXT_DIM, 5, 2, (8,), beta_dynamics=0),
        nht.Identity(5, CONTEXT_DIM),
    ]
    generator = torch.Generator().manual_seed(0)
    for map in made:
        for name, value in map.state_dict().items():
            if "offset" in name and name.endswith(("bias", "value", "slope")):
                value.copy_(0.05 * torch.rand(value.shape, generator=generator) + 0.05)
        map.set_action_scale(3.0)
    return [*made, nht.Residual(made[1], 0.5), nht.Aligned(made[2], torch.tensor([[0.0, 1.0], [-1.0, 0.0]]))]


each_map = pytest.mark.parametrize(
    "map", maps(), ids=lambda map: f"{type(map).__name__}-{getattr(map, 'offset', '')}"
)
LOW, HIGH = torch.full((5,), -0.5), torch.full((5,), 0.8)


def some(map: ActionMap, *batch: int) -> tuple[Tensor, Tensor]:
    generator = torch.Generator().manual_seed(1)
    return (
        2 * torch.rand(*batch, map.action_dim, generator=generator) - 1,
        torch.randn(*batch, CONTEXT_DIM, generator=generator),
    )


@each_map
@torch.no_grad()
def test_decoding_scales_maps_and_saturates(map: ActionMap) -> None:
    action, context = some(map, 4, 6)
    raw = map(3 * action, context)
    assert torch.equal(map.decode(action, context), raw)
    map.saturation = "clip"
    assert torch.equal(map.decode(action, context, LOW, HIGH), raw.clamp(LOW, HIGH))
    assert torch.equal(map.decode(action, context, high=HIGH), raw.clamp(max=HIGH))
    map.saturation = "scale"
    scaled, rest = map.decode(action, context, LOW, HIGH), map.rest(context)
    assert rest.shape == raw.shape
    assert torch.equal(scaled, scale_into(raw, LOW, HIGH, rest))
    assert ((scaled >= LOW) & (scaled <= HIGH)).all()
    per_copy = map.decode(action, context, LOW.expand(4, 6, 5), HIGH.expand(4, 6, 5))
    assert torch.equal(per_copy, scaled)
    assert not torch.equal(scaled, raw)


@each_map
@torch.no_grad()
def test_encoding_is_the_way_back(map: ActionMap) -> None:
    action, context = some(map, 7)
    actuation = map(3 * action, context)
    assert torch.equal(map.encode(actuation, context), map.project(actuation, context) / 3)
    if isinstance(map, nht.LinearActionMap):
        torch.testing.assert_close(
            map.encode(map.decode(action, context), context), action, rtol=1e-4, atol=1e-5
        )


@each_map
@torch.no_grad()
def test_what_is_scaled_stays_in_the_span_around_the_rest(map: ActionMap) -> None:
    if not isinstance(map, nht.LinearActionMap):
        return
    map.saturation = "scale"
    action, context = some(map, 50)
    scaled = map.decode(action, context, LOW, HIGH)
    torch.testing.assert_close(map(map.project(scaled, context), context), scaled, rtol=1e-4, atol=1e-5)
    torch.testing.assert_close(map(0 * action, context), map.rest(context))


@each_map
@pytest.mark.parametrize("dtype", [torch.float16, torch.bfloat16, torch.float64])
@torch.no_grad()
def test_other_precisions(map: ActionMap, dtype: torch.dtype) -> None:
    action, context = some(map, 6)
    other = copy.deepcopy(map).to(dtype)
    other.saturation = "scale"
    for theirs in (dtype, torch.float32):
        decoded = other.decode(action.to(theirs), context.to(theirs), LOW, HIGH)
        assert decoded.dtype == LOW.dtype
        assert ((decoded >= LOW) & (decoded <= HIGH)).all()
        actuation = other.decode(action.to(theirs), context.to(theirs))
        assert actuation.dtype == other.encode(actuation, context.to(theirs)).dtype == dtype
        assert (actuation.float() - map(3 * action, context)).abs().max() < 0.3


@each_map
def test_decoding_compiles_into_one_graph_and_batches_by_vmap(map: ActionMap) -> None:
    torch.compiler.reset()  # it counts how often `decode` was compiled, for whichever map
    map.saturation = "scale"
    action, context = some(map, 6)
    expected = map.decode(action, context, LOW, HIGH)
    batched = torch.func.vmap(map.decode, (0, 0, None, None))(action, context, LOW, HIGH)
    torch.testing.assert_close(batched, expected)
    compiled = torch.compile(map.decode, fullgraph=True, backend="aot_eager")
    torch.testing.assert_close(compiled(action, context, LOW, HIGH), expected)


@pytest.mark.parametrize("dtype", [torch.float16, torch.bfloat16])
def test_the_jacobian_works_in_half_precision(dtype: torch.dtype) -> None:
    map = nht.JacobianPinv(
        [0.0, 0.0, 0.1, -0.1, 0.0, 0.0, 0.0], [1.5, -1.5, 1.5, -1.5, 1.5, -1.5, 0.0], [0.3] * 7, 0.3
    )
    context = torch.linspace(-1, 1, 7)
    action = torch.full((6,), 0.1)
    actuation = map.to(dtype).decode(action, context)
    assert actuation.dtype == map.encode(actuation, context).dtype == dtype
    torch.testing.assert_close(actuation.float(), map.float().decode(action, context), rtol=0.1, atol=0.02)


def test_where_the_span_is_everything_there_is_nothing_to_stay_in() -> None:
    assert nht.NHT(CONTEXT_DIM, 5, 4, (8,)).saturation == nht.SVD(5, 1).saturation == "scale"
    assert nht.NHT(CONTEXT_DIM, 5, 5, (8,)).saturation == nht.Identity(5).saturation == "clip"
    assert nht.Residual(nht.SVD(5, 1), 0.1).saturation == "scale"  # that of the map inside


def test_the_default_and_what_is_set_survive_copies() -> None:
    map = nht.NHT(CONTEXT_DIM, 5, 2, (8,))
    other = {"scale": "clip", "clip": "scale"}[map.saturation]
    map.saturation = other  # type: ignore[assignment]
    assert copy.deepcopy(map).saturation == pickle.loads(pickle.dumps(map)).saturation == other
    assert nht.Residual(map, 0.1).saturation == nht.Aligned(map).saturation == other
    assert nht.NHT(CONTEXT_DIM, 5, 2, (8,)).saturation != other


@pytest.mark.parametrize("value", [0.0, -1.0, math.inf, math.nan, torch.ones(2), 1e39])
def test_scales_that_mean_nothing_are_refused(value: Any) -> None:
    map = nht.SVD(4, 2)
    with pytest.raises(ValueError, match="action_scale must be a positive, finite number, got"):
        map.set_action_scale(value)
    assert map.action_scale == 1


def test_the_scale_is_set_in_place_in_the_maps_precision() -> None:
    map = nht.SVD(4, 2).double()
    buffer = map.action_scale
    map.set_action_scale(torch.tensor(2.5))
    assert map.action_scale is buffer
    assert (buffer.dtype, float(buffer)) == (torch.float64, 2.5)


# Widths.


class Own(nht.ActionMap):
    """Checks nothing, under names of its own."""

    def __init__(self) -> None:
        super().__init__(CONTEXT_DIM, 5, 2)

    def forward(self, a: Tensor, c: Tensor) -> Tensor:  # type: ignore[override]
        return a.new_zeros(*a.shape[:-1], 5)

    def project(self, u: Tensor, c: Tensor) -> Tensor:  # type: ignore[override]
        return u[..., :2]


class Loose:
    """Brings a method from outside the family."""

    def forward(self, action: Tensor, context: Tensor) -> Tensor:
        return action.new_zeros(*action.shape[:-1], 5)


class Mixed(Loose, Own):
    pass


class Further(nht.NHT):
    def forward(self, action: Tensor, context: Tensor) -> Tensor:
        return 2 * super().forward(action[..., :2], context)


@pytest.mark.parametrize(
    "map", [*maps(), Own(), Mixed(), Further(CONTEXT_DIM, 5, 2, (8,))], ids=lambda map: type(map).__name__
)
def test_wrong_widths_are_refused_wherever_a_map_takes_them(map: ActionMap) -> None:
    action, context, actuation = torch.ones(5, map.action_dim), torch.ones(5, CONTEXT_DIM), torch.ones(5, 5)
    name = type(map).__name__
    for call in (map, map.forward, map.decode):
        for width in {1, 2, 3, 5, 6, 8} - {map.action_dim}:
            with pytest.raises(
                ValueError,
                match=rf"takes an action of width {map.action_dim}, got one of shape \(5, {width}\)",
            ):
                call(torch.ones(5, width), context)
        with pytest.raises(
            ValueError, match=rf"{name} takes a context of width 3, got one of shape \(5, 4\)"
        ):
            call(action, torch.ones(5, 4))
        with pytest.raises(ValueError, match=r"got one of shape \(\)"):
            call(torch.tensor(1.0), context)
    for call in (map.project, map.encode):
        for width in (1, 4, 6):
            with pytest.raises(
                ValueError, match=rf"{name} takes an actuation of width 5, got one of shape \(5, {width}\)"
            ):
                call(torch.ones(5, width), context)
        with pytest.raises(ValueError, match=rf"{name} takes a context of width 3"):
            call(actuation, torch.ones(5, 2))
    assert map(action, context).shape == actuation.shape


def test_batches_broadcast_as_they_did() -> None:
    map = nht.NHT(CONTEXT_DIM, 5, 2, (8,))
    one, many = torch.ones(CONTEXT_DIM), torch.ones(4, CONTEXT_DIM)
    assert map(torch.ones(4, 2), one).shape == map.decode(torch.ones(2), many).shape == (4, 5)
    assert map(action=torch.ones(2), context=one).shape == (5,)
    assert map.project(actuation=torch.ones(5), context=one).shape == (2,)
