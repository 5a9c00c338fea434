"""Training recovers what is there to find, repeats itself, and refuses what it cannot learn from."""

from typing import Any

import pytest
import torch
from torch import Tensor

import nht
from nht import train
from nht.demos import Demos
from nht.maps import ActionMap, LinearActionMap
from nht.networks import ContextNetwork
from nht.train import projection_error, train_map
from nht.training_data import split_episodes

N, K, CONTEXT_DIM, EPISODES, LENGTH = 6, 2, 3, 40, 50


class FreeBasis(LinearActionMap):
    """A class of a user's own, with the default loss."""

    def __init__(self, context_dim: int, actuation_dim: int, action_dim: int) -> None:
        super().__init__(context_dim, actuation_dim, action_dim)
        self.network = ContextNetwork(context_dim, actuation_dim * action_dim, (32,), "tanh", seed=0)

    def basis(self, context: Tensor) -> Tensor:
        assert self.network is not None
        return self.network(context).unflatten(-1, (self.actuation_dim, self.action_dim))


@pytest.fixture(scope="module")
def demos() -> Demos:
    """Actuations on a plane that turns with the context, which drifts within an episode."""
    generator = torch.Generator().manual_seed(0)
    start = torch.randn(EPISODES, 1, CONTEXT_DIM, generator=generator)
    context = (
        start + 0.05 * torch.randn(EPISODES, LENGTH, CONTEXT_DIM, generator=generator).cumsum(1)
    ).flatten(0, 1)
    plane = nht.NHT(CONTEXT_DIM, N, K, hidden=(8,), seed=11)
    with torch.no_grad():
        plane.network.linear(-1).weight.mul_(5)
        actuation = plane(3 * torch.randn(len(context), K, generator=generator), context)
    episode = torch.arange(EPISODES).repeat_interleave(LENGTH)
    return Demos.from_tensors(
        actuation=actuation, episode=episode, context={"pose": context, "other": context[:, :1]}
    )


def small(**options: Any) -> nht.NHT:
    return nht.NHT(CONTEXT_DIM, N, K, hidden=(32,), **options)


def fit(demos: Demos, map: ActionMap, **options: Any) -> train.MapTraining:
    return train_map(demos, map, **({"context_keys": ["pose"], "max_steps": 500} | options))


@pytest.fixture(scope="module")
def trained(demos: Demos) -> train.MapTraining:
    return fit(demos, small(seed=2), max_steps=2500, learning_rate=5e-3)


def test_a_plane_that_turns_with_the_context_is_recovered(demos: Demos, trained: train.MapTraining) -> None:
    assert trained.metrics["validation_error"] < 2e-3
    assert trained.metrics["training_error"] < 1e-3
    without_context = fit(demos, nht.SVD(N, K, CONTEXT_DIM)).metrics["validation_error"]
    assert without_context > 50 * trained.metrics["validation_error"]


def test_the_map_learns_what_its_users_need_to_know(demos: Demos, trained: train.MapTraining) -> None:
    map, metrics = trained
    context = demos.context(["pose"])
    assert map.context_keys == ("pose",)
    assert map.data_fingerprint == demos.fingerprint
    assert torch.equal(map.action_scale, map.project(demos.actuation, context).abs().max())
    assert torch.equal(map.actuation_low, demos.actuation.amin(0))
    assert torch.equal(map.actuation_high, demos.actuation.amax(0))
    assert not map.training
    assert metrics["action_scale"] == float(map.action_scale)
    assert metrics["certificate"] == nht.certificate(map)
    assert (metrics["transitions"], metrics["training_episodes"], metrics["validation_episodes"]) == (
        2000,
        36,
        4,
    )
    assert metrics["seconds"] > 0


def test_the_reported_errors_are_those_of_the_split(demos: Demos, trained: train.MapTraining) -> None:
    held_out = split_episodes(demos.episode, 0.1, seed=0)
    context = demos.context(["pose"])
    for rows, name in ((held_out, "validation_error"), (~held_out, "training_error")):
        basis = trained.map.basis(context[rows]).detach()
        u = demos.actuation[rows].unsqueeze(-1)
        missed = (u - basis @ (basis.mT @ u)).square().sum() / u.square().sum()
        assert float(missed) == pytest.approx(trained.metrics[name], rel=1e-3)


def test_errors_do_not_depend_on_the_chunks(demos: Demos, monkeypatch: pytest.MonkeyPatch) -> None:
    whole = projection_error(small(), demos.context(["pose"]), demos.actuation)
    monkeypatch.setattr(train, "CHUNK", 300)
    assert projection_error(small(), demos.context(["pose"]), demos.actuation) == pytest.approx(
        whole, rel=1e-6
    )


@pytest.mark.parametrize("map", [nht.SVD(N, K, CONTEXT_DIM), nht.SVD(N, K), nht.Identity(N, CONTEXT_DIM)])
def test_closed_forms_take_no_steps(demos: Demos, map: ActionMap) -> None:
    keys = ["pose"] if map.context_dim else None
    metrics = train_map(demos, map, context_keys=keys).metrics
    assert (metrics["steps"], metrics["best_step"], metrics["certificate"]) == (0, 0, 0)
    assert map.context_keys == tuple(keys or ())
    assert (metrics["validation_error"] == 0) == isinstance(map, nht.Identity)
    assert metrics["action_scale"] > 1


def test_maps_of_ones_own_are_trained_through_the_default_loss(demos: Demos) -> None:
    rows: list[dict[str, float]] = []
    fit(demos, FreeBasis(CONTEXT_DIM, N, K), progress=rows.append)
    assert [row["step"] for row in rows] == [250, 500]
    assert rows[-1]["validation_error"] < 0.8 * rows[0]["validation_error"]


def test_double_precision_maps_train_on_single_precision_data(demos: Demos) -> None:
    map, metrics = fit(demos, small().double(), max_steps=250)
    assert map.action_scale.dtype == torch.float64
    assert 0 < metrics["validation_error"] < 1


def test_the_best_weights_are_kept_and_patience_ends_training(demos: Demos) -> None:
    rows: list[dict[str, float]] = []
    metrics = fit(
        demos,
        small(start="random"),
        learning_rate=0.5,
        max_steps=20_000,
        patience=500,
        progress=rows.append,
    ).metrics
    errors = {row["step"]: row["validation_error"] for row in rows}
    assert metrics["validation_error"] == min(errors.values()) == errors[int(metrics["best_step"])]
    assert metrics["steps"] == max(errors) == metrics["best_step"] + 500 < 20_000


@pytest.mark.parametrize("kind", ["spectral", "frobenius"])
def test_training_keeps_to_the_lipschitz_limit(demos: Demos, kind: Any) -> None:
    free = nht.certificate(fit(demos, small()).map)
    limited = fit(demos, small(lipschitz=0.5, lipschitz_norm=kind, normalise=True)).map
    assert nht.certificate(limited) <= 0.5 < free


def test_the_normaliser_sees_the_training_episodes_alone(demos: Demos) -> None:
    map = fit(demos, small(normalise=True), max_steps=1).map
    assert isinstance(map, nht.NHT)
    training = demos.context(["pose"])[~split_episodes(demos.episode, 0.1, seed=0)]
    assert torch.allclose(map.network.context_mean, training.mean(0))


def weights(demos: Demos, map_seed: int = 0, **options: Any) -> Tensor:
    return torch.cat(
        [value.flatten() for value in fit(demos, small(seed=map_seed), **options).map.parameters()]
    )


def test_the_same_seeds_give_the_same_run_whatever_the_global_state(demos: Demos) -> None:
    torch.manual_seed(1)
    first = weights(demos)
    torch.manual_seed(2)
    before = torch.random.get_rng_state()
    assert torch.equal(weights(demos), first)
    assert torch.equal(torch.random.get_rng_state(), before)


def test_each_seed_acts(demos: Demos) -> None:
    first = weights(demos, max_steps=50)
    assert not torch.equal(weights(demos, max_steps=50, map_seed=1), first)
    assert not torch.equal(weights(demos, max_steps=50, seed=1), first)
    splits = [split_episodes(demos.episode, 0.1, seed) for seed in range(5)]
    assert len({tuple(split.tolist()) for split in splits}) > 1


@pytest.mark.parametrize(("share", "expected"), [(0.001, 1), (0.1, 4), (0.5, 20), (0.999, 39)])
def test_whole_episodes_are_held_out(demos: Demos, share: float, expected: int) -> None:
    held_out = split_episodes(demos.episode, share, seed=3)
    out, kept = set(demos.episode[held_out].tolist()), set(demos.episode[~held_out].tolist())
    assert len(out) == expected
    assert out | kept == set(range(EPISODES))
    assert not out & kept


def test_the_context_key_may_be_left_out_where_it_is_clear(demos: Demos) -> None:
    plain = Demos.from_tensors(
        actuation=demos.actuation, episode=demos.episode, context=demos.context(["pose"])
    )
    map = train_map(plain, small(), max_steps=1).map
    assert map.context_keys == ("context",)
    assert train_map(plain, map, max_steps=1).map.context_keys == ("context",)
    with pytest.raises(
        ValueError, match="context_keys must name some of the demonstrations' keys: actuation, "
    ):
        train_map(demos, small())


def test_a_context_that_is_not_there_or_too_wide_is_named(demos: Demos) -> None:
    with pytest.raises(KeyError, match=r"'elbow' is not in the demonstrations, which have .*'pose'"):
        fit(demos, small(), context_keys=["elbow"])
    with pytest.raises(ValueError, match="context has width 3, the keys give 4: 'pose': 3, 'other': 1"):
        fit(demos, small(), context_keys=["pose", "other"])


def test_demonstrations_must_fit_the_map(demos: Demos) -> None:
    with pytest.raises(ValueError, match="demonstrated actuations have 6 dimensions, the map's 7"):
        fit(demos, nht.NHT(CONTEXT_DIM, 7, 2))


def flat(demos: Demos, rank: int) -> Demos:
    """The same demonstrations with all but the first actuations left at zero, up to rounding."""
    actuation = torch.cat([demos.actuation[:, :rank], 1e-7 * demos.actuation[:, rank:]], dim=1)
    return Demos.from_tensors(
        actuation=actuation, episode=demos.episode, context={"pose": demos.context(["pose"])}
    )


def test_fewer_independent_actuations_than_k_are_refused(demos: Demos) -> None:
    with pytest.raises(ValueError, match="have 1 independent actuations, too few for k = 2"):
        fit(flat(demos, 1), small())
    with pytest.raises(ValueError, match="have 1 independent actuations, too few for k = 2"):
        fit(flat(demos, 1), nht.SVD(N, K, CONTEXT_DIM))
    assert fit(flat(demos, 2), nht.SVD(N, K, CONTEXT_DIM)).metrics["validation_error"] < 1e-9
    assert fit(flat(demos, 1), nht.Identity(N, CONTEXT_DIM)).metrics["validation_error"] == 0


def test_of_a_single_episode_the_end_is_held_out(demos: Demos) -> None:
    alone = torch.full((1000,), 7)
    assert split_episodes(alone, 0.1, seed=0).nonzero().flatten().tolist() == list(range(900, 1000))
    assert split_episodes(alone[:2], 0.1, seed=0).tolist() == [False, True]
    one = Demos.from_tensors(
        actuation=demos.actuation,
        episode=torch.zeros_like(demos.episode),
        context={"pose": demos.context(["pose"])},
    )
    metrics = fit(one, nht.SVD(N, K, CONTEXT_DIM)).metrics
    assert metrics["training_episodes"] == metrics["validation_episodes"] == 1
    with pytest.raises(
        ValueError, match="at least 2 transitions are needed, to hold one out, but there is 1"
    ):
        split_episodes(alone[:1], 0.1, seed=0)


def test_actuations_of_zero_have_no_relative_error() -> None:
    with pytest.raises(ValueError, match="these are all zero"):
        projection_error(nht.SVD(N, K), torch.zeros(5, 0), torch.zeros(5, N))


def test_divergence_is_reported(demos: Demos) -> None:
    with pytest.raises(FloatingPointError, match="diverged in the first 250 steps; lower learning_rate"):
        fit(demos, small(), learning_rate=float("inf"))


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"batch_size": 0}, "batch_size must be at least 1, got 0"),
        ({"max_steps": 0}, "max_steps must be at least 1, got 0"),
        ({"patience": -1}, "patience must be at least 1, got -1"),
        ({"learning_rate": 0.0}, r"learning_rate must be positive, got 0\.0"),
        ({"learning_rate": float("nan")}, "learning_rate must be positive, got nan"),
        ({"validation_share": 1.0}, r"validation_share must be between 0 and 1, got 1\.0"),
        ({"validation_share": 0.0}, r"validation_share must be between 0 and 1, got 0\.0"),
    ],
)
def test_numbers_out_of_range_are_named(demos: Demos, options: dict[str, Any], message: str) -> None:
    with pytest.raises(ValueError, match=message):
        fit(demos, small(), **options)
