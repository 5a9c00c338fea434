"""From a command line of Hydra overrides to a checked dataclass."""

from __future__ import annotations

import sys
from collections.abc import Callable, Sequence
from dataclasses import fields, is_dataclass
from typing import Any, TypeVar, cast

from hydra import compose, initialize_config_module
from hydra.core.config_store import ConfigStore
from hydra.errors import HydraException
from omegaconf import DictConfig, OmegaConf
from omegaconf.errors import OmegaConfBaseException

Config = TypeVar("Config")


def launch(
    main: Callable[[Config], object], schema: type[Config], name: str, positional: str | None = None
) -> None:
    """Run ``main`` with the configuration that the command line asks for; say in one line what is wrong with it.

    Args:
        main: the recipe.
        schema: dataclass that ``main`` takes.
        name: YAML file under ``configs/`` that holds the recipe's values.
        positional: setting that a word without a key sets: ``PATH`` is short for ``positional=PATH``.
    """
    arguments = sys.argv[1:] if positional is None else [_keyed(word, positional) for word in sys.argv[1:]]
    if {"-h", "--help"} & set(arguments):
        print(f"{(schema.__doc__ or '').strip()}\n\nValues, each of which `key=value` overrides:\n")
        print(OmegaConf.to_yaml(_compose(schema, name, [])))
        return
    try:
        config = configure(schema, name, arguments)
    except ValueError as error:
        sys.exit(f"error: {error}")
    main(config)


def _keyed(word: str, positional: str) -> str:
    """A word of the command line as a Hydra override; quoted, for a path may hold any character."""
    if "=" in word or word.startswith("-"):
        return word
    return f"{positional}={_quoted(word)}"


def _quoted(text: str) -> str:
    escaped = text.replace("'", r"\'")
    return f"'{escaped}'"


def _as_text(schema: type[Any], word: str) -> str:
    """An override with its value quoted if it is text, as titles and paths are: these may hold commas and the like."""
    key, _, value = word.partition("=")
    is_text = any(entry.name == key and entry.type == "str" for entry in fields(schema))
    return word if not is_text or value[:1] in ("'", '"') else f"{key}={_quoted(value)}"


def configure(schema: type[Config], name: str, overrides: Sequence[str] = ()) -> Config:
    """The recipe's configuration with the overrides applied.

    Args:
        schema: dataclass of the recipe.
        name: YAML file under ``configs/``.
        overrides: Hydra overrides such as ``"map=svd"`` or ``"algo.gamma=0.99"``.

    Raises:
        ValueError: for an unknown key or choice, or a value of a wrong type; the message lists what exists.
    """
    if flags := [word for word in overrides if word.startswith("-")]:
        raise ValueError(
            f"unknown flag {flags[0]!r}: settings are written key=value. "
            "Hydra's multirun (-m) is not supported: start one process for each run."
        )
    try:
        texts = [_as_text(schema, word) for word in overrides]
        return cast(Config, OmegaConf.to_object(_compose(schema, name, texts)))
    except (HydraException, OmegaConfBaseException) as error:
        reason = str(error.__cause__ or error).splitlines()[0]
        raise ValueError(f"{str(error).splitlines()[0]} ({reason}){_existing(schema, error)}") from error


def _compose(schema: type[Any], name: str, overrides: Sequence[str]) -> DictConfig:
    ConfigStore.instance().store(name=f"{name}_schema", node=_opened(OmegaConf.structured(schema)))
    with initialize_config_module("nht.configs", version_base="1.3"):
        return compose(name, overrides=list(overrides))


def _opened(node: DictConfig) -> DictConfig:
    """Lets the dictionaries in it take new keys, which their readers check; dataclasses stay as they are."""
    for key in node:
        value = None if OmegaConf.is_missing(node, key) else node[key]
        if isinstance(value, DictConfig):
            if OmegaConf.get_type(value) is dict:
                OmegaConf.set_struct(value, False)
            _opened(value)
    return node


def _existing(schema: type[Any], error: Exception) -> str:
    """Names that exist where the error's key was looked for."""
    cause = error.__cause__ if isinstance(error.__cause__, OmegaConfBaseException) else error
    full_key = getattr(cause, "full_key", None)
    if not full_key:
        # The lines after the first list the choices of a config group, where that was the mistake.
        return " ".join(["", *str(error).splitlines()[1:]])
    node: Any = schema()
    for part in full_key.split(".")[:-1]:
        node = getattr(node, part, node)
    names = [entry.name for entry in fields(node)] if is_dataclass(node) else []
    return f". Keys here: {names}." if names else ""
