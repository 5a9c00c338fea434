"""The text of a recipe's ``--help``: its choices, and its settings with their values and meanings."""

from __future__ import annotations

import ast
import inspect
import textwrap
import tokenize
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import fields
from io import StringIO
from typing import Any

import yaml

from nht.recipes.overrides import LIST_RULE, section

WIDTH = 110
INDENT = 13


def help_text(
    about: str, recipe: str, schema: type[Any], values: Mapping[str, Any], groups: Mapping[str, Sequence[str]]
) -> str:
    """The help text of a recipe.

    Args:
        about: what the recipe does.
        recipe: its name.
        schema: the dataclass of its settings.
        values: of the settings, by name; those of sections are nested.
        groups: the choices of each group.
    """
    lines = [about.strip(), "", f"python -m nht.recipes.{recipe} [choice or setting=value ...]"]
    if groups:
        lines += ["", "Choices, each of which sets a whole group of settings:", ""]
    for group, names in groups.items():
        start = f"  {group}=".ljust(INDENT)
        lines += textwrap.wrap(
            ", ".join(names), WIDTH, initial_indent=start, subsequent_indent=" " * INDENT
        ) or [start]
    lines += ["", "Settings with the values they have now, those of choices on this command line included:"]
    own = {entry.name: values[entry.name] for entry in fields(schema) if section(entry) is None}
    if own:
        lines += ["", *_settings("", schema, own)]
    for entry in fields(schema):
        if (kind := section(entry)) is not None:
            summary = (kind.__doc__ or "").strip().splitlines()[0]
            lines += ["", f"{entry.name}: {summary}", *_settings(f"{entry.name}.", kind, values[entry.name])]
    return "\n".join([*lines, "", *_rules(recipe)])


def _rules(recipe: str) -> list[str]:
    rules = [
        "Text and paths need no quotes but the shell's; ~ begins a path in your home; null is none.",
        LIST_RULE,
        f"One process makes one run: for seed in 0 1 2; do python -m nht.recipes.{recipe} seed=$seed; done.",
        "HYDRA_FULL_ERROR=1 shows where in the code an error comes from.",
    ]
    return [line for rule in rules for line in textwrap.wrap(rule, WIDTH)]


def _settings(prefix: str, schema: type[Any], values: Mapping[str, Any]) -> Iterator[str]:
    """One line per setting: name, value, meaning."""
    found = meanings(schema)
    sections = {entry.name: section(entry) for entry in fields(schema)}
    for name, value in values.items():
        if (kind := sections.get(name)) is not None:
            yield from _settings(f"{prefix}{name}.", kind, value)
            continue
        setting = f"  {prefix}{name}={as_typed(value)}"
        meaning = found.get(name, "")
        if len(setting) > 44 and meaning:
            yield setting
            setting = ""
        yield f"{setting:<44}  # {meaning}" if meaning else setting


def as_typed(value: Any) -> str:
    """A value as the command line takes it, on one line."""
    if isinstance(value, str):
        return value
    text = yaml.safe_dump(value, default_flow_style=True, sort_keys=False, width=10_000)
    return text.removesuffix("\n").removesuffix("\n...")


def meanings(schema: type[Any]) -> dict[str, str]:
    """The meaning of each field of a dataclass, by name: the comment behind or above it in the source.

    A field without a comment has the meaning of the base class.
    """
    found: dict[str, str] = {}
    for kind in reversed(schema.__mro__):
        try:
            source = textwrap.dedent(inspect.getsource(kind))
        except (OSError, TypeError):  # built in, or made without a file
            continue
        comments = {
            token.start[0]: token.string.lstrip("# ")
            for token in tokenize.generate_tokens(StringIO(source).readline)
            if token.type == tokenize.COMMENT
        }
        lines = source.splitlines()
        for node in ast.parse(source).body[0].body:  # type: ignore[attr-defined]
            if not isinstance(node, ast.AnnAssign) or not isinstance(node.target, ast.Name):
                continue
            above = node.lineno - 1
            places = [*range(node.lineno, (node.end_lineno or node.lineno) + 1)]
            if lines[above - 1].lstrip().startswith("#"):
                places.append(above)
            said = [comments[place] for place in places if place in comments]
            if said:
                found[node.target.id] = said[0]
    return found
