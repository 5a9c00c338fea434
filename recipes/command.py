"""The command ``nht``: ``nht ddpg env=wam_wipe`` is ``python -m nht.recipes.ddpg env=wam_wipe``.

It imports neither torch nor Hydra, as the shell calls it for every completion.
"""

from __future__ import annotations

import os
import sys
from collections.abc import Sequence
from difflib import get_close_matches
from importlib.metadata import entry_points, version
from pathlib import Path

from nht.recipes.completion import SCRIPTS, candidates

FOLDER = Path(__file__).parent
RUNS_ITSELF = "if __name__ =="
COMPLETE = "__complete"
"""The word that the shell's script begins with to ask for candidates."""


def main() -> None:
    """Run what the command line names, in this process."""
    words = sys.argv[1:]
    if not words or words[0] in ("-h", "--help", "help"):
        print(about())
    elif words[0] == "--version":
        print(version("nht"))
    elif words[0] == "completion":
        print(completion_script(words[1:]))
    elif words[0] == COMPLETE:
        print("\n".join(candidates(words[1:] or [""], sorted({*recipes(), *others()}))))
    else:
        start(module_of(words[0]), words[1:])


def recipes() -> dict[str, str]:
    """Our recipes by name, and a sentence about each: the files of this folder that run by themselves."""
    found = {}
    for file in sorted(FOLDER.glob("*.py")):
        text = file.read_text()
        if f"\n{RUNS_ITSELF}" in text:
            found[file.stem] = text.partition("\n")[0].removeprefix("r").strip('"').replace("``", "")
    return found


def others() -> dict[str, str]:
    """The algorithms of installed packages by name, and where their records are."""
    return {found.name: found.value for found in entry_points(group="nht.algorithms")}


def module_of(name: str) -> str:
    """The module that a recipe runs as; of an installed package, the one that its record names."""
    if name in recipes():
        return f"nht.recipes.{name}"
    if name in others():
        from nht.recipes.agents.table import find_algorithm  # imports torch

        return find_algorithm(name).main.partition(":")[0]
    known = sorted({*recipes(), *others()})
    near = get_close_matches(name, known, n=1)
    meant = f" Did you mean {near[0]}?" if near else ""
    sys.exit(f"error: unknown recipe {name!r}: choose from {', '.join(known)}.{meant}")


def start(module: str, words: Sequence[str]) -> None:
    """Become ``python -m module``: signals, workers and launchers then find what they know."""
    os.execv(sys.executable, [sys.executable, "-m", module, *words])


def completion_script(words: Sequence[str]) -> str:
    """The script that makes a shell complete the command's words."""
    if len(words) != 1 or words[0] not in SCRIPTS:
        sys.exit(f"error: name a shell, one of {', '.join(SCRIPTS)}: nht completion bash.")
    return SCRIPTS[words[0]]


def about() -> str:
    """What the command does, and what there is."""
    width = max(map(len, [*recipes(), *others()]))
    lines = [f"  {name:<{width}}  {said}" for name, said in recipes().items()]
    lines += [f"  {name:<{width}}  of {where}" for name, where in others().items()]
    return "\n".join(
        [
            "nht RECIPE [choice or setting=value ...]      nht RECIPE --help says what can be set",
            "",
            *lines,
            "",
            'Completion: eval "$(nht completion bash)", or zsh; nht completion fish | source.',
            "Several processes: torchrun ... -m nht.recipes.RECIPE.",
        ]
    )
