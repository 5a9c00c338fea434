"""Puts demonstrations into the replay buffer, or into one of their own beside it."""

from __future__ import annotations

from collections.abc import Callable

from tensordict import TensorDictBase
from torchrl.data import TensorDictReplayBuffer

from nht.recipes.agents.replay import DemosBuffer, replay_buffer
from nht.recipes.run.ranks import Ranks


def replay_demos(
    steps: TensorDictBase | None,
    share: float,
    ranks: Ranks,
    buffer: TensorDictReplayBuffer,
    rows: Callable[[TensorDictBase], TensorDictBase],
) -> DemosBuffer | None:
    """Let an algorithm learn from the run's demonstrations, if it has any, as from steps that it collected.

    TorchRL's ``OfflineToOnlineReplayBuffer`` draws such shares for one minibatch at a time and for one learner; here
    the minibatches of many updates, and of many learners, are drawn at once.

    Args:
        steps: demonstrated, ``(1, T)``; of several learners ``(L, 1, T)``.
        share: of every minibatch; with 0 they go into ``buffer``.
        ranks: the processes that learn together; each takes its part of the demonstrations.
        buffer: of what is collected.
        rows: makes rows of a buffer of steps ``(copies, T)``, or ``(learners, copies, T)``.

    Returns:
        what ``minibatches`` draws their share from; None if they have none.
    """
    if steps is None:
        return None
    found = rows(steps)[ranks.rank :: ranks.size]
    if not share:
        buffer.extend(found)
        return None
    beside = replay_buffer(len(found), ranks.device)
    beside.extend(found)
    return DemosBuffer(beside, share)
