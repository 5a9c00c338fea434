"""A generator of random numbers for each of several learners, behind calls that draw for all of them."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from typing import Any

import torch
from torch import Generator, Tensor
from torch.overrides import TorchFunctionMode

IN_PLACE: dict[Callable[..., Any], str] = {Tensor.normal_: "normal_", Tensor.uniform_: "uniform_"}
FRESH: dict[Callable[..., Any], str] = {torch.randn: "normal_", torch.rand: "uniform_"}
LIKE: dict[Callable[..., Any], str] = {torch.randn_like: "normal_", torch.rand_like: "uniform_"}
OTHERS = {
    torch.bernoulli,
    torch.multinomial,
    torch.normal,
    torch.poisson,
    torch.randint,
    torch.randint_like,
    torch.randperm,
    Tensor.bernoulli_,
    Tensor.cauchy_,
    Tensor.exponential_,
    Tensor.geometric_,
    Tensor.log_normal_,
    Tensor.multinomial,
    Tensor.random_,
}
"""Functions that draw for all learners at once, which would make one learner depend on the others."""


class Draws:
    """The generators of several learners: what one draws does not depend on the others.

    On a CPU it is what it would draw alone. On a GPU, where every draw is a call that takes longer than its numbers,
    tensors of one kind are drawn ``ahead`` of time, many at once.

    Args:
        seeds: one for each learner.
        device: of the tensors drawn.
        ahead: how many tensors of one kind a learner draws at once; by default 1 on a CPU and 64 elsewhere.
    """

    def __init__(self, seeds: Sequence[int], device: torch.device, ahead: int | None = None) -> None:
        self.generators = [Generator(device).manual_seed(seed) for seed in seeds]
        self._torch: Any = torch if device.type == "cpu" else torch.cuda  # who draws when nobody is named
        self._stock = Stock(self.generators, ahead or (1 if device.type == "cpu" else 64))

    @contextmanager
    def of(self, learner: int) -> Iterator[None]:
        """Within, torch itself draws from the generator of one learner."""
        generator, before = self.generators[learner], self._torch.get_rng_state()
        self._torch.set_rng_state(generator.get_state())
        try:
            yield
        finally:
            generator.set_state(self._torch.get_rng_state())
            self._torch.set_rng_state(before)

    @contextmanager
    def for_all(self) -> Iterator[None]:
        """Within, normal and uniform tensors ``(L, ...)`` are drawn learner by learner, each from its own generator.

        Raises:
            RuntimeError: there, for a draw that has no part for each learner; at the end, if something drew from torch
                itself all the same, unseen within a function of torch's.
        """
        before = self._torch.get_rng_state()
        with _LearnerByLearner(self._stock):
            yield
        if not torch.equal(self._torch.get_rng_state(), before):
            raise RuntimeError(
                "something drew from torch's own generator for all learners together: they would not be independent."
            )

    def integers(self, high: int, counts: Sequence[int]) -> list[Tensor]:
        """For each learner its count of random integers below ``high``."""
        return [
            torch.randint(0, high, (count,), generator=generator, device=generator.device)
            for count, generator in zip(counts, self.generators, strict=True)
        ]

    def orders(self, size: int) -> Tensor:
        """For each learner the numbers 0 ... size - 1 in a random order, ``(L, size)``."""
        return torch.stack(
            [
                torch.randperm(size, generator=generator, device=generator.device)
                for generator in self.generators
            ]
        )

    def state_dict(self) -> dict[str, Any]:
        """The generators' states, ``(L, bytes)``, and what is drawn ahead, if anything."""
        states = {"states": torch.stack([generator.get_state() for generator in self.generators])}
        return states | ({"ahead": ahead} if (ahead := self._stock.state_dict()) else {})

    def load_state_dict(self, saved: Mapping[str, Any]) -> None:
        """Go on drawing from ``saved``."""
        for generator, state in zip(self.generators, saved["states"], strict=True):
            generator.set_state(state.to("cpu", copy=True))
        self._stock.load_state_dict(saved.get("ahead", {}))


class Stock:
    """Random tensors of several learners, drawn ahead of time by kind: a shape, a distribution and its arguments.

    Args:
        generators: one for each learner.
        ahead: how many of a kind are drawn at once.
    """

    def __init__(self, generators: Sequence[Generator], ahead: int) -> None:
        self.generators, self._ahead = generators, ahead
        self._drawn: dict[str, Tensor] = {}  # by kind, (L, ahead, ...)
        self._used: dict[str, int] = {}

    def fill(self, values: Tensor, method: str, *args: Any, **kwargs: Any) -> None:
        """Fill ``(L, ...)`` with what the learners draw by this method of tensors."""
        if self._ahead == 1:
            self._draw(values, method, *args, **kwargs)
            return
        kind = f"{method} {tuple(values.shape[1:])} {values.dtype} {args} {kwargs}"
        if kind not in self._drawn or self._used[kind] == self._ahead:
            shape = len(values), self._ahead, *values.shape[1:]
            self._drawn[kind] = self._draw(values.new_empty(shape), method, *args, **kwargs)
            self._used[kind] = 0
        values.copy_(self._drawn[kind][:, self._used[kind]])
        self._used[kind] += 1

    def _draw(self, values: Tensor, method: str, *args: Any, **kwargs: Any) -> Tensor:
        for part, own in zip(values, self.generators, strict=True):
            getattr(part, method)(*args, generator=own, **kwargs)
        return values

    def state_dict(self) -> dict[str, Any]:
        """What is drawn and not used."""
        return {
            str(place): {"kind": kind, "used": used, "drawn": self._drawn[kind]}
            for place, (kind, used) in enumerate(self._used.items())
        }

    def load_state_dict(self, saved: Mapping[str, Any]) -> None:
        """Use up what ``saved`` has."""
        self._used = {each["kind"]: each["used"] for each in saved.values()}
        self._drawn = {each["kind"]: each["drawn"].to(self.generators[0].device) for each in saved.values()}


class _LearnerByLearner(TorchFunctionMode):
    def __init__(self, stock: Stock) -> None:
        super().__init__()
        self._stock = stock

    def __torch_function__(
        self,
        func: Callable[..., Any],
        types: Any,
        args: tuple[Any, ...] = (),
        kwargs: dict[str, Any] | None = None,
    ) -> Any:
        given = dict(kwargs or {})
        if given.get("generator") is not None:
            return func(*args, **given)  # one learner's own
        if func in IN_PLACE:
            return self._fill(IN_PLACE[func], *args, **given)
        if func in LIKE:
            return self._fill(LIKE[func], torch.empty_like(*args, **given))
        if func in FRESH:
            generator = given.pop("generator", None)
            return self._fill(FRESH[func], torch.empty(*args, **given), generator=generator)
        if func in OTHERS:
            raise RuntimeError(
                f"{func.__name__} draws for all learners together: they would not be independent."
            )
        return func(*args, **given)

    def _fill(
        self, method: str, values: Tensor, *args: Any, generator: Generator | None = None, **kwargs: Any
    ) -> Tensor:
        if generator is not None:  # whoever brings one knows whose it is
            filled: Tensor = getattr(values, method)(*args, generator=generator, **kwargs)
            return filled
        learners = len(self._stock.generators)
        if values.shape[:1] != (learners,):
            raise RuntimeError(
                f"{method} draws a tensor {tuple(values.shape)} for all learners together: the first dimension must be "
                f"that of the {learners} learners."
            )
        self._stock.fill(values, method, *args, **kwargs)
        return values
