"""Filling a replay buffer and drawing from it: how often the host of a GPU waits, of one learner and of several."""

from __future__ import annotations

from collections.abc import Callable

import pytest
import torch
from tensordict import TensorDict
from tensordict.nn import TensorDictModule

from nht.recipes.agents.norm import RunningNorm
from nht.recipes.agents.replay import STORED, DemosBuffer, minibatches, replay_buffer, storable
from nht.recipes.run.draws import Draws
from no_sync import Waits

CPU, SIZE, UPDATES = torch.device("cpu"), 5, 4


def collected(*shape: int) -> TensorDict:
    """Steps ``(copies, T)``, or ``(L, copies, T)``, with all that the buffer keeps."""
    data = TensorDict({"unused": torch.zeros(*shape, 1)}, shape)
    for key in STORED:
        flag = key[-1] in ("done", "terminated")
        wide = "observation" in key
        data[key] = (
            torch.zeros(*shape, 1, dtype=torch.bool) if flag else torch.rand(*shape, SIZE if wide else 1)
        )
    return data


def drawn(learners: int | None, share: float) -> Callable[[], list[TensorDict]]:
    """Draws the minibatches after a batch of steps; with a share of demonstrations, if it is not 0."""
    buffer, beside = replay_buffer(1000, CPU), replay_buffer(1000, CPU)
    for each in (buffer, beside):
        each.extend(storable(collected(*([] if learners is None else [learners]), 3, 20)))
    demos = DemosBuffer(beside, share) if share else None
    norm = RunningNorm(SIZE) if learners is None else TallNorm(learners)
    features = TensorDictModule(norm, ["observation"], ["features"])
    if learners is None:
        return lambda: list(minibatches(buffer, UPDATES, 16, features, CPU, demos=demos))
    draws, sizes = Draws(range(learners), CPU), [16, 7][:learners]
    return lambda: list(minibatches(buffer, UPDATES, sizes, features, CPU, draws, demos))


class TallNorm(torch.nn.Module):
    """Of each of several learners: what a population's features do, plainly."""

    def __init__(self, learners: int) -> None:
        super().__init__()
        self.register_buffer("scale", torch.rand(learners, 1, 1, SIZE))  # beside (L, updates, B, SIZE)

    def forward(self, observation: torch.Tensor) -> torch.Tensor:
        return observation * self.scale


@pytest.mark.parametrize("share", [0.0, 0.25])
@pytest.mark.parametrize("learners", [None, 2])
def test_drawing_minibatches_makes_nobody_wait(learners: int | None, share: float) -> None:
    draw = drawn(learners, share)
    draw()  # what is made once is made
    with Waits() as waits:
        batches = draw()
    assert waits.found == []
    assert len(batches) == UPDATES
    assert batches[0].shape == ((16,) if learners is None else (2, 16))


@pytest.mark.parametrize(("shape", "waits"), [((3, 20), 1), ((2, 3, 20), 0)])
def test_filling_the_buffer_waits_once_a_batch_and_for_torchrl(shape: tuple[int, ...], waits: int) -> None:
    buffer = replay_buffer(1000, CPU)
    buffer.extend(storable(collected(*shape)))
    with Waits() as choosing:
        rows = storable(collected(*shape))
    assert len(choosing.found) == waits  # for the number of rows, without those whose action is not finite
    with Waits() as writing:
        buffer.extend(rows)
    assert len(writing.found) <= 1  # TorchRL's own
