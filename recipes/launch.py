"""From a command line of Hydra overrides to a checked dataclass."""

from __future__ import annotations

import os
import sys
import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import fields, is_dataclass
from importlib.metadata import entry_points
from pathlib import Path
from typing import Any, TypeVar, cast

from hydra import compose, initialize_config_module
from hydra.core.config_store import ConfigStore
from hydra.errors import HydraException
from omegaconf import DictConfig, OmegaConf
from omegaconf.errors import OmegaConfBaseException

from nht.envs import TASKS
from nht.envs.table import Table
from nht.recipes.agents.table import ALGORITHMS
from nht.recipes.help import help_text
from nht.recipes.hydra_internals import choices, listed_choices, reason, unknown_key
from nht.recipes.maps.kinds import KINDS
from nht.recipes.overrides import as_text, check_flags, check_single, keyed, quoted, rule_for, section
from nht.recipes.quiet import quiet_libraries
from nht.recipes.sections import Training

Config = TypeVar("Config")

NAMED: dict[str, Table[Any]] = {"env": TASKS, "map": KINDS}
"""Groups whose choices need no YAML: every name or import path of the table is a choice, too."""
EXPECTED = (ValueError, OSError, ImportError, KeyError, FloatingPointError, MemoryError, RuntimeError)
"""Errors whose message suffices; HYDRA_FULL_ERROR=1 shows their traceback."""

PATIENCE, TURN = 10.0, 2.0
"""Seconds that a process of torchrun waits with its error for that of the first, and more for each rank below it."""


def launch(
    main: Callable[[Config], object], schema: type[Config], name: str, positional: str | None = None
) -> None:
    """Run ``main`` with the configuration of the command line; print errors in it as one line.

    Args:
        main: the recipe.
        schema: dataclass that ``main`` takes.
        name: YAML file under ``configs/`` that holds the recipe's values; a recipe may do without.
        positional: setting that a word without a key sets: ``PATH`` is short for ``positional=PATH``.
    """
    quiet_libraries()
    try:
        words = sys.argv[1:]
        if positional is not None:
            words = [_keyed(word, positional, schema) for word in words]
        if {"-h", "--help"} & set(words):
            print(_help(main, schema, name, [word for word in words if word not in ("-h", "--help")]))
        else:
            main(configure(schema, name, words))
    except EXPECTED as error:
        if os.environ.get("HYDRA_FULL_ERROR") == "1":
            raise
        _let_others_speak(error)
        sys.exit(f"error: {_message(error)}")


def _let_others_speak(error: BaseException) -> None:
    """Wait, so that an error of all the processes that torchrun started is printed only once.

    torchrun ends all processes when the first has ended: one that is still alive after a while is the only one with the
    error. The loss of another process is not reported. Launchers that let the others live get one line from each.
    """
    size, rank = (
        int(os.environ.get(name, default)) for name, default in (("WORLD_SIZE", "1"), ("RANK", "0"))
    )
    if size > 1 and (rank > 0 or _lost_another(error)):
        time.sleep(PATIENCE + TURN * rank)


def _lost_another(error: BaseException) -> bool:
    return "gloo" in str(error) or type(error).__module__.startswith("torch.distributed")


def _message(error: BaseException) -> str:
    return str(error.args[0]) if isinstance(error, KeyError) and error.args else str(error)


def _keyed(word: str, positional: str, schema: type[Any] | None = None) -> str:
    """A word of the command line as a Hydra override; a word without a key sets ``positional``."""
    names = [entry.name for entry in fields(schema)] if schema is not None else []
    return keyed(word, positional, names, os.path.lexists(Path(word).expanduser()))


def configure(schema: type[Config], name: str, overrides: Sequence[str] = ()) -> Config:
    """The recipe's configuration with the overrides applied.

    Args:
        schema: dataclass of the recipe.
        name: YAML file under ``configs/``.
        overrides: Hydra overrides such as ``"map=svd"`` or ``"algo.gamma=0.99"``.

    Raises:
        ValueError: for an unknown key or choice, or a value of a wrong type; the message lists what exists.
    """
    composed = _told(schema, name, overrides)
    try:
        return cast(Config, _at_home(OmegaConf.to_object(composed)))
    except OmegaConfBaseException as error:
        raise _mistake(schema, error, overrides) from error


def _told(schema: type[Any], name: str, overrides: Sequence[str]) -> DictConfig:
    """The recipe's values with the overrides of the command line."""
    check_flags(overrides, name)
    texts = [as_text(schema, word) for word in _named(schema, overrides)]
    check_single(schema, texts, name)
    _check_algorithm(schema, overrides)
    try:
        return _compose(schema, name, texts)
    except (HydraException, OmegaConfBaseException) as error:
        raise _mistake(schema, error, texts) from error


def _mistake(
    schema: type[Any], error: HydraException | OmegaConfBaseException, words: Sequence[str]
) -> ValueError:
    rule = rule_for(error, words)
    text = f"{reason(error)}. {rule}" if rule else f"{reason(error)}{_existing(schema, error)}"
    return ValueError(f"{text.removesuffix('.')}.")


def _help(main: Callable[..., object], schema: type[Any], name: str, overrides: Sequence[str]) -> str:
    values = OmegaConf.to_container(_told(schema, name, overrides))
    about = sys.modules[main.__module__].__doc__ or main.__doc__ or ""
    return help_text(about, name, schema, cast(dict[str, Any], values), _choices(schema, name))


def _choices(schema: type[Any], name: str) -> dict[str, list[str]]:
    """The choices of each group of a recipe: our YAML files, and the names in the tables."""
    found: dict[str, list[str]] = {}
    with initialize_config_module("nht.configs", version_base="1.3"):
        for entry in fields(schema):
            if section(entry) is None or not (names := choices(entry.name)):
                continue
            known = set(names) - {"named"} | set(NAMED.get(entry.name, ()))
            if entry.name == "algo":
                known = {choice for choice in known if _owner(choice) in (None, name)}
            if not known:
                continue
            paths = ["or an import path, package.module:Name"] if entry.name in NAMED else []
            found[entry.name] = sorted(known) + paths
    return found


def _owner(choice: str) -> str | None:
    """The algorithm that a choice of ``algo`` belongs to: ``ddpg`` for ``ddpg_paper``."""
    return next((name for name in ALGORITHMS if choice == name or choice.startswith(f"{name}_")), None)


def _check_algorithm(schema: type[Any], overrides: Sequence[str]) -> None:
    """Raise ValueError for a choice of another recipe's algorithm, whose settings mean other things."""
    own = next((section(entry) for entry in fields(schema) if entry.name == "algo"), None)
    for word in overrides:
        key, _, choice = word.partition("=")
        if own is None or key != "algo" or (owner := _owner(choice)) is None:
            continue
        algorithm = ALGORITHMS[owner]
        theirs = next(section(entry) for entry in fields(algorithm.schema) if entry.name == "algo")
        if not issubclass(own, theirs):
            recipe = algorithm.main.partition(":")[0]
            raise ValueError(f"{word} is a choice of another recipe: python -m {recipe} {word}.")


def _named(schema: type[Any], overrides: Sequence[str]) -> Iterator[str]:
    """Overrides in which a choice without a YAML file of ours is replaced by its name in the table."""
    for word in overrides:
        key, _, value = word.partition("=")
        known = NAMED.get(key)
        if known is None or not any(entry.name == key for entry in fields(schema)):
            yield word
        elif value in known and not _has_yaml(key, value):
            if key == "env":
                yield "env=named"
            yield f"{key}.{'name' if key == 'env' else 'kind'}={quoted(value)}"
        else:
            yield word


def _has_yaml(group: str, choice: str) -> bool:
    with initialize_config_module("nht.configs", version_base="1.3"):
        return choice in choices(group)


def _at_home(config: Any) -> Any:
    """A configuration with ``~`` in its paths replaced by the user's home."""
    for entry in fields(config):
        value = getattr(config, entry.name)
        if is_dataclass(value):
            _at_home(value)
        elif entry.metadata.get("path"):
            at_home = [os.path.expanduser(path) for path in value] if isinstance(value, list) else value
            setattr(config, entry.name, os.path.expanduser(value) if isinstance(value, str) else at_home)
    return config


def _compose(schema: type[Any], name: str, overrides: Sequence[str]) -> DictConfig:
    store = ConfigStore.instance()
    store.store(name=f"{name}_schema", node=_opened(OmegaConf.structured(schema)))
    with initialize_config_module("nht.configs", version_base="1.3"):
        search = [f"pkg://{found.value}" for found in entry_points(group="nht.configs")]
        more = [f"hydra.searchpath=[{','.join(search)}]"] if search else []
        return compose(_primary(schema, name), overrides=[*more, *overrides])


def _primary(schema: type[Any], name: str) -> str:
    """The recipe's YAML file; for a recipe without one, the file that any training starts from."""
    if name in choices(""):
        return name
    groups: list[Any] = [f"{name}_schema"]
    if issubclass(schema, Training):
        groups += [{"env": "wam_wipe"}, {"map": "nht"}, {"collector": "single"}]
    node = {"defaults": [*groups, "_self_"]}
    if issubclass(schema, Training):
        node["run"] = {"folder": f"runs/{name}-${{env.name}}-${{map.kind}}-seed${{seed}}"}  # type: ignore[assignment]
    ConfigStore.instance().store(name=name, node=node)
    return name


def _opened(node: DictConfig) -> DictConfig:
    """Let dictionaries in the configuration take new keys, which their readers check; dataclasses stay closed."""
    for key in node:
        value = None if OmegaConf.is_missing(node, key) else node[key]
        if isinstance(value, DictConfig):
            if OmegaConf.get_type(value) is dict:
                OmegaConf.set_struct(value, False)
            _opened(value)
    return node


def _existing(schema: type[Any], error: HydraException | OmegaConfBaseException) -> str:
    """Names that exist where the error's key was looked for."""
    key = unknown_key(error)
    if key is None:
        return listed_choices(error)
    node: Any = schema  # never made: its own defaults may not go together, only those of its YAML do
    for part in key.split(".")[:-1]:
        node = next((kind for entry in fields(node) if entry.name == part and (kind := section(entry))), node)
    names = [entry.name for entry in fields(node)]
    return f". Keys here: {names}." if names else ""
