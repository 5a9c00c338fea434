"""Prepares words of the command line for Hydra's grammar: text may hold any character, and a word has one value."""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import fields, is_dataclass
from typing import Any

from hydra.core.override_parser.overrides_parser import OverridesParser
from hydra.errors import HydraException, OverrideParseException
from omegaconf.errors import GrammarParseError, InterpolationResolutionError, OmegaConfBaseException

QUOTED = re.compile(r"'(\\.|[^'\\])*'|\"(\\.|[^\"\\])*\"", re.DOTALL)
"""Text that is quoted in Hydra's way from its first character to its last."""

LIST_RULE = (
    "Text in a list or mapping that holds commas, brackets, = or quotes stands in quotes, and the word in the shell's: "
    "\"runs=['a [1','b, c']\"."
)
REFERENCE_RULE = (
    r"${...} names another setting, ${oc.env:HOME} a variable of the environment; \${ stands for these characters "
    "themselves."
)


def quoted(text: str) -> str:
    """``text`` quoted in Hydra's way, whatever it holds."""
    escaped = re.sub(r"(\\+)(?='|$)", r"\1\1", text).replace("'", r"\'")
    return f"'{escaped}'"


def keyed(word: str, positional: str, names: Sequence[str], is_path: bool) -> str:
    """A word of the command line as an override: a word without a key sets ``positional``.

    Args:
        word: as it was typed; a path may hold any character, an equals sign included.
        positional: setting that a word without a key sets.
        names: of the recipe's settings, which are the possible keys.
        is_path: whether a file or folder exists at the path that the word would be.
    """
    key, equals, _ = word.partition("=")
    looks_keyed = equals and re.fullmatch(r"[+~]{0,2}[A-Za-z_][\w./@]*", key) and "/" not in key
    if word.startswith("-") or (looks_keyed and (key.lstrip("+~").split(".")[0] in names or not is_path)):
        return word
    return f"{positional}={quoted(word)}"


def as_text(schema: type[Any], word: str) -> str:
    """An override whose value is quoted if it is text, as titles and paths are, or a plain list of texts."""
    key, equals, value = word.partition("=")
    if not equals or QUOTED.fullmatch(value):
        return word
    kind = type_of(schema, key.lstrip("+"))
    if kind in ("list[str]", "list[str] | None") and (texts := _listed(value)):
        return f"{key}=[{','.join(map(quoted, texts))}]"
    is_text = kind == "str" or (kind == "str | None" and value != "null")
    return f"{key}={quoted(value)}" if is_text else word


def _listed(value: str) -> list[str]:
    """The texts of a list, split at commas outside of brackets; none if it has quotes or unmatched brackets."""
    if not re.fullmatch(r"\[[^'\"\\]*\]", value, re.DOTALL) or not value[1:-1].strip():
        return []
    texts, open_brackets = [""], ""
    for letter in value[1:-1]:
        if letter == "," and not open_brackets:
            texts.append("")
            continue
        texts[-1] += letter
        if letter in "([{":
            open_brackets += ")]}"["([{".index(letter)]
        elif letter in ")]}":
            if not open_brackets.endswith(letter):
                return []
            open_brackets = open_brackets[:-1]
    return [] if open_brackets else [text.strip() for text in texts]


def type_of(schema: type[Any], key: str) -> str | None:
    """The annotation of the field at a dotted name, as text; None if there is no such field."""
    node: Any = schema
    *outer, last = key.split(".")
    for part in outer:
        node = next((section(entry) for entry in fields(node) if entry.name == part), None)
        if node is None:
            return None
    return next((str(entry.type) for entry in fields(node) if entry.name == last), None)


def section(entry: Any) -> Any:
    """The dataclass that a field holds, if it holds one."""
    made = entry.default_factory() if callable(entry.default_factory) else None
    return type(made) if is_dataclass(made) else None


def check_flags(words: Sequence[str], recipe: str) -> None:
    """Raise ValueError for a word that is a flag: the only flag is ``--help``."""
    for flag in (word for word in words if word.startswith("-")):
        if flag in ("-m", "--multirun"):
            raise ValueError(
                f"unknown flag {flag!r}: Hydra's multirun is not supported. Start one process for each run: "
                f"{_loop('seed', '0 1 2', recipe)}."
            )
        raise ValueError(f"unknown flag {flag!r}: settings are written key=value, and --help lists them.")


def check_single(schema: type[Any], words: Sequence[str], recipe: str) -> None:
    """Raise ValueError for an override that asks for several values, each a run of its own."""
    parser = OverridesParser.create()
    for word in words:
        try:
            if not parser.parse_override(word).is_sweep_override():
                continue
        except HydraException:
            continue  # whoever composes the configuration says what is wrong
        key, _, value = word.partition("=")
        plain = re.fullmatch(r"[\w.+-]+(,[\w.+-]+)+", value)
        if (type_of(schema, key.lstrip("+")) or "").startswith("list"):
            raise ValueError(f"{word}: a list is written {key}=[{value if plain else '...'}].")
        raise ValueError(
            f"{word} asks for several runs, and one process makes one: there are no sweeps. Start one for each, "
            f"{_loop(key, value.replace(',', ' ') if plain else '...', recipe)}, or let nht.recipes.search draw and "
            "run them."
        )


def _loop(key: str, values: str, recipe: str) -> str:
    name = re.split(r"[./]", key)[-1]
    return f"for {name} in {values}; do python -m nht.recipes.{recipe} {key}=${name}; done"


def rule_for(error: HydraException | OmegaConfBaseException, words: Sequence[str]) -> str:
    """A hint how to write what Hydra's grammar refused; empty for other errors."""
    kinds = (GrammarParseError, InterpolationResolutionError)
    if any("${" in word for word in words) and (
        isinstance(error, kinds) or isinstance(error.__cause__, kinds)
    ):
        return REFERENCE_RULE
    return LIST_RULE if isinstance(error, OverrideParseException) else ""
