"""Private parts of TorchRL that this package relies on: all of them, so that an upgrade which moves one is noticed.

``tests/test_transform_torchrl_internals.py`` has a test for each.
"""

from __future__ import annotations

from collections.abc import Iterator

from tensordict import TensorDictBase
from torchrl.envs import EnvBase
from torchrl.envs.transforms import Compose, Transform


class EarlyReader(Transform):
    """A transform that may have to read observations before transforms that run ahead of it rewrite them.

    Attributes:
        reads_early: whether `read_raw` is called, by the chain around it, before the first rewriter runs.
    """

    reads_early = False

    def read_raw(self, observed: TensorDictBase) -> None:
        """Reads what the environment returned, and may add entries to it."""
        raise NotImplementedError


def containers(transform: Transform) -> Iterator[Compose | EnvBase]:
    """What is around a transform, from the innermost Compose to the environment, as far as there is one.

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
    """The transforms of nested chains in the order in which they run; one that is no chain, by itself.

    Relies on ``Compose._step`` and ``_reset`` calling those of their transforms in turn, and doing nothing else.
    """
    plain = type(transform)._step is Compose._step and type(transform)._reset is Compose._reset
    if not isinstance(transform, Compose) or not plain:
        return [transform]
    return [leaf for child in transform.transforms for leaf in leaves(child)]


def let_read_early(chain: Compose, spared: tuple[type[Transform], ...]) -> None:
    """Has a chain call its early readers before any transform runs that may rewrite the observation.

    The order, the indices and the names of the chain's transforms stay as they are, and so does what they do.

    Relies on ``TransformedEnv`` calling ``_step`` and ``_reset`` of its transform, with these two arguments, and on
    objects being allowed to have methods of their own in their ``__dict__``, where ``clone`` of a Compose leaves them.

    Args:
        chain: the outermost Compose.
        spared: types of transforms that do not rewrite observations; of subclasses nobody knows.
    """
    for method in ("_step", "_reset"):
        chain.__dict__[method] = _ReadingEarly(chain, method, spared)


class _ReadingEarly:
    """``Compose._step`` or ``_reset`` of one chain, with its early readers; it can be copied and pickled with it."""

    def __init__(self, chain: Compose, method: str, spared: tuple[type[Transform], ...]) -> None:
        self.chain, self.method, self.spared = chain, method, spared

    def __call__(self, tensordict: TensorDictBase, observed: TensorDictBase) -> TensorDictBase:
        chain = leaves(self.chain)
        waiting = [leaf for leaf in chain if isinstance(leaf, EarlyReader) and leaf.reads_early]
        for leaf in chain:
            if waiting and type(leaf) not in self.spared:
                for reader in waiting:
                    reader.read_raw(observed)
                waiting = []
            observed = getattr(leaf, self.method)(tensordict, observed)
        return observed
