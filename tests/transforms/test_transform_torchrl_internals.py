"""Contracts with TorchRL's private parts: each fails by name where an upgrade changes what the transforms rely on."""

import weakref

import torch
from torchrl.envs import Compose, ObservationNorm, StepCounter, TransformedEnv
from torchrl.envs.transforms import Transform, VecGymEnvTransform

from nht.transforms.torchrl_internals import (
    EarlyReader,
    completes_the_environment,
    containers,
    leaves,
    let_read_early,
    surroundings,
)
from toy_envs import ToyArm


class Early(EarlyReader):
    """Keeps a copy of the joints under a key of its own."""

    reads_early = True

    def read_raw(self, observed):
        observed["early"] = observed["joint"].clone()


class Recorder(Transform):
    """Notes which of its methods are called, and with what."""

    def __init__(self):
        super().__init__()
        self.calls = []

    def _step(self, tensordict, next_tensordict):
        self.calls.append(("_step", tensordict, next_tensordict))
        return next_tensordict

    def _reset(self, tensordict, tensordict_reset):
        self.calls.append(("_reset", tensordict, tensordict_reset))
        return tensordict_reset

    def _inv_call(self, tensordict):
        self.calls.append(("_inv_call", tensordict, None))
        return tensordict

    def _reset_env_preprocess(self, tensordict):
        self.calls.append(("_reset_env_preprocess", tensordict, None))
        return tensordict


def norm():
    return ObservationNorm(loc=1.0, scale=3.0, in_keys=["joint"])


def test_container_is_a_weak_reference_to_what_is_around_a_transform():
    inner = StepCounter()
    assert inner.__dict__["_container"] is None
    nested = Compose(inner)
    assert isinstance(inner.__dict__["_container"], weakref.ref)
    outer = Compose(nested)
    assert list(containers(inner)) == [nested, outer]
    env = TransformedEnv(ToyArm(), outer)
    assert list(containers(inner)) == [nested, outer, env]
    outer.reset_parent()
    assert list(containers(outer)) == []


def test_surroundings_are_flat_and_in_order():
    first, second, third, last = StepCounter(), norm(), norm(), StepCounter()
    chain = Compose(first, Compose(second, Compose(third, last)))
    env = TransformedEnv(ToyArm(), chain)
    assert surroundings(last) == (env, chain, [first, second, third])
    assert surroundings(first) == (env, chain, [])
    assert leaves(chain) == [first, second, third, last]


def test_transformed_env_calls_step_and_reset_of_its_transform():
    recorder = Recorder()
    env = TransformedEnv(ToyArm(), Compose(recorder))
    observed = env.reset()
    assert [name for name, *_ in recorder.calls] == ["_reset_env_preprocess", "_reset"]
    recorder.calls.clear()
    env.rand_step(observed)
    assert [name for name, *_ in recorder.calls] == ["_inv_call", "_step"]
    given, made = recorder.calls[0][1], recorder.calls[1][1]
    assert given is made, "what inv made of the input is what _step gets: Repeats writes to it"
    assert given is not observed


def test_compose_steps_and_resets_its_transforms_in_turn_and_does_nothing_else():
    for method in ("_step", "_reset"):
        first, second = Recorder(), Recorder()
        chain = Compose(first, Compose(second))
        given, observed = object(), object()
        assert getattr(Compose, method)(chain, given, observed) is observed
        assert first.calls == second.calls == [(method, given, observed)]


def test_inv_hands_on_the_very_tensors():
    """Repeats knows an executed actuation as the tensor that it is, or as a copy of it."""
    data = ToyArm().rand_action(ToyArm().reset())
    handed = Compose(StepCounter()).inv(data)
    assert handed is not data
    assert handed["action"] is data["action"]


def test_methods_in_an_objects_dict_go_first_and_clones_are_without_them():
    env = TransformedEnv(ToyArm((2,)), Compose(norm(), Early()))
    chain = env.transform
    let_read_early(chain)
    let_read_early(chain)
    observed = env.rand_step(env.reset())["next"]
    torch.testing.assert_close(observed["early"], observed["raw", "joint"])
    assert not torch.isclose(observed["early"], observed["joint"]).all()
    assert {"_step", "_reset", "_rebuild_up_to"} <= chain.__dict__.keys()
    assert not {"_step", "_reset", "_rebuild_up_to"} & chain.clone().__dict__.keys()
    assert len(chain) == 2


def test_a_parent_reads_as_early_as_the_chain_it_was_taken_from():
    first, second, early = norm(), StepCounter(), Early()
    env = TransformedEnv(
        ToyArm((2,)), Compose(Compose(StepCounter(step_count_key="own"), first), second, early)
    )
    let_read_early(env.transform)
    for transform in (first, second):
        parent = transform.parent
        observed = parent.rand_step(parent.reset())["next"]
        torch.testing.assert_close(observed["early"], observed["raw", "joint"])
        assert early not in leaves(parent.transform)


def test_vec_gym_env_transform_goes_before_what_is_raw():
    assert completes_the_environment(VecGymEnvTransform())
    assert not completes_the_environment(StepCounter())
    order = []

    class Gym(VecGymEnvTransform):
        def _step(self, tensordict, next_tensordict):
            order.append("completed")
            return next_tensordict

    class Reader(Early):
        def read_raw(self, observed):
            order.append("read")

    chain = Compose(Gym(), StepCounter(), Reader())
    let_read_early(chain)
    data = ToyArm().rand_step(ToyArm().reset())
    chain.transforms[1]._step = lambda _, observed: observed
    chain._step(data, data["next"])
    assert order == ["completed", "read"]


def test_transforms_are_told_before_the_environment_is_reset():
    told = []

    class Told(EarlyReader):
        def before_reset(self):
            told.append("before")

    class Noting(ToyArm):
        def _reset(self, tensordict=None, **options):
            told.append("reset")
            return super()._reset(tensordict, **options)

    env = TransformedEnv(Noting(), Compose(StepCounter(), Told()))
    told.clear()
    env.reset()
    assert told == ["before", "reset"]
