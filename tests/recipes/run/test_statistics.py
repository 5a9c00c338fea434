"""What a run counts between two evaluations."""

import math

import pytest
import torch
from tensordict import TensorDict
from torchrl.data import Bounded

from nht.recipes.run.statistics import TrainingStatistics

BOUNDS = Bounded(low=torch.tensor([[-1.0, -2.0]] * 3), high=torch.tensor([[1.0, 2.0]] * 3)).space


def steps(actuation: list[list[float]], done: list[bool]) -> TensorDict:
    count = len(actuation)
    flag = torch.zeros(count, 1, dtype=torch.bool)
    outcome = {name: flag.clone() for name in ("success", "failure", "diverged")}
    outcome |= {"done": torch.tensor(done)[:, None], "actuation": torch.tensor(actuation)}
    return TensorDict({"next": outcome}, batch_size=count).unflatten_keys()


def test_actuations_at_the_motors_limits_are_counted() -> None:
    statistics = TrainingStatistics(BOUNDS)
    data = steps([[0.5, 1.9], [1.0, 0.0], [0.0, -2.0], [-0.99, 1.0]], done=[False] * 4)
    statistics.add_steps(data)
    (row,), (later,) = statistics.take(), statistics.take()
    assert row["clipped"] == 0.5
    assert math.isnan(later["clipped"])  # starts anew


def test_outcomes_are_means_over_the_episodes_that_ended() -> None:
    statistics = TrainingStatistics(BOUNDS)
    data = steps([[0.0, 0.0]] * 4, done=[True, False, True, False])
    data["next", "success"][:] = torch.tensor([[True], [True], [False], [False]])
    data["next", "diverged"][3] = True
    statistics.add_steps(data)
    (row,) = statistics.take()
    assert (row["train_success"], row["train_failure"], row["diverged"]) == (0.5, 0, 1)


def test_a_loss_that_is_no_number_ends_the_training() -> None:
    statistics = TrainingStatistics(BOUNDS, losses=["loss_actor"])
    statistics.add_losses(TensorDict({"loss_actor": torch.tensor(torch.nan)}))
    (lost,) = statistics.take()
    assert isinstance(lost, FloatingPointError)
    assert str(lost).startswith("loss_actor is nan: training diverged")


@pytest.mark.parametrize("learners", [None, 3])
def test_counted_apart_by_a_process_and_the_one_that_goes_on_it_is_the_same(learners: int | None) -> None:
    first = steps([[0.0, 0.0], [1.0, 0.0]], done=[True, False])
    second = steps([[1.0, 0.0], [1.0, 0.0]], done=[True, True])
    first["next", "success"][:] = True
    if learners is not None:
        first, second = (TensorDict.stack([data] * learners) for data in (first, second))
    whole, stopped, resumed = (TrainingStatistics(BOUNDS, learners=learners) for _ in range(3))
    whole.add_steps(first)
    whole.add_steps(second)
    stopped.add_steps(first)
    resumed.load_state_dict(stopped.state_dict())
    resumed.add_steps(second)
    rows = resumed.take()
    assert rows == whole.take()
    assert len(rows) == (learners or 1)
    assert rows[0]["train_success"] == pytest.approx(1 / 3)


def updates(values: list[float], target: float = 0.0) -> list[TensorDict]:
    return [
        TensorDict({"loss": torch.tensor(value), "target_value": torch.full((4,), target)})
        for value in values
    ]


def test_means_in_between_leave_the_means_of_the_whole_alone() -> None:
    plain, watched = (TrainingStatistics(BOUNDS, losses=["loss"]) for _ in range(2))
    parts = [updates([1.0, 2.0]), updates([6.0]), updates([7.0])]
    seen = []
    for part in parts:
        for losses in part:
            plain.add_losses(losses)
            watched.add_losses(losses)
        seen.append(watched.latest()[0]["loss"])
    assert seen == [1.5, 6.0, 7.0]
    assert watched.take()[0]["loss"] == plain.take()[0]["loss"] == 4.0
    watched.add_losses(updates([3.0])[0])
    assert watched.latest()[0]["loss"] == 3.0  # begins anew with the next row


def test_the_value_is_sampled_every_tenth_update() -> None:
    statistics = TrainingStatistics(BOUNDS, losses=["loss"])
    for number in range(25):
        statistics.add_losses(updates([0.0], target=float(number))[0])
    assert statistics.take()[0]["value"] == (0 + 10 + 20) / 3
    assert math.isnan(statistics.take()[0]["value"])
    statistics.add_losses(updates([0.0], target=5.0)[0])
    assert statistics.take()[0]["value"] == 5.0


def test_returns_are_means_over_the_episodes_that_ended() -> None:
    statistics = TrainingStatistics(BOUNDS, copies=2)
    data = steps([[0.0, 0.0]] * 6, done=[False, True, False, False, False, True])
    data["next", "reward"] = torch.tensor([[1.0], [2.0], [50.0], [3.0], [4.0], [5.0]])
    statistics.add_steps(data)
    statistics.add_returns(data.reshape(2, 3))
    (row,) = statistics.take()
    assert (row["train_return"], row["train_length"]) == ((3 + 12) / 2, (2 + 3) / 2)
