"""A step through a map asks for no tensor's values: on a GPU that would make the host wait at every step."""

from __future__ import annotations

import pytest
import torch
from tensordict import TensorDict, TensorDictBase
from torchrl.envs import EnvBase, TransformedEnv
from torchrl.envs.transforms import Compose, StepCounter

from nht import NHT
from nht.transforms import ActionMapTransform
from no_sync import Waits
from toy_envs import CONTEXT_KEYS, ToyArm

ROWS = (3,)


def mapped(env: EnvBase, **keys: str) -> TransformedEnv:
    transform = ActionMapTransform(NHT(5, 3, 2, hidden=(8,)), context_keys=CONTEXT_KEYS, **keys)
    return TransformedEnv(env, Compose(transform, StepCounter()))


def waits_of_steps(env: EnvBase) -> list[str]:
    """What a GPU would be waited for in a step of some copies, one of all, and a reset of some."""
    some = torch.tensor([True, False, True])

    def steps() -> None:
        first = env.rand_action(env.reset())
        data = env.step(first.set("_step", some))["next"].exclude("reward")
        data = env.step(env.rand_action(data))["next"]
        env.reset(data.set("_reset", some[:, None]))

    steps()  # what is made once is made
    with Waits() as waits:
        steps()
    return waits.found


@pytest.mark.parametrize("keys", [{}, {"actuation_key": "action", "action_key": "chosen"}])
def test_a_map_adds_no_waiting_to_a_step(keys: dict[str, str]) -> None:
    plain = TransformedEnv(ToyArm(ROWS), Compose(StepCounter()))
    assert waits_of_steps(mapped(ToyArm(ROWS), **keys)) == waits_of_steps(plain)


def hooks(transform: ActionMapTransform, start: TensorDictBase) -> TensorDictBase:
    """What TorchRL calls of the transform in a reset and a step, and nothing else; what came out."""
    state = transform._reset(start.clone(), start.clone())
    data = transform.inv(state.set("action", torch.full((*ROWS, 2), 0.5)))
    data.set("_step", torch.tensor([True, False, True]))
    return transform._step(data, start.select("joint", "tool").clone())


def test_the_transforms_own_part_makes_nobody_wait() -> None:
    env = mapped(ToyArm(ROWS))
    transform, start = env.transform[0], env.base_env.reset()
    hooks(transform, start)
    with Waits() as waits:
        found = hooks(transform, start)
    assert waits.found == []
    assert (found[transform.executed_key].abs().amax(-1) > 0).tolist() == [True, False, True]


def recorded(device: str) -> TensorDict:
    rows = {"joint": torch.rand(6, 3, device=device), "tool": torch.rand(6, 2, device=device)}
    return TensorDict({**rows, "actuation": torch.rand(6, 3, device=device)}, 6)


def test_the_way_back_makes_nobody_wait_and_stays_on_the_device() -> None:
    transform = ActionMapTransform(
        NHT(5, 3, 2, hidden=(8,)), context_keys=CONTEXT_KEYS, actuation_key="actuation", forward_only=True
    )
    expected = transform(recorded("cpu"))["action"].shape
    with Waits() as waits:
        transform(recorded("cpu"))
    assert waits.found == []
    found = transform.to("meta")(recorded("meta"))["action"]
    assert (found.device.type, found.shape) == ("meta", expected)
