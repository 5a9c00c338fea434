"""Latent action models: their losses are those of Eq. 3, and training finds a manifold that is not flat."""

import copy
import pickle
from pathlib import Path
from typing import Any

import pytest
import torch
from tensordict import TensorDict
from torch import Tensor
from torch.distributions import Normal, kl_divergence

import nht
from nht.demos import Demos
from nht.train import MapTraining, train_map

CONTEXT_DIM, N, K, EPISODES, LENGTH = 3, 5, 2, 20, 50
AUTOENCODERS = [nht.CAE, nht.LASER]


def normal(*shape: int, seed: int = 0) -> Tensor:
    return torch.randn(*shape, generator=torch.Generator().manual_seed(seed), dtype=torch.float64)


def batch(count: int = 16) -> TensorDict:
    context = normal(count, CONTEXT_DIM)
    entries = {"context": context, "actuation": normal(count, N, seed=1)}
    following = {"context": context + 0.1 * normal(count, CONTEXT_DIM, seed=2)}
    return TensorDict(entries | {"next": following}, batch_size=count)


def small(**options: Any) -> nht.LASER:
    return nht.LASER(CONTEXT_DIM, N, K, hidden=(16,), **options).double()


@pytest.fixture(scope="module")
def demos() -> Demos:
    """Actuations on a curved surface; the first half of each step's motion goes into the context."""
    latent = normal(EPISODES * LENGTH, K, seed=3).float().clamp(-2, 2)
    frame = nht.NHT(1, N, 4, hidden=(4,), seed=5)(torch.eye(4), torch.ones(4, 1)).detach()
    curved = torch.cat([latent, latent.square() / 2], dim=1) @ frame
    context = 0.5 * normal(EPISODES * LENGTH, CONTEXT_DIM, seed=4).float()
    episode = torch.arange(EPISODES).repeat_interleave(LENGTH)
    following = context + 0.1 * torch.cat([latent, latent[:, :1] * latent[:, 1:]], dim=1)
    return Demos.from_tensors(
        actuation=curved, episode=episode, context={"pose": context}, next_context={"pose": following}
    )


def fit(demos: Demos, map: nht.ActionMap, max_steps: int = 1500, **options: Any) -> MapTraining:
    return train_map(
        demos, map, context_keys=["pose"], max_steps=max_steps, learning_rate=3e-3, batch_size=128, **options
    )


@pytest.mark.parametrize("kind", AUTOENCODERS)
def test_shapes_and_single_transitions(kind: type[nht.CAE]) -> None:
    map = kind(CONTEXT_DIM, N, K, hidden=(16,)).double()
    action, context = normal(4, 6, K), normal(4, 6, CONTEXT_DIM)
    actuation = map(action, context)
    assert actuation.shape == (4, 6, N)
    assert map.project(actuation, context).shape == (4, 6, K)
    assert torch.allclose(map(action[0, 0], context[0, 0]), actuation[0, 0])
    assert nht.certificate(map) == torch.inf


@pytest.mark.parametrize("kind", AUTOENCODERS)
def test_encoder_and_decoder_see_the_context(kind: type[nht.CAE]) -> None:
    map = kind(CONTEXT_DIM, N, K).double()
    action, actuation = normal(1, K), normal(1, N)
    context, other = normal(1, CONTEXT_DIM), normal(1, CONTEXT_DIM, seed=1)
    assert not torch.allclose(map(action, context), map(action, other))
    assert not torch.allclose(map.project(actuation, context), map.project(actuation, other))


def test_the_loss_of_a_conditional_autoencoder_is_its_reconstruction_error() -> None:
    map, data = nht.CAE(CONTEXT_DIM, N, K).double(), batch()
    rebuilt = map.decoder(data["context"], map.encoder(data["context"], data["actuation"]))
    assert torch.allclose(map.loss(data), (data["actuation"] - rebuilt).square().sum(-1).mean())


def test_the_loss_of_laser_is_eq_3() -> None:
    map, data = small(beta_kl=0.3, beta_dynamics=0.7, seed=9), batch()
    map.fit(data)
    context = data["context"]
    mean, log_variance = map.encoder(context, data["actuation"]).chunk(2, dim=-1)
    noise = normal(16, K, seed=9)
    action = mean + (0.5 * log_variance).exp() * noise
    prior = Normal(torch.zeros_like(mean), torch.ones_like(mean))
    divergence = kl_divergence(Normal(mean, (0.5 * log_variance).exp()), prior).sum(-1).mean()
    change = data["next", "context"] - context
    unexplained = (context + change - map.next_context(action, context)).square().sum(-1).mean()
    expected = (
        (data["actuation"] - map(action, context)).square().sum(-1).mean()
        + 0.3 * divergence
        + 0.7 * unexplained / change.square().sum(-1).mean()
    )
    assert torch.allclose(map.loss(data), expected)


def test_the_dynamics_term_is_in_units_of_the_normalised_context() -> None:
    """Rescaling an entry of the context changes nothing but the units of what is predicted."""
    data, scaled = batch(), batch()
    units = torch.tensor([1.0, 0.5, 3.0], dtype=torch.float64)
    scaled["context"] *= units
    scaled["next", "context"] *= units
    losses = []
    for each in (data, scaled):
        map = small(normalise=True, beta_dynamics=0.5)
        map.fit(each)
        losses.append(map.loss(each))
    assert torch.allclose(losses[0], losses[1])


def test_gradients_flow_through_the_noise() -> None:
    """Finite differences of the loss, the noise held fixed, in every network."""
    map, data = nht.LASER(CONTEXT_DIM, N, K, hidden=(4,), beta_kl=0.1, beta_dynamics=0.1).double(), batch(3)
    parameters = dict(map.named_parameters())

    def loss(*values: Tensor) -> Tensor:
        map.noise.manual_seed(1)
        overridden = {f"inner.{name}": value for name, value in zip(parameters, values, strict=True)}
        return torch.func.functional_call(Loss(map), overridden, (data,))

    assert torch.autograd.gradcheck(loss, tuple(parameters.values()))


class Loss(torch.nn.Module):
    def __init__(self, inner: nht.ActionMap) -> None:
        super().__init__()
        self.inner = inner

    def forward(self, data: TensorDict) -> Tensor:
        return self.inner.loss(data)


def test_the_noise_is_the_maps_own_and_its_seed_acts() -> None:
    data = batch()
    torch.manual_seed(1)
    before = torch.random.get_rng_state()
    map = small(seed=3)
    twin = copy.deepcopy(map)
    first, second = map.loss(data), map.loss(data)
    assert first != second  # drawn anew
    torch.manual_seed(2)
    assert (twin.loss(data), twin.loss(data)) == (first, second)
    other = small(seed=4)
    other.load_state_dict(map.state_dict())
    assert other.loss(data) != first
    torch.manual_seed(1)
    assert torch.equal(torch.random.get_rng_state(), before)


def test_the_seeds_of_the_networks_differ() -> None:
    map = nht.LASER(N, N, N, hidden=(16, 16))
    hidden = [network.linear(1).weight for network in (map.encoder, map.decoder, map.dynamics)]
    assert not any(torch.equal(hidden[i], hidden[j]) for i, j in ((0, 1), (0, 2), (1, 2)))


def test_extreme_latents_have_a_finite_loss() -> None:
    map, data = small(), batch()
    for bias in (-1e4, 1e4):
        with torch.no_grad():
            map.encoder.linear(-1).bias[K:] = bias
        assert map.loss(data).isfinite()


@pytest.mark.parametrize("kind", AUTOENCODERS)
def test_a_curved_surface_is_found_which_no_basis_spans(demos: Demos, kind: type[nht.CAE]) -> None:
    options: dict[str, Any] = {} if kind is nht.CAE else {"beta_kl": 1e-5, "beta_dynamics": 1e-3}
    trained = fit(demos, kind(CONTEXT_DIM, N, K, hidden=(32, 32), **options)).metrics["validation_error"]
    flat = fit(demos, nht.SVD(N, K, CONTEXT_DIM)).metrics["validation_error"]
    assert trained < 0.25 * flat


@pytest.fixture(scope="module")
def weighed(demos: Demos) -> dict[float, MapTraining]:
    """LASER by the weight of its KL term."""
    return {
        beta: fit(demos, nht.LASER(CONTEXT_DIM, N, K, (32,), beta_kl=beta, beta_dynamics=0.1, normalise=True))
        for beta in (1e-6, 0.3)
    }


@torch.no_grad()
def test_the_kl_weight_draws_latents_towards_unit_scale(
    demos: Demos, weighed: dict[float, MapTraining]
) -> None:
    gaps = []
    for training in weighed.values():
        assert isinstance(training.map, nht.LASER)
        mean, log_variance = training.map.latent(demos.actuation, demos.context(["pose"]))
        second_moment = (mean.square() + log_variance.exp()).mean(0)
        gaps.append(float((second_moment - 1).abs().max()))
    assert gaps[1] < 0.3
    assert gaps[1] < gaps[0]


def test_latents_predict_the_next_context(demos: Demos, weighed: dict[float, MapTraining]) -> None:
    map = weighed[1e-6].map
    assert isinstance(map, nht.LASER)
    context, following = demos.context(["pose"]), demos.context([("next", "pose")])
    predicted = map.next_context(map.project(demos.actuation, context), context)
    missed = (following - predicted).square().sum() / (following - context).square().sum()
    assert float(missed) < 0.3


def test_training_repeats_itself(demos: Demos) -> None:
    runs = [fit(demos, nht.LASER(CONTEXT_DIM, N, K, (16,)), max_steps=50).map for _ in range(2)]
    for name, value in runs[0].state_dict().items():
        assert torch.equal(value, runs[1].state_dict()[name])


def test_action_scale_is_the_largest_mean(demos: Demos, weighed: dict[float, MapTraining]) -> None:
    map = weighed[0.3].map
    assert torch.equal(map.action_scale, map.project(demos.actuation, demos.context(["pose"])).abs().max())


@pytest.mark.parametrize("kind", AUTOENCODERS)
def test_maps_pickle_save_and_load(kind: type[nht.CAE], tmp_path: Path) -> None:
    map = kind(CONTEXT_DIM, N, K, (16, 8), "relu", normalise=True, seed=3)
    map.fit(batch().float())
    action, context = torch.ones(2, K), torch.ones(2, CONTEXT_DIM)
    loaded = nht.load_map(nht.save_map(map, tmp_path / "map.safetensors"))
    for other in (loaded, pickle.loads(pickle.dumps(map))):
        assert type(other) is kind
        assert other.init_args() == map.init_args()
        assert torch.equal(other(action, context), map(action, context))


@pytest.mark.slow
@pytest.mark.parametrize("kind", AUTOENCODERS)
def test_maps_compile_into_one_graph(kind: type[nht.CAE]) -> None:
    map = kind(CONTEXT_DIM, N, K, hidden=(16,)).double()
    action, context = normal(8, K), normal(8, CONTEXT_DIM)
    actuation = torch.compile(map, fullgraph=True)(action, context)
    assert torch.allclose(actuation, map(action, context))


# Bad input.


def test_demonstrations_without_next_context(demos: Demos) -> None:
    poor = Demos.from_tensors(
        actuation=demos.actuation, episode=demos.episode, context={"pose": demos.context(["pose"])}
    )
    message = r"LASER learns from the next context too, but the demonstrations lack \('next', 'pose'\)"
    with pytest.raises(KeyError, match=message):
        fit(poor, nht.LASER(CONTEXT_DIM, N, K))
    fit(poor, nht.LASER(CONTEXT_DIM, N, K, beta_dynamics=0), max_steps=2)
    fit(poor, nht.CAE(CONTEXT_DIM, N, K), max_steps=2)


def test_a_laser_without_dynamics_predicts_nothing() -> None:
    map = small(beta_dynamics=0)
    assert not map.needs_next_context
    with pytest.raises(ValueError, match="beta_dynamics=0, and so no latent dynamics"):
        map.next_context(normal(1, K), normal(1, CONTEXT_DIM))


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda: nht.LASER(4, 7, 8), "action_dim must be in 1 ... actuation_dim=7, got 8"),
        (lambda: nht.CAE(4, 7, 8), "action_dim must be in 1 ... actuation_dim=7, got 8"),
        (lambda: nht.LASER(4, 7, 2, beta_kl=-0.1), r"beta_kl must be a number of 0 or more, got -0\.1"),
        (lambda: nht.LASER(4, 7, 2, beta_dynamics=-1.0), r"beta_dynamics must be .* 0 or more, got -1\.0"),
        (lambda: nht.LASER(4, 7, 2, beta_kl=float("nan")), "beta_kl must be a number of 0 or more, got nan"),
        (lambda: nht.CAE(0, 7, 2), "widths must be at least 1, got context_dim=0"),
        (lambda: nht.CAE(4, 7, 2, activation="gelu"), "one of relu, sigmoid, tanh, got 'gelu'"),
    ],
)
def test_bad_arguments_are_named(make: Any, message: str) -> None:
    with pytest.raises(ValueError, match=message):
        make()
