"""Puts demonstrations into the replay buffer, or into one of their own beside it."""

from __future__ import annotations

from collections.abc import Callable

from tensordict import TensorDictBase
from tensordict.nn import TensorDictModule
from torchrl.data import TensorDictReplayBuffer

from nht.recipes.agents.replay import DemosBuffer, replay_buffer
from nht.recipes.run.demonstrations import asked_for, demonstrated
from nht.recipes.run.folder import RunFolder
from nht.recipes.run.population import PopulationFolder
from nht.recipes.run.ranks import Ranks


def replay_demos(
    folder: RunFolder | PopulationFolder,
    ranks: Ranks,
    buffer: TensorDictReplayBuffer,
    features: TensorDictModule,
    rows: Callable[[TensorDictBase], TensorDictBase],
) -> DemosBuffer | None:
    """Let an algorithm learn from the run's demonstrations, if it is told to, as from steps that it collected.

    TorchRL's ``OfflineToOnlineReplayBuffer`` draws such shares for one minibatch at a time and for one learner; here
    the minibatches of many updates, and of many learners, are drawn at once.

    Args:
        folder: of the run.
        ranks: the processes that learn together; each takes its part of the demonstrations.
        buffer: of what is collected; without ``algo.demos.share`` they go in there.
        features: the normaliser, which takes their observations into its statistics.
        rows: makes rows of a buffer of steps ``(copies, T)``, or ``(learners, copies, T)``.

    Returns:
        what ``minibatches`` draws their share from; None if they have none.
    """
    steps = demonstrated(folder.configs, folder.maps)
    if steps is None:
        return None
    own = slice(ranks.rank, None, ranks.size)
    features.module.update(steps["observation"][..., own, :], ranks.sum)
    share, found = asked_for(folder.config).share, rows(steps)[own]
    if not share:
        buffer.extend(found)
        return None
    beside = replay_buffer(len(found), ranks.device)
    beside.extend(found)
    return DemosBuffer(beside, share)
