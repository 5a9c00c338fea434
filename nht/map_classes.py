"""Finds the class that a map file names, by module and name, so that two classes of one name are not confused."""

from __future__ import annotations

import importlib
import inspect
import sys
from collections.abc import Iterator, Sequence

from nht.action_map import ActionMap
from nht.alignment import Aligned
from nht.jacobian import JacobianPinv
from nht.laser import CAE, LASER
from nht.maps import NHT, SVD, Identity
from nht.reading import shortened
from nht.residual import Residual
from nht.scl import SCL

OUR_CLASSES: dict[str, type[ActionMap]] = {
    kind.__name__: kind for kind in (NHT, SVD, Identity, SCL, CAE, LASER, JacobianPinv, Aligned, Residual)
}
PACKAGE = "nht"  # the module that files name for all of ours, wherever in the package they are defined


def identity(kind: type[ActionMap]) -> tuple[str, str]:
    """Module and qualified name, as they stand in a file."""
    if OUR_CLASSES.get(kind.__name__) is kind:
        return PACKAGE, kind.__name__
    return kind.__module__, kind.__qualname__


def find_class(module: str, name: str, allow: Sequence[str] = ()) -> type[ActionMap]:
    """The class that a file names. Nothing is imported but what the caller allows.

    Args:
        module: where it is defined, ``"nht"`` for ours.
        name: its qualified name.
        allow: modules and packages that may be imported to this end.

    Raises:
        ValueError: if its module is neither imported nor allowed, has no such action map, or has two.
    """
    if module == PACKAGE:
        if name not in OUR_CLASSES:
            raise ValueError(f"unknown class {name!r}; those of nht are {', '.join(sorted(OUR_CLASSES))}.")
        return OUR_CLASSES[name]
    found = _imported(module, name)
    if not found and module not in sys.modules:
        _import(module, name, allow)
        found = _imported(module, name)
    if not found:
        raise ValueError(f"the module {module!r} is imported, but has no action map {name!r}.")
    if len(found) > 1:
        raise ValueError(f"the module {module!r} has made {len(found)} classes {name!r}; it must have one.")
    return found[0]


def find_by_name(name: str) -> type[ActionMap]:
    """The class of a file of format version 1, which knows no modules: ours, or the only one that is imported.

    Raises:
        ValueError: if there is none, or more than one.
    """
    if name in OUR_CLASSES:
        return OUR_CLASSES[name]
    found = [kind for kind in _concrete() if kind.__name__ == name]
    if not found:
        known = ", ".join(sorted({*OUR_CLASSES, *(kind.__name__ for kind in _concrete())}))
        raise ValueError(
            f"unknown class {name!r}; known are {known}. Import a class of your own before loading its map."
        )
    if len(found) > 1:
        places = ", ".join(sorted({kind.__module__ for kind in found}))
        raise ValueError(
            f"the file is of an old format, and {len(found)} classes are called {name!r}: in {places}."
        )
    return found[0]


def _imported(module: str, name: str) -> list[type[ActionMap]]:
    """The classes of this module and name: the one that the module holds now, else all that it ever defined."""
    found = [kind for kind in _concrete() if (kind.__module__, kind.__qualname__) == (module, name)]
    current: object = sys.modules.get(module)
    for part in name.split("."):
        current = getattr(current, part, None)
    return [kind for kind in found if kind is current] or found


def _import(module: str, name: str, allow: Sequence[str]) -> None:
    allowed = (allow,) if isinstance(allow, str) else tuple(allow)
    if not any(module == one or module.startswith(f"{one}.") for one in allowed):
        package = module.partition(".")[0]
        raise ValueError(
            f"its class {name!r} is in the module {module!r}, which is not imported: import it before loading; or, "
            f"if you trust what runs when it is imported, allow that: load_map(..., allow=({package!r},))."
        )
    try:
        importlib.import_module(module)
    except Exception as error:  # a module may raise anything
        reason = shortened(f"{type(error).__name__}: {error}")
        raise ValueError(f"its class {name!r} needs the module {module!r}: {reason}.") from error


def _concrete() -> Iterator[type[ActionMap]]:
    """All action maps that can be constructed, of all modules imported so far."""
    return (kind for kind in dict.fromkeys(_subclasses(ActionMap)) if not inspect.isabstract(kind))


def _subclasses(parent: type) -> Iterator[type]:
    child: type
    for child in parent.__subclasses__():
        yield child
        yield from _subclasses(child)
