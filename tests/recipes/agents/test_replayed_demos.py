"""Minibatches with a fixed share of demonstrations, for one learner and for several."""

from __future__ import annotations

from collections.abc import Sequence
from types import SimpleNamespace
from typing import Any

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from tensordict import TensorDict
from tensordict.nn import TensorDictModule

from nht.recipes.agents.norm import RunningNorm
from nht.recipes.agents.off_policy import OffPolicyConfig
from nht.recipes.agents.replay import DemosBuffer, minibatches, replay_buffer
from nht.recipes.agents.replayed_demos import replay_demos
from nht.recipes.agents.start_from_demos import start_from_demos
from nht.recipes.run.draws import Draws
from nht.recipes.sections import ReplayDemosConfig

CPU = torch.device("cpu")
DEMONSTRATED = 1_000.0
"""Added to what demonstrations hold, so that one sees where a step comes from."""


def filled(count: int, learners: int | None, offset: float) -> Any:
    """A buffer whose steps hold their learner's number, and whether they were demonstrated."""
    rows = [count] if learners is None else [count, learners]
    owner = torch.arange(learners or 1).float().expand(count, learners or 1).reshape(*rows, 1)
    told = TensorDict({"observation": owner + offset}, rows)
    buffer = replay_buffer(count, CPU)
    buffer.extend(told.clone().set("next", told.clone()))
    return buffer


def features(learners: int | None = None) -> TensorDictModule:
    return TensorDictModule(RunningNorm(1, learners=learners), ["observation"], ["features"])


def drawn(sizes: int | Sequence[int], share: float, updates: int = 3, seed: int = 0) -> list[Any]:
    """Minibatches of learners with these batch sizes."""
    learners = None if isinstance(sizes, int) else len(sizes)
    draws = None if learners is None else Draws([seed + learner for learner in range(learners)], CPU)
    demos = DemosBuffer(filled(7, learners, DEMONSTRATED), share)
    own = filled(30, learners, 0.0)
    return list(minibatches(own, updates, sizes, features(learners), CPU, draws, demos))


@given(size=st.integers(2, 40), share=st.floats(0.01, 0.99))
@settings(max_examples=40)
def test_every_minibatch_has_exactly_its_share(size: int, share: float) -> None:
    wanted = min(max(1, round(share * size)), size - 1)
    batches = drawn(size, share)
    assert len(batches) == 3
    for batch in batches:
        assert batch.shape == (size,)
        assert int((batch["observation"] >= DEMONSTRATED).sum()) == wanted
        assert batch["next", "observation"].equal(batch["observation"])


@given(sizes=st.lists(st.integers(2, 30), min_size=2, max_size=4), share=st.floats(0.01, 0.99))
@settings(max_examples=40)
def test_every_learner_has_exactly_its_share_of_its_own(sizes: list[int], share: float) -> None:
    for batch in drawn(sizes, share):
        weights = batch.get("weight", torch.full(batch.shape, 1.0 / sizes[0]))
        assert (
            batch["observation"]
            .squeeze(-1)
            .remainder(DEMONSTRATED)
            .equal(torch.arange(len(sizes)).float().unsqueeze(-1).expand(batch.shape))
        )
        for size, weight, seen in zip(sizes, weights, batch["observation"].squeeze(-1), strict=True):
            counts = weight > 0
            assert int(counts.sum()) == size
            wanted = min(max(1, round(share * size)), size - 1)
            assert int((seen[counts] >= DEMONSTRATED).sum()) == wanted
            assert float(weight.sum()) == pytest.approx(1.0)


def test_a_learner_draws_what_it_would_draw_alone() -> None:
    def rows(offset: float, learners: int | None) -> Any:
        buffer = filled(30, learners, 0.0)
        stored = buffer.storage[:30]
        values = torch.arange(30.0) + offset
        stored["observation"][:] = values.view(-1, *[1] * (stored["observation"].ndim - 1))
        return buffer

    draws = Draws([4, 9], CPU)
    together = list(
        minibatches(
            rows(0.0, 2), 2, [8, 8], features(2), CPU, draws, DemosBuffer(rows(DEMONSTRATED, 2), 0.25)
        )
    )
    for learner, seed in enumerate((4, 9)):
        torch.manual_seed(seed)
        alone = minibatches(
            rows(0.0, None), 2, 8, features(), CPU, demos=DemosBuffer(rows(DEMONSTRATED, None), 0.25)
        )
        for mine, ours in zip(alone, together, strict=True):
            found = [
                value.flatten().sort().values for value in (mine["observation"], ours["observation"][learner])
            ]
            assert found[0].equal(found[1])


def test_without_demonstrations_minibatches_are_plain_draws_from_the_buffer() -> None:
    buffer = filled(30, None, 0.0)
    buffer.storage[:30]["observation"][:] = torch.arange(30.0).unsqueeze(-1)
    torch.manual_seed(3)
    found = list(minibatches(buffer, 2, 8, features(), CPU))
    torch.manual_seed(3)
    for batch, expected in zip(found, buffer.sample(16).split(8), strict=True):
        assert batch["observation"].equal(expected["observation"])


@pytest.mark.parametrize("share", [0.0, 0.5])
def test_processes_divide_the_demonstrations(share: float) -> None:
    steps = TensorDict({"observation": torch.arange(7.0).view(1, 7, 1)}, [1, 7])
    found, seen = [], []
    for rank in range(2):
        ranks: Any = SimpleNamespace(rank=rank, size=2, device=CPU, sum=lambda values: values)
        config: Any = SimpleNamespace(
            algo=SimpleNamespace(demos=ReplayDemosConfig(transitions=7, share=share))
        )
        buffer, normaliser = replay_buffer(20, CPU), features()
        start_from_demos(steps, normaliser, normaliser, [config], 1e-3, ranks)
        beside = replay_demos(steps, share, ranks, buffer, lambda rows: rows.reshape(-1))
        assert (beside is None) == (share == 0)
        kept = buffer if beside is None else beside.buffer
        assert len(buffer) == (0 if share else len(kept))
        found.append(kept.storage[: len(kept)]["observation"].flatten())
        seen.append(int(normaliser.module.count))
    assert torch.cat(found).sort().values.tolist() == list(range(7))
    assert seen == [4, 3]


# Bad input.


@pytest.mark.parametrize("share", [-0.1, 1.0, 1.5, float("nan")])
def test_a_share_that_is_none(share: float) -> None:
    with pytest.raises(ValueError, match=r"algo.demos.share must lie in \[0, 1\), got "):
        ReplayDemosConfig(transitions=10, share=share)


def test_a_share_of_no_demonstrations() -> None:
    with pytest.raises(ValueError, match=r"algo.demos.share=0.5 is .*: set algo.demos.transitions, too."):
        ReplayDemosConfig(share=0.5)


def test_fewer_than_no_demonstrations() -> None:
    with pytest.raises(ValueError, match=r"algo.demos.transitions must be at least 0, got -1."):
        ReplayDemosConfig(transitions=-1)


@pytest.mark.parametrize("share", [0.001, 0.999])
def test_a_share_that_leaves_one_kind_without_a_place(share: float) -> None:
    with pytest.raises(ValueError, match=f"algo.demos.share={share} of algo.batch_size=32 leaves"):
        OffPolicyConfig(batch_size=32, demos=ReplayDemosConfig(transitions=10, share=share))


def test_more_demonstrations_than_the_replay_buffer_holds() -> None:
    with pytest.raises(ValueError, match=r"algo.demos.transitions=11 must be at most algo.buffer_size=10"):
        OffPolicyConfig(buffer_size=10, demos=ReplayDemosConfig(transitions=11))
    OffPolicyConfig(buffer_size=10, demos=ReplayDemosConfig(transitions=11, share=0.5))
