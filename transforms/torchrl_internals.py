"""Private parts of TorchRL that this package relies on: all of them, so that an upgrade which moves one is noticed.

``tests/test_transform_torchrl_internals.py`` has a test for each.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence

from tensordict import TensorDictBase
from torchrl.envs import EnvBase, TransformedEnv
from torchrl.envs.transforms import Compose, Transform, VecGymEnvTransform


class EarlyReader(Transform):
    """A transform that may read observations before the transforms ahead of it rewrite them.

    Attributes:
        reads_early: whether ``read_raw`` is called, by the chain around it, before the first rewriter runs.
    """

    reads_early = False

    def read_raw(self, observed: TensorDictBase) -> None:
        """Read what the environment returned; entries may be added to it."""
        raise NotImplementedError

    def before_reset(self) -> None:
        """Called before the environment is reset; by default nothing."""

    def _reset_env_preprocess(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Relies on ``TransformedEnv`` calling this before a reset, as it calls ``inv`` before a step."""
        self.before_reset()
        return super()._reset_env_preprocess(tensordict)


def containers(transform: Transform) -> Iterator[Compose | EnvBase]:
    """The containers of a transform, from the innermost Compose to the environment, if there is one.

    Relies on ``Transform._container``, a weak reference to the next one or None. The public ``Transform.container``
    gives the environment alone, and fails where a Compose has none yet.
    """
    inner: Transform | EnvBase = transform
    while isinstance(inner, Transform) and (reference := inner.__dict__.get("_container")) is not None:
        container = reference()
        if container is None:
            return
        yield container
        inner = container


def surroundings(transform: Transform) -> tuple[EnvBase | None, Compose | None, list[Transform]]:
    """The environment, the outermost Compose around a transform and, flat, all transforms that run before it.

    Public is only ``Transform.parent``, which copies all of these, and fails where a nested Compose comes first.
    """
    chain: Compose | None = None
    ahead: list[Transform] = []
    inner = transform
    for container in containers(transform):
        if not isinstance(container, Compose):
            return container, chain, ahead
        siblings = list(container.transforms)
        ahead[:0] = [leaf for sibling in siblings[: siblings.index(inner)] for leaf in leaves(sibling)]
        chain = inner = container
    return None, chain, ahead


def leaves(transform: Transform) -> list[Transform]:
    """The transforms of nested chains in the order in which they run; a transform that is no chain alone.

    Relies on ``Compose._step`` and ``_reset`` calling those of their transforms in turn, and doing nothing else.
    """
    plain = type(transform)._step is Compose._step and type(transform)._reset is Compose._reset
    if not isinstance(transform, Compose) or not plain:
        return [transform]
    return [leaf for child in transform.transforms for leaf in leaves(child)]


def let_read_early(chain: Compose, also: Sequence[EarlyReader] = ()) -> None:
    """Have a chain call its early readers with what the environment returned, before it runs any transform.

    The order, the indices and the names of the chain's transforms stay as they are, and so does what they do. What a
    transform takes for its ``parent``, and steps again, reads as early.

    Relies on ``TransformedEnv`` calling ``_step`` and ``_reset`` of its transform with these arguments, on ``parent``
    calling ``_rebuild_up_to`` of the chain, and on an object's ``__dict__`` going before its class, which ``clone`` of
    a Compose leaves behind.

    Args:
        chain: the outermost Compose.
        also: early readers outside the chain.
    """
    reading = getattr(chain.__dict__.get("_step"), "__self__", None)
    if not isinstance(reading, _EarlyReading):
        reading = _EarlyReading(chain)
        chain.__dict__.update(_step=reading.step, _reset=reading.reset, _rebuild_up_to=reading.rebuild_up_to)
    reading.also += also


class _EarlyReading:
    """What one chain does instead of ``Compose._step``, ``_reset`` and ``_rebuild_up_to``.

    A class rather than a closure, so that it is copied and pickled with its chain.
    """

    def __init__(self, chain: Compose) -> None:
        self.chain = chain
        self.also: list[EarlyReader] = []

    def step(self, tensordict: TensorDictBase, next_tensordict: TensorDictBase) -> TensorDictBase:
        return self._run("_step", tensordict, next_tensordict)

    def reset(self, tensordict: TensorDictBase, tensordict_reset: TensorDictBase) -> TensorDictBase:
        return self._run("_reset", tensordict, tensordict_reset)

    def _run(self, method: str, tensordict: TensorDictBase, observed: TensorDictBase) -> TensorDictBase:
        chain = leaves(self.chain)
        waiting = [*self.also, *_early(chain)]
        for leaf in chain:
            if not completes_the_environment(leaf):
                while waiting:
                    waiting.pop().read_raw(observed)
            observed = getattr(leaf, method)(tensordict, observed)
        for reader in waiting:
            reader.read_raw(observed)
        return observed

    def rebuild_up_to(self, final_transform: Transform) -> tuple[TransformedEnv | None, Compose | None]:
        env, chain = Compose._rebuild_up_to(self.chain, final_transform)
        if env is not None:
            inside = leaves(env.transform)
            behind = leaves(self.chain)[len(inside) :]
            let_read_early(env.transform, [*self.also, *_early(behind)])
        return env, chain


def completes_the_environment(transform: Transform) -> bool:
    """Whether a transform belongs to TorchRL's own vectorised Gym environments: raw is what it returns."""
    return isinstance(transform, VecGymEnvTransform)


def _early(transforms: Sequence[Transform]) -> list[EarlyReader]:
    return [found for found in transforms if isinstance(found, EarlyReader) and found.reads_early]
