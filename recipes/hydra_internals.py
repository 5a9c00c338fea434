"""What the recipes rely on in Hydra beside its public interface; tests fail by name when an upgrade breaks one."""

from __future__ import annotations

from hydra.core.global_hydra import GlobalHydra
from hydra.errors import HydraException, OverrideParseException
from omegaconf.errors import OmegaConfBaseException


def choices(group: str) -> list[str]:
    """The YAML files of a group, ``""`` for the recipes' own, from Hydra's config loader while it is initialised."""
    return list(GlobalHydra.instance().config_loader().get_group_options(group))


def reason(error: HydraException | OmegaConfBaseException) -> str:
    """Why Hydra refused, in one line: the first line of its message, and that of the cause.

    A word that cannot be parsed, ``OverrideParseException.override``, is named instead of the grammar's rules.
    """
    if isinstance(error, OverrideParseException):
        return f"{error.override!r} cannot be read"
    first, cause = str(error).splitlines()[0], str(error.__cause__ or error).splitlines()[0]
    return first if first == cause else f"{first} ({cause})"


def unknown_key(error: HydraException | OmegaConfBaseException) -> str | None:
    """The dotted name that Hydra did not find: OmegaConf's ``full_key``."""
    cause = error.__cause__ if isinstance(error.__cause__, OmegaConfBaseException) else error
    return getattr(cause, "full_key", None) or None


def listed_choices(error: HydraException | OmegaConfBaseException) -> str:
    """The choices of a group, which Hydra lists after the first line if a choice was unknown."""
    return " ".join(["", *str(error).splitlines()[1:]])
