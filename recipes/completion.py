"""What a shell completes after ``nht``: recipes, groups of settings with their choices, and single settings.

Everything is read from source files and the names of YAML files: nothing is imported, so that it takes no time.
"""

from __future__ import annotations

import ast
import re
from collections.abc import Iterator, Sequence
from functools import cache
from pathlib import Path

RECIPES = Path(__file__).parent
SHELLS = ("bash", "zsh", "fish")
SCHEMA = re.compile(r"^    launch\(main, (\w+)", re.M)
"""Where a recipe says which dataclass its settings are."""

SCRIPTS = {
    "bash": r"""_nht() {
    local line="${COMP_LINE:0:COMP_POINT}" current start
    local -a words
    read -ra words <<<"$line"
    [[ $line == *" " ]] && words+=("")
    current="${words[-1]}"
    mapfile -t COMPREPLY < <(nht __complete "${words[@]:1}")
    if [[ $current == *=* ]]; then  # bash begins a new word there
        start="${current%"${current##*=}"}"
        COMPREPLY=("${COMPREPLY[@]#"$start"}")
    fi
    [[ ${#COMPREPLY[@]} == 1 && ${COMPREPLY[0]} == *[=.] ]] && compopt -o nospace
    return 0
}
complete -o default -F _nht nht""",
    "zsh": r"""_nht() {
    local -a found
    found=("${(@f)$(nht __complete "${(@)words[2,CURRENT]}")}")
    compadd -Q -S '' -- ${(M)found:#*[=.]}
    compadd -Q -- ${found:#*[=.]}
    [[ -n ${found[1]} ]] || _files
}
compdef _nht nht""",
    "fish": r"""complete -c nht -f -a '(nht __complete (commandline -opc)[2..] (commandline -ct))'""",
}
"""For each shell, the script that asks ``nht __complete WORDS`` for candidates."""


def candidates(words: Sequence[str], recipes: Sequence[str]) -> list[str]:
    """What the last of ``words`` may become.

    Args:
        words: of the command line behind ``nht``; the last one is being typed, and may be empty.
        recipes: names of all recipes.
    """
    *before, current = words
    if not before:
        known = [*recipes, "completion"]
    elif before[0] == "completion":
        known = list(SHELLS)
    else:
        given = {word.partition("=")[0] for word in before[1:]}
        known = [word for word in _settings_of(before[0]) if word.partition("=")[0] not in given]
    if "=" in current:
        known = [word for word in known if not word.endswith("=")]
    else:
        known = list(dict.fromkeys(word[: word.index("=") + 1] if "=" in word else word for word in known))
    return sorted(word for word in known if word.startswith(current))


def _settings_of(recipe: str) -> Iterator[str]:
    """``name=`` for each setting of a recipe, and ``name=value`` for values that are known."""
    file = RECIPES / f"{recipe}.py"
    schema = SCHEMA.search(file.read_text()) if file.exists() else None
    if schema is None:
        return
    yield "--help"
    for name, kind in _fields(schema[1]).items():
        yield from _setting(name, kind)
        for choice in _choices(name):
            if name != "algo" or choice == recipe or choice.startswith(f"{recipe}_"):
                yield f"{name}={choice}"


def _setting(name: str, kind: str) -> Iterator[str]:
    if kind in _dataclasses():
        for inner, its_kind in _fields(kind).items():
            yield from _setting(f"{name}.{inner}", its_kind)
        return
    yield f"{name}="
    if kind == "bool":
        yield from (f"{name}=true", f"{name}=false")


@cache
def _dataclasses() -> dict[str, ast.ClassDef]:
    """The classes that settings are made of, by name."""
    files = [RECIPES / "sections.py", RECIPES / "config.py", *sorted((RECIPES / "agents").glob("*.py"))]
    trees = [ast.parse(file.read_text()) for file in files]
    return {
        node.name: node
        for tree in trees
        for node in tree.body
        if isinstance(node, ast.ClassDef) and any(ast.unparse(d) == "dataclass" for d in node.decorator_list)
    }


def _fields(name: str) -> dict[str, str]:
    """The settings in a class, those that it inherits included, with their annotated types."""
    node = _dataclasses().get(name)
    if node is None:
        return {}
    found: dict[str, str] = {}
    for base in node.bases:
        found |= _fields(ast.unparse(base))
    for line in node.body:
        if isinstance(line, ast.AnnAssign) and not ast.unparse(line.annotation).startswith("ClassVar"):
            found[ast.unparse(line.target)] = ast.unparse(line.annotation)
    return found


def _choices(group: str) -> list[str]:
    """The choices of a group of settings: the YAML files in the folder of that name."""
    folder = (
        RECIPES.parent / "configs" / group
    )  # beside the recipes, in a checkout as where they are installed
    return sorted(
        file.stem for file in folder.glob("*.yaml") if file.stem != "named"
    )  # that is not for people
