"""Action maps of several learners, applied together: each does what it does alone."""

import copy

import pytest
import torch

import nht
from nht.recipes.maps.kinds import KINDS, make_map
from nht.recipes.maps.side_by_side import MapsSideBySide, grouped
from nht.recipes.sections import EnvConfig, MapConfig

MOTORS, CONTEXT = 7, 10
LOW, HIGH = torch.linspace(-1.0, -0.4, MOTORS), torch.linspace(0.3, 1.2, MOTORS)


def made(kind="nht", seed=0, **settings):
    """An untrained map of a kind with numbers of its own in whatever training would set."""
    torch.manual_seed(seed)
    map = make_map(MapConfig(kind, hidden=[8, 8], **settings), CONTEXT, MOTORS, seed, EnvConfig())
    for parameter in map.parameters():
        parameter.data += 0.1 * torch.randn_like(parameter)
    if isinstance(map, nht.SVD):
        map.frame.copy_(torch.linalg.qr(torch.randn(MOTORS, map.action_dim)).Q)
    map.set_action_scale(1.0 + seed)
    return map


def assert_each(maps, batch=(5,), tolerance=1e-6, limits=(LOW, HIGH)):
    """All that is asked of maps, beside what each answers alone."""
    together = MapsSideBySide(maps)
    shape = (len(maps), *batch)
    dtype = maps[0].action_scale.dtype
    context = torch.randn(*shape, together.context_dim, dtype=dtype)
    action = 1.5 * torch.randn(*shape, together.action_dim, dtype=dtype)
    actuation = torch.randn(*shape, together.actuation_dim, dtype=dtype)
    found = {
        "forward": together(action, context),
        "project": together.project(actuation, context),
        "decode": together.decode(action, context),
        "limited": together.decode(action, context, *limits),
        "encode": together.encode(actuation, context),
    }
    for place, map in enumerate(maps):
        rows = context[place]
        alone = {
            "forward": map(action[place], rows),
            "project": map.project(actuation[place], rows),
            "decode": map.decode(action[place], rows),
            "limited": map.decode(action[place], rows, *limits),
            "encode": map.encode(actuation[place], rows),
        }
        for name, expected in alone.items():
            torch.testing.assert_close(
                found[name][place],
                expected,
                rtol=tolerance,
                atol=tolerance,
                msg=lambda text, n=name: f"{n}: {text}",
            )
    return together


@pytest.mark.parametrize("batch", [(5,), (2, 3), ()])
@pytest.mark.parametrize("kind", sorted(KINDS))
def test_every_kind(kind, batch):
    assert_each([made(kind, seed) for seed in range(3)], batch, tolerance=1e-5)


@pytest.mark.parametrize("kind", sorted(KINDS))
def test_every_kind_with_corrections(kind):
    assert_each([nht.Residual(made(kind, seed), 0.1 * (1 + seed)) for seed in range(3)], tolerance=1e-5)
    assert_each([nht.Residual(made(kind, seed), 0.2) for seed in range(3)], tolerance=1e-5)


@pytest.mark.parametrize("offset", ["constant", "contextual"])
@pytest.mark.parametrize("kind", ["nht", "scl", "svd"])
def test_offsets(kind, offset):
    assert_each([made(kind, seed, offset=offset) for seed in range(3)], tolerance=1e-5)


@pytest.mark.parametrize("saturation", ["clip", "scale"])
def test_at_the_motors_limits_each_does_its_own(saturation):
    maps = [made("nht", seed) for seed in range(3)]
    for map in maps:
        map.saturation = saturation
    assert_each(maps, tolerance=1e-5)
    maps[1].saturation = "clip" if saturation == "scale" else "scale"
    assert_each(maps, tolerance=1e-5)
    assert [places for places, *_ in grouped(maps)] == [[0, 2], [1]]


def test_turned_maps():
    maps = [nht.Aligned(made("nht", seed), torch.linalg.qr(torch.randn(2, 2)).Q) for seed in range(2)]
    assert_each(maps, tolerance=1e-5)


def test_kinds_and_shapes_of_all_sorts():
    other = make_map(MapConfig("nht", hidden=[16], activation="relu"), CONTEXT, MOTORS, 3)
    heads = make_map(MapConfig("nht", hidden=[8, 8], multi_head=True), CONTEXT, MOTORS, 4)
    maps = [made("nht", 0), made("laser", 1), other, made("nht", 2), made("svd", 1), heads, made("laser", 5)]
    assert_each(maps, tolerance=1e-5)
    assert [places for places, *_ in grouped(maps)] == [[0, 3], [1, 6], [2], [4], [5]]


def test_how_maps_were_trained_does_not_part_them():
    maps = [made("nht", 0), made("nht", 1, lipschitz=2.0), made("nht", 2, start="random")]
    assert_each(maps, tolerance=1e-5)
    assert [places for places, *_ in grouped(maps)] == [[0, 1, 2]]


def test_the_same_map_for_all_is_one_call_of_it():
    map = made()
    together = assert_each([map, copy.deepcopy(map), map])
    ((_, _, parameters, buffers),) = grouped(together.maps)
    assert (parameters, buffers) == ({}, {})


def test_a_map_alone():
    assert_each([made()])


def test_limits_of_each_row():
    maps = [made("nht", seed) for seed in range(2)]
    assert_each(maps, batch=(4,), tolerance=1e-5, limits=(LOW, None))
    assert_each(maps, batch=(4,), tolerance=1e-5, limits=(None, HIGH))


def test_an_action_that_is_no_number_is_its_learners_alone():
    maps = [made("nht", seed) for seed in range(3)]
    together = MapsSideBySide(maps)
    context, action = torch.randn(3, 4, CONTEXT), torch.randn(3, 4, 2)
    expected = together.decode(action, context, LOW, HIGH)
    action[1] = torch.nan
    found = together.decode(action, context, LOW, HIGH)
    assert found[1].isnan().all()
    assert torch.equal(found[[0, 2]], expected[[0, 2]])


def test_a_copy_is_of_its_own():
    maps = [made("nht", seed) for seed in range(2)]
    together = MapsSideBySide(maps)
    context, action = torch.randn(2, 4, CONTEXT), torch.randn(2, 4, 2)
    expected = together(action, context)
    twin = copy.deepcopy(together)
    assert torch.equal(twin(action, context), expected)
    for parameter in together.parameters():
        parameter.data.zero_()
    assert torch.equal(twin(action, context), expected)


def test_in_another_precision():
    maps = [made("nht", seed) for seed in range(2)]
    together = MapsSideBySide(maps)
    context, action = torch.randn(2, 4, CONTEXT), torch.randn(2, 4, 2)
    together(action, context)
    together.to(torch.float64)
    assert together.maps[0].action_scale.dtype == torch.float64
    found = together(action.double(), context.double())
    assert found.dtype == torch.float64
    for place, map in enumerate(maps):
        torch.testing.assert_close(found[place], map(action[place].double(), context[place].double()))


def test_it_leaves_the_maps_as_they_were():
    maps = [made("laser", seed) for seed in range(2)]
    kept = [copy.deepcopy(map.state_dict()) for map in maps]
    assert_each(maps, tolerance=1e-5)
    for map, before in zip(maps, kept, strict=True):
        assert all(torch.equal(value, before[name]) for name, value in map.state_dict().items())


def test_what_a_policy_learns_from():
    together = MapsSideBySide([made("nht", seed) for seed in range(2)])
    action = torch.randn(2, 4, 2, requires_grad=True)
    together(action, torch.randn(2, 4, CONTEXT)).square().sum().backward()
    assert action.grad.ne(0).all()


# Bad input.


@pytest.mark.parametrize(
    ("other", "name"),
    [
        (
            lambda: made("nht", action_dim=3),
            "action_dim: the map of learner 0 has 2, that of learner 2 has 3",
        ),
        (lambda: made("none"), "action_dim: the map of learner 0 has 2, that of learner 2 has 7"),
        (lambda: nht.SVD(5, 2), "actuation_dim: the map of learner 0 has 7, that of learner 2 has 5"),
        (lambda: nht.SVD(MOTORS, 2, 4), "context_dim: the map of learner 0 has 10, that of learner 2 has 4"),
        (
            lambda: nht.Residual(made(), 0.1),
            "action_dim: the map of learner 0 has 2, that of learner 2 has 9",
        ),
    ],
)
def test_maps_of_other_widths(other, name):
    with pytest.raises(ValueError, match=f"learners of one population share {name}"):
        MapsSideBySide([made(), made(seed=1), other()])


def test_maps_of_other_observations():
    maps = [made(), made(seed=1)]
    maps[1].context_keys = ("joint_angle", "tool_position")
    with pytest.raises(
        ValueError, match="share context_keys: the map of learner 0 has None, that of learner 1"
    ):
        MapsSideBySide(maps)


def test_rows_of_another_width():
    together = MapsSideBySide([made(), made(seed=1)])
    with pytest.raises(ValueError, match="3"):
        together(torch.randn(2, 4, 3), torch.randn(2, 4, CONTEXT))
