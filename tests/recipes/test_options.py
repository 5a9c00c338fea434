"""Every option is read: a field of a configuration that no recipe looks at is a promise not kept.

The fields are watched while the recipes run, small; those that only some setting makes them look at are named.
"""

from collections import defaultdict
from dataclasses import fields, is_dataclass


class Reads:
    """Which fields of which dataclasses are read, while it watches."""

    def __init__(self, monkeypatch):
        self.found = defaultdict(set)
        self._patch = monkeypatch

    def watch(self, schema):
        for kind in {schema, *sections(schema)}:
            self._watch(kind)

    def _watch(self, kind):
        if "__getattribute__" in vars(kind):
            return
        found, names = self.found, {entry.name for entry in fields(kind)}

        def look(self, name):
            if name in names:
                found[kind.__name__].add(name)
            return object.__getattribute__(self, name)

        self._patch.setattr(kind, "__getattribute__", look, raising=False)

    def unread(self, schema):
        kinds = {schema, *sections(schema)}
        return {
            f"{kind.__name__}.{entry.name}"
            for kind in kinds
            for entry in fields(kind)
            if entry.name not in self.found[kind.__name__]
        }


def sections(schema):
    """The dataclasses in the fields of a dataclass."""
    made = [entry.default_factory() for entry in fields(schema) if callable(entry.default_factory)]
    return [type(value) for value in made if is_dataclass(value)]
