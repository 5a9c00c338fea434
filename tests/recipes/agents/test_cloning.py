"""Behaviour cloning beside an actor's loss: its value by hand, how it fades, and where the critic filters it."""

from __future__ import annotations

from typing import Any

import pytest
import torch
from tensordict import TensorDict
from torch import Tensor

from nht.envs import make_env
from nht.recipes.agents import ddpg, td3
from nht.recipes.agents.cloning import ClonedDemosConfig, Cloning, cloning_of
from nht.recipes.agents.ddpg import DDPGConfig, PaperDDPGLoss
from nht.recipes.agents.stacking import stacked
from nht.recipes.agents.td3 import DirectTD3Loss, TD3Config
from nht.recipes.launch import configure

SIZE, SHOWN = 12, 5


def batch(*learners: int) -> Any:
    """Steps of hopper, the last of which are demonstrated."""
    rows = [*learners, SIZE]
    counts = torch.zeros(rows)
    counts[..., -SHOWN:] = SIZE / SHOWN
    told = {
        "features": torch.randn(*rows, 11),
        "action": torch.rand(*rows, 3) * 2 - 1,
        "demonstrated": counts,
    }
    return TensorDict(told, rows)


def by_hand(steps: Any, actor: Any, critic: Any, weight: float, q_filter: bool) -> Tensor:
    total = torch.zeros(())
    for step in range(SIZE - SHOWN, SIZE):
        features, shown = steps["features"][step], steps["action"][step]
        own = actor(features)
        passes = not q_filter or bool(critic(features, shown) > critic(features, own))
        total = total + passes * (own - shown).square().sum()
    return weight * total / SHOWN


def made(module: Any, loss: Any, algo: Any, cloning: Cloning | None, count: int = 1) -> tuple[Any, list[Any]]:
    """A loss, and the actor and critic that it was made of; of several learners, those of each."""
    env = make_env("hopper", 1, seed=0)
    networks = [module.networks(env, algo)[1:] for _ in range(count)]
    pair = networks[0] if count == 1 else tuple(stacked(kind) for kind in zip(*networks, strict=True))
    more = {"action_l2": 0.0} if loss is PaperDDPGLoss else {}
    return loss(*pair, gamma=0.9, cloning=cloning, **more), networks


LOSSES = [(ddpg, PaperDDPGLoss, DDPGConfig), (td3, DirectTD3Loss, TD3Config)]


def actor_loss(loss: Any, steps: Any) -> Tensor:
    name = "loss_actor" if isinstance(loss, PaperDDPGLoss) else "actor_loss"
    found: Tensor = getattr(loss, name)(steps)[0]
    return found


@pytest.mark.parametrize("q_filter", [False, True])
@pytest.mark.parametrize(("module", "kind", "algo"), LOSSES)
def test_the_term_is_what_one_computes_by_hand(module: Any, kind: Any, algo: Any, q_filter: bool) -> None:
    loss, _ = made(module, kind, algo(hidden=[16]), Cloning(0.7, None, q_filter))
    steps = batch()
    with torch.no_grad():
        whole = actor_loss(loss, steps)
        term = loss._cloning
        loss.__dict__["_cloning"] = None
        plain = actor_loss(loss, steps)
        if kind is PaperDDPGLoss:
            actor, critic = loss._networks[:2]
        else:
            actor = loss._actors[0]
            pair = loss._critics

            def critic(features: Tensor, action: Tensor) -> Tensor:
                return pair.fixed(features.unsqueeze(0), action.unsqueeze(0), critics=1).squeeze()

        expected = by_hand(steps, actor, critic, 0.7, q_filter)
    assert term is not None
    torch.testing.assert_close(whole - plain, expected, rtol=1e-4, atol=1e-5)
    assert expected > 0 or q_filter


def test_the_filter_passes_some_and_stops_some() -> None:
    steps, action = batch(), torch.zeros(SIZE, 3)
    value = torch.zeros(SIZE)
    errors = steps["action"].square().sum(-1)[-SHOWN:]
    better = torch.tensor([1.0, -1.0, 1.0, -1.0, 0.0])
    worth = torch.cat([torch.ones(SIZE - SHOWN), better])
    found = Cloning(2.0, None, True).loss(steps, action, value, lambda _: worth)
    torch.testing.assert_close(found, 2.0 * (errors[0] + errors[2]) / SHOWN)


def test_what_passes_the_filter_is_learned_and_nothing_else() -> None:
    steps, action = batch(), torch.zeros(SIZE, 3, requires_grad=True)
    better = torch.tensor([1.0, -1.0, 1.0, -1.0, 0.0])
    worth = torch.cat([torch.ones(SIZE - SHOWN), better])
    Cloning(2.0, None, True).loss(steps, action, torch.zeros(SIZE), lambda _: worth).backward()
    expected = -4.0 * steps["action"] / SHOWN
    expected[torch.cat([torch.zeros(SIZE - SHOWN), better]) <= 0] = 0.0
    assert action.grad is not None
    torch.testing.assert_close(action.grad, expected)


@pytest.mark.parametrize("q_filter", [False, True])
def test_of_several_learners_it_is_that_of_each(q_filter: bool) -> None:
    algo = DDPGConfig(hidden=[16])
    loss, networks = made(ddpg, PaperDDPGLoss, algo, Cloning(0.7, None, q_filter), count=3)
    steps = batch(3)
    found = actor_loss(loss, steps)
    found.sum().backward()
    for learner, pair in enumerate(networks):
        alone = PaperDDPGLoss(*pair, gamma=0.9, action_l2=0.0, cloning=Cloning(0.7, None, q_filter))
        torch.testing.assert_close(found[learner], actor_loss(alone, steps[learner]))


@pytest.mark.parametrize(("module", "kind", "algo"), LOSSES)
def test_the_actor_comes_to_do_what_was_demonstrated(module: Any, kind: Any, algo: Any) -> None:
    loss, _ = made(module, kind, algo(hidden=[32]), Cloning(100.0, None, False))
    steps = batch()
    weights = list(loss.actor_network_params.values(True, True))
    optimiser = torch.optim.Adam(weights, lr=0.01)
    actor = (loss._networks if kind is PaperDDPGLoss else loss._actors)[0]

    @torch.no_grad()
    def distance() -> float:
        return float((actor(steps["features"]) - steps["action"])[-SHOWN:].square().mean())

    before = distance()
    for _ in range(200):
        optimiser.zero_grad()
        actor_loss(loss, steps).backward()
        optimiser.step()
    assert distance() < 0.05 * before


def test_it_fades_to_nothing() -> None:
    cloning = Cloning(0.5, 200, False)
    weights = []
    for frames in (0, 50, 100, 200, 300):
        cloning.fade(frames)
        weights.append(float(cloning.weight))
    assert weights == pytest.approx([0.5, 0.375, 0.25, 0.0, 0.0])
    lasting = Cloning(0.5, None, False)
    lasting.fade(10**9)
    assert float(lasting.weight) == 0.5


def test_without_a_weight_there_is_no_term() -> None:
    assert cloning_of(ClonedDemosConfig(transitions=10, share=0.5), torch.device("cpu")) is None


# Bad input.


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        ({"cloning": -1.0, "share": 0.5}, "algo.demos.cloning must be at least 0 and finite, got -1.0."),
        (
            {"cloning": float("nan"), "share": 0.5},
            "algo.demos.cloning must be at least 0 and finite, got nan.",
        ),
        ({"cloning": 1.0}, "algo.demos.cloning=1.0 imitates .* set algo.demos.share, too."),
        ({"cloning": 1.0, "share": 0.5, "cloning_frames": 0}, "cloning_frames must be at least 1, got 0."),
        ({"share": 0.5, "q_filter": True}, "need algo.demos.cloning."),
        ({"share": 0.5, "cloning_frames": 10}, "need algo.demos.cloning."),
    ],
)
def test_settings_that_are_refused(settings: dict[str, Any], message: str) -> None:
    with pytest.raises(ValueError, match=message):
        ClonedDemosConfig(transitions=10, **settings)


def test_an_algorithm_without_cloning() -> None:
    from nht.recipes.agents.sac import SAC

    with pytest.raises(
        ValueError, match=r"Key 'cloning' not in 'ReplayDemosConfig'.*'transitions', 'cloning_start', 'share'"
    ):
        configure(SAC, "sac", ["algo.demos.cloning=1"])
