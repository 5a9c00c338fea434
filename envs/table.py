"""Tables that anybody can add to: records found by name, by import path, or through an installed package."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from functools import cache
from importlib import import_module
from importlib.metadata import EntryPoint, entry_points
from typing import Any, TypeVar

Listed = TypeVar("Listed")


@cache
def installed(group: str) -> dict[str, EntryPoint]:
    """The entry points of installed packages by name; cached, as finding them reads the files of all packages."""
    return {found.name: found for found in entry_points(group=group)}


class Table(Mapping[str, Listed]):
    """Records by name: ours, and those of installed packages.

    A name is looked up, in this order, among our own, among the entry points that installed packages declare, and as an
    import path such as ``"my_package.tasks:POUR"``. A record is imported only when it is looked up, so that a table
    costs nothing, and every process finds the same by the same name.

    Args:
        group: of the entry points, e.g. ``"nht.tasks"``.
        own: our records, or their import paths, ``"module:attribute"``.
        adopt: makes a record of what was found under a name; raises TypeError for what cannot become one.
    """

    def __init__(
        self, group: str, own: Mapping[str, Listed | str], adopt: Callable[[str, Any], Listed]
    ) -> None:
        self.group = group
        self._own = dict(own)
        self._adopt = adopt
        self._known: dict[str, Listed] = {}

    def __getitem__(self, name: str) -> Listed:
        """The record of that name.

        Raises:
            KeyError: if there is none; the message lists the names that exist.
            ImportError: if its module cannot be imported.
            TypeError: if what is found there is no such record.
        """
        if name not in self._known:
            self._known[name] = self._adopt(name, self._find(name))
        return self._known[name]

    def _find(self, name: str) -> Any:
        if name in self._own:
            place = self._own[name]
            return imported(place) if isinstance(place, str) else place
        if name in (installed := self._installed()):
            return installed[name].load()
        if ":" in name:
            return imported(name)
        raise KeyError(
            f"there is no {name!r} in the table {self.group}: choose from {sorted(self)}, or name an import path, "
            "package.module:attribute."
        )

    def own(self, name: str) -> Listed | None:
        """Our record of that name, if it is one of ours; nothing is imported for it."""
        found = self._own.get(name)
        return None if isinstance(found, str) else found

    def _installed(self) -> dict[str, EntryPoint]:
        return installed(self.group)

    def __iter__(self) -> Iterator[str]:
        """All names, ours first; import paths are not listed."""
        return iter(dict.fromkeys([*self._own, *sorted(self._installed())]))

    def __len__(self) -> int:
        return len(list(iter(self)))

    def __contains__(self, name: object) -> bool:
        """Whether a record may be looked up by this name; an import path counts without being tried."""
        return isinstance(name, str) and (":" in name or name in list(self))


def imported(place: str) -> Any:
    """The object at an import path, ``"module:attribute"``.

    Raises:
        ImportError: if there is no such module, or nothing of that name in it.
    """
    module, _, attribute = place.partition(":")
    found: Any = import_module(module)
    for part in attribute.split("."):
        if not hasattr(found, part):
            raise ImportError(f"{module} has no {attribute!r}, as in {place!r}.")
        found = getattr(found, part)
    return found
