"""Maps that train together become what each would be alone, whoever trains beside them."""

from __future__ import annotations

from typing import Any

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from torch import Tensor

import nht
from nht import steps_together
from nht.demos import Demos
from nht.limits_together import LimitsTogether
from nht.lipschitz import LipschitzProjection
from nht.maps import ActionMap
from nht.networks import ContextNetwork
from nht.networks_together import NetworksTogether
from nht.train import MapTraining, train_map
from nht.train_together import cosine, train_maps

N, K, CONTEXT_DIM, EPISODES, LENGTH = 6, 2, 3, 20, 30

VARIED: list[dict[str, Any]] = [
    {"hidden": (32,), "activation": "tanh"},
    {"hidden": (17, 9), "activation": "relu", "lipschitz": 2.0, "normalise": True},
    {"hidden": (8, 21), "activation": "sigmoid", "lipschitz": 0.5},
    {"hidden": (), "activation": "tanh", "lipschitz": 1.0},
    {"hidden": (24, 5, 12), "activation": "tanh", "lipschitz": 3.0, "lipschitz_norm": "frobenius"},
]
OWN: dict[str, list[Any]] = {
    "batch_size": [32, 50, 7, 64, 33],
    "learning_rate": [3e-3, 1e-3, 1e-2, 1e-4, 2e-3],
    "validation_share": [0.1, 0.2, 0.1, 0.3, 0.1],
    "seed": [0, 1, 2, 0, 9],
}


@pytest.fixture(scope="module")
def demos() -> Demos:
    """Actuations near a plane that turns with the context."""
    generator = torch.Generator().manual_seed(0)
    context = torch.randn(EPISODES * LENGTH, CONTEXT_DIM, generator=generator)
    plane = nht.NHT(CONTEXT_DIM, N, K, hidden=(8,), seed=11)
    with torch.no_grad():
        plane.network.linear(-1).weight.mul_(5)
        actuation = plane(3 * torch.randn(len(context), K, generator=generator), context)
    actuation = actuation + 0.2 * torch.randn(actuation.shape, generator=generator)
    episode = torch.arange(EPISODES).repeat_interleave(LENGTH)
    return Demos.from_tensors(actuation=actuation, episode=episode, context={"context": context})


def varied(kind: type[ActionMap] = nht.NHT, **more: Any) -> list[ActionMap]:
    """Untrained maps that differ in all that may differ."""
    return [
        kind(CONTEXT_DIM, N, K, **options, **more, seed=seed)  # type: ignore[call-arg]
        for seed, options in enumerate(VARIED)
    ]


def succeeded(found: list[MapTraining | FloatingPointError]) -> list[MapTraining]:
    for each in found:
        assert isinstance(each, MapTraining), each
    return found  # type: ignore[return-value]


def alone(demos: Demos, map: ActionMap, place: int, **options: Any) -> MapTraining:
    return train_map(demos, map, **{name: values[place] for name, values in OWN.items()}, **options)


def close(one: ActionMap, other: ActionMap, rtol: float = 1e-4) -> None:
    torch.testing.assert_close(one.state_dict(), other.state_dict(), rtol=rtol, atol=1e-5)


@pytest.mark.parametrize("kind", [nht.NHT, nht.SCL])
@pytest.mark.parametrize("offset", ["none", "constant", "contextual"])
@pytest.mark.parametrize("steps", [1, 2, 5, 10])
def test_the_first_steps_are_those_of_each_map_alone(
    demos: Demos, kind: type[ActionMap], offset: str, steps: int
) -> None:
    maps, twins = varied(kind, offset=offset), varied(kind, offset=offset)
    losses, expected = {}, {}
    train_maps(
        demos, maps, **OWN, max_steps=steps, progress=lambda place, told: losses.update({place: told["loss"]})
    )
    for place, twin in enumerate(twins):
        alone(
            demos,
            twin,
            place,
            max_steps=steps,
            progress=lambda told, place=place: expected.update({place: told["loss"]}),
        )
        close(maps[place], twin, rtol=1e-5)
    assert losses == pytest.approx(expected, rel=1e-5)


def test_whole_trainings_are_those_of_each_map_alone(demos: Demos) -> None:
    steps = {"max_steps": [400, 250, 300, 350, 260], "patience": [4000, 4000, 100, 250, 4000]}
    maps, twins = varied(), varied()
    found = succeeded(train_maps(demos, maps, **OWN, **steps))
    for place, twin in enumerate(twins):
        own = {name: values[place] for name, values in steps.items()}
        expected = alone(demos, twin, place, **own).metrics
        assert found[place].map is maps[place]
        assert not maps[place].training
        told = found[place].metrics
        assert list(told) == list(expected)
        assert told["seconds"] > 0
        for name in expected.keys() - {"seconds"}:
            assert told[name] == pytest.approx(expected[name], rel=1e-3), name
        assert maps[place].context_keys == twin.context_keys == ("context",)
        assert maps[place].data_fingerprint == twin.data_fingerprint
        assert torch.equal(maps[place].actuation_high, twin.actuation_high)


def test_who_trains_beside_a_map_makes_no_difference(demos: Demos) -> None:
    together, pair = varied(), varied()
    train_maps(demos, together, **OWN, max_steps=60)
    for place in (1, 4):
        numbers = {name: [values[place], values[0]] for name, values in OWN.items()}
        train_maps(demos, [pair[place], varied()[0]], **numbers, max_steps=[60, 30])
        close(together[place], pair[place])


def test_limits_hold(demos: Demos) -> None:
    train_maps(demos, maps := varied(offset="contextual"), **OWN, max_steps=300)
    for map in maps:
        assert isinstance(map, nht.NHT)
        if map.lipschitz is not None:
            assert nht.certificate(map) <= map.lipschitz
            assert nht.offset_certificate(map) <= map.lipschitz


def test_a_map_that_is_done_leaves_the_others_calls(demos: Demos, monkeypatch: pytest.MonkeyPatch) -> None:
    rows: list[list[int]] = []

    class Watched(NetworksTogether):
        def __init__(self, networks: Any, counts: list[int]) -> None:
            rows.append(counts)
            super().__init__(networks, counts)

    monkeypatch.setattr(steps_together, "NetworksTogether", Watched)
    maps = varied()[:3]
    found = succeeded(train_maps(demos, maps, batch_size=[3, 4, 5], max_steps=[20, 400, 300], patience=250))
    assert rows == [[3, 4, 5], [4, 5], *([[4]] if found[1].metrics["steps"] > 300 else [])]
    assert found[0].metrics["steps"] == 20


@pytest.mark.parametrize("lipschitz", [None, 2.0])
def test_a_map_that_diverges_is_reported_and_harms_none(demos: Demos, lipschitz: float | None) -> None:
    wild = nht.NHT(CONTEXT_DIM, N, K, hidden=(16,), lipschitz=lipschitz)
    maps, twins = [varied()[0], wild, varied()[1]], varied()
    found = train_maps(demos, maps, learning_rate=[1e-3, float("inf"), 1e-3], max_steps=[30, 20, 40])
    assert isinstance(found[1], FloatingPointError)
    assert "training diverged in the first 20 steps; lower learning_rate." in str(found[1])
    train_map(demos, twins[0], max_steps=30)
    train_map(demos, twins[1], max_steps=40)
    close(maps[0], twins[0])
    close(maps[2], twins[1])
    with pytest.raises(FloatingPointError, match="training diverged in the first 20 steps"):
        train_map(
            demos, nht.NHT(CONTEXT_DIM, N, K, lipschitz=lipschitz), learning_rate=float("inf"), max_steps=20
        )


@pytest.mark.parametrize("kind", [nht.SVD, nht.LASER, nht.CAE])
def test_kinds_that_share_no_calls_train_one_after_another(demos: Demos, kind: type[ActionMap]) -> None:
    def made() -> list[ActionMap]:
        if kind is nht.SVD:
            return [nht.SVD(N, K, CONTEXT_DIM) for _ in range(2)]
        options = {"beta_dynamics": 0.0} if kind is nht.LASER else {}
        return [kind(CONTEXT_DIM, N, K, hidden=(8,), seed=s, **options) for s in range(2)]  # type: ignore[call-arg]

    maps, twins, told = made(), made(), []
    train_maps(
        demos, maps, seed=[4, 5], max_steps=5, progress=lambda place, now: told.append((place, now["step"]))
    )
    for seed, twin in enumerate(twins, start=4):
        train_map(demos, twin, seed=seed, max_steps=5)
    for map, twin in zip(maps, twins, strict=True):
        assert all(torch.equal(value, twin.state_dict()[name]) for name, value in map.state_dict().items())
    assert told == ([] if kind is nht.SVD else [(0, 5), (1, 5)])


class Crooked(nht.NHT):
    """A user's own, with another loss."""

    def loss(self, batch: Any) -> Tensor:
        return 2 * super().loss(batch)


def test_maps_with_heads_train_beside_the_others(demos: Demos) -> None:
    def made() -> list[ActionMap]:
        return [nht.NHT(CONTEXT_DIM, N, K, hidden=(8,), multi_head=heads) for heads in (False, True, False)]

    maps, twins = made(), made()
    assert len(succeeded(train_maps(demos, maps, seed=[0, 1, 2], max_steps=20))) == 3
    for seed, (map, twin) in enumerate(zip(maps, twins, strict=True)):
        train_map(demos, twin, seed=seed, max_steps=20)
        close(map, twin)


def test_subclasses_and_heads_are_trained_as_they_are_alone(demos: Demos) -> None:
    for make in (
        lambda: Crooked(CONTEXT_DIM, N, K, hidden=(8,)),
        lambda: nht.NHT(CONTEXT_DIM, N, K, hidden=(8,), multi_head=True),
    ):
        map, twin = make(), make()
        train_maps(demos, [map], max_steps=20)
        train_map(demos, twin, max_steps=20)
        assert all(torch.equal(value, twin.state_dict()[name]) for name, value in map.state_dict().items())


def test_double_precision(demos: Demos) -> None:
    maps, twins = [map.double() for map in varied()], [map.double() for map in varied()]
    train_maps(demos, maps, **OWN, max_steps=30)
    for place, twin in enumerate(twins):
        alone(demos, twin, place, max_steps=30)
        torch.testing.assert_close(maps[place].state_dict(), twin.state_dict(), rtol=1e-9, atol=1e-12)


def test_no_maps_are_no_work(demos: Demos) -> None:
    assert train_maps(demos, []) == []


NETWORKS = st.lists(
    st.tuples(
        st.lists(st.integers(1, 9), max_size=3),
        st.sampled_from(["relu", "sigmoid", "tanh"]),
        st.integers(1, 6),
    ),
    min_size=1,
    max_size=5,
)


@settings(max_examples=40, deadline=None)
@given(NETWORKS)
def test_networks_together_give_what_each_gives_and_its_gradients(drawn: list[tuple[Any, Any, int]]) -> None:
    rows = [count for _, _, count in drawn]
    networks = [
        ContextNetwork(CONTEXT_DIM, 4, hidden, activation, seed).double()
        for seed, (hidden, activation, _) in enumerate(drawn)
    ]
    generator = torch.Generator().manual_seed(0)
    context = torch.randn(sum(rows), CONTEXT_DIM, generator=generator, dtype=torch.float64)
    pull = torch.randn(sum(rows), 4, generator=generator, dtype=torch.float64)
    for network in networks:
        network.normalise(context)
        for parameter in network.parameters():
            parameter.grad = torch.full_like(parameter, torch.nan)  # to be overwritten
    together = NetworksTogether(networks, rows)
    for _ in range(2):  # memory is used again
        output = together.forward(context)
        together.backward(pull)
    shares = zip(networks, context.split(rows), pull.split(rows), output.split(rows), strict=True)
    for network, own, pulled, found in shares:
        expected = network(own)
        torch.testing.assert_close(found, expected.detach())
        gradients = torch.autograd.grad(expected, list(network.parameters()), pulled)
        torch.testing.assert_close([parameter.grad for parameter in network.parameters()], list(gradients))


@settings(max_examples=20, deadline=None)
@given(st.lists(st.sampled_from(VARIED[1:]), min_size=1, max_size=4), st.integers(0, 1000))
def test_limits_together_are_those_of_each(options: list[dict[str, Any]], seed: int) -> None:
    generator = torch.Generator().manual_seed(seed)
    maps = [nht.NHT(CONTEXT_DIM, N, K, **given, offset="contextual") for given in options]
    twins = [nht.NHT(CONTEXT_DIM, N, K, **given, offset="contextual") for given in options]
    for map, twin in zip(maps, twins, strict=True):
        map.network.context_std.uniform_(0.1, 2, generator=generator)
        twin.network.context_std.copy_(map.network.context_std)
    expected = [LipschitzProjection(twin) for twin in twins]
    own = [LipschitzProjection(map) for map in maps]
    together = LimitsTogether(own)
    for step in range(4):
        for map, twin in zip(maps, twins, strict=True):
            for parameter, same in zip(map.parameters(), twin.parameters(), strict=True):
                move = torch.randn(parameter.shape, generator=generator)
                parameter.data += move
                same.data += move
        together.step()
        for limit in expected:
            limit.step()
        for map, twin in zip(maps, twins, strict=True):
            torch.testing.assert_close(map.state_dict(), twin.state_dict())
        if step == 1:
            for limit in (*own, *expected):
                limit.exact()
            together.follow()


@settings(max_examples=30, deadline=None)
@given(st.floats(1e-6, 1.0), st.integers(1, 300))
def test_the_learning_rates_are_those_of_the_schedule(rate: float, steps: int) -> None:
    optimiser = torch.optim.SGD([torch.zeros(1)], lr=rate)
    schedule = torch.optim.lr_scheduler.CosineAnnealingLR(optimiser, steps)
    for found in cosine(rate, steps):
        assert found == optimiser.param_groups[0]["lr"]
        optimiser.step()
        schedule.step()


@pytest.mark.parametrize(
    ("other", "message"),
    [
        (lambda: nht.SCL(CONTEXT_DIM, N, K), "are of one kind: map 0 is NHT, map 1 is SCL"),
        (lambda: nht.NHT(4, N, K), "share context_dim: map 0 has 3, map 1 has 4"),
        (lambda: nht.NHT(CONTEXT_DIM, N, 3), "share action_dim: map 0 has 2, map 1 has 3"),
        (lambda: nht.NHT(CONTEXT_DIM, 7, K), "share actuation_dim: map 0 has 6, map 1 has 7"),
        (
            lambda: nht.NHT(CONTEXT_DIM, N, K, offset="constant"),
            "share offset: map 0 has none, map 1 has const",
        ),
        (lambda: nht.NHT(CONTEXT_DIM, N, K).double(), "share precision: map 0 has torch.float32, map 1 has"),
    ],
)
def test_maps_that_differ_in_what_they_share(demos: Demos, other: Any, message: str) -> None:
    first = nht.NHT(CONTEXT_DIM, N, K)
    before = {name: value.clone() for name, value in first.state_dict().items()}
    with pytest.raises(ValueError, match=message):
        train_maps(demos, [first, other()], max_steps=1)
    assert all(torch.equal(value, before[name]) for name, value in first.state_dict().items())


def test_maps_of_other_observations(demos: Demos) -> None:
    maps = varied()[:2]
    maps[1].context_keys = ("elbow",)
    with pytest.raises(ValueError, match=r"share context_keys: map 0 has None, map 1 has \('elbow',\)"):
        train_maps(demos, maps, max_steps=1)
    train_maps(demos, maps, context_keys=["context"], max_steps=1)  # as told
    assert maps[1].context_keys == ("context",)


def test_one_map_twice(demos: Demos) -> None:
    first, twice = nht.NHT(CONTEXT_DIM, N, K), nht.NHT(CONTEXT_DIM, N, K)
    with pytest.raises(ValueError, match="map 2 is map 1 once more"):
        train_maps(demos, [first, twice, twice], max_steps=1)


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"batch_size": [8, 0]}, "map 1: batch_size must be at least 1, got 0"),
        ({"learning_rate": [-1.0, 1e-3]}, "map 0: learning_rate must be positive, got -1"),
        ({"max_steps": [1, -3]}, "map 1: max_steps must be at least 1, got -3"),
        ({"validation_share": [0.1, 1.5]}, "map 1: validation_share must be between 0 and 1, got 1.5"),
        ({"seed": [1, 2, 3]}, "seed must be one number, or one for each of 2 maps, got 3"),
    ],
)
def test_numbers_that_a_map_cannot_have(demos: Demos, options: dict[str, Any], message: str) -> None:
    with pytest.raises(ValueError, match=message):
        train_maps(demos, varied()[:2], **options)
