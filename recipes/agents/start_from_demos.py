"""What a learner knows before its first step: how the demonstrations look, and what was done in them."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from tensordict import TensorDictBase
from tensordict.nn import TensorDictModule
from torchrl.envs.utils import ExplorationType, set_exploration_type

from nht.recipes.agents.adam import LearnersAdam
from nht.recipes.agents.settings import Setting
from nht.recipes.run.demonstrations import asked_for
from nht.recipes.run.ranks import Ranks
from nht.recipes.sections import Training

BATCH = 256
"""Demonstrated steps in a gradient step."""


def start_from_demos(
    steps: TensorDictBase | None,
    features: TensorDictModule,
    actor: TensorDictModule,
    configs: Sequence[Training],
    learning_rate: Setting,
    ranks: Ranks,
) -> None:
    """Take demonstrations into the normaliser's statistics, and let the actor imitate them (behaviour cloning).

    The actor descends on mean |pi(s) - a|^2, where pi(s) is its action without exploration. All processes take the same
    steps on all demonstrations, so that they end with the same actor. Adam forgets afterwards what it gathered here.

    Args:
        steps: demonstrated, ``(1, T)``; of several learners ``(L, 1, T)``; None leaves everything as it is.
        features: the normaliser, ``"observation"`` to ``"features"``.
        actor: ``"features"`` to an ``"action"``, before losses make their copies of it.
        configs: of each learner, with the number of gradient steps and the seed by which it draws its minibatches.
        learning_rate: of Adam.
        ranks: the processes that learn together.
    """
    if steps is None:
        return
    part = slice(ranks.rank, None, ranks.size)
    features.module.update(steps["observation"][..., part, :], ranks.sum)
    updates = asked_for(configs[0]).cloning_start
    if not updates:
        return
    shown = steps.select("observation", "action").squeeze(-2)  # (T,), or (L, T)
    with torch.no_grad():
        features(shown)
    # PPO's action is its sample, clipped: beyond the limits it has no gradient.
    acted = "sample" if "sample" in actor.out_keys else "action"
    optimiser = LearnersAdam([(actor.parameters(), learning_rate)])
    draws = [torch.Generator().manual_seed(config.seed) for config in configs]
    with set_exploration_type(ExplorationType.DETERMINISTIC):
        for _ in range(updates):
            drawn = [torch.randint(shown.shape[-1], (BATCH,), generator=own) for own in draws]
            places = torch.stack(drawn).view(*shown.shape[:-1], BATCH, 1).to(shown.device)
            batch = shown.apply(
                lambda values, places=places: values.take_along_dim(places, -2),
                batch_size=places.shape[:-1],
            )
            wanted = batch["action"]
            error = (actor(batch)[acted] - wanted).square().sum(-1)
            error.mean(-1).sum().backward()
            optimiser.step()
            optimiser.zero_grad()
