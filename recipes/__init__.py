"""Entry points for demonstrations, maps, reinforcement learning, evaluation; they join ``nht`` and ``nht.envs``."""

from __future__ import annotations

from importlib.util import find_spec

_NEEDED = ("hydra", "imageio", "matplotlib", "omegaconf", "pandas", "PIL", "scipy", "tqdm", "yaml")


def _is_installed(module: str) -> bool:
    try:
        return find_spec(module) is not None
    except (ImportError, ValueError):
        return False


# Told here, by that name, it is one line also where Python runs a recipe with -m, and no traceback.
if _missing := [module for module in _NEEDED if not _is_installed(module)]:
    raise ModuleNotFoundError(
        f"the recipes need {', '.join(_missing)}: pip install 'nht[recipes]'.", name=__name__
    )
