"""A term means one thing: a public name of the package is defined in one module."""

from __future__ import annotations

import ast
from collections import defaultdict
from pathlib import Path

ROOT = Path(__file__).parents[2]
SHARED = {
    "ALGORITHM": "each algorithm's record",
    "networks": "each algorithm's networks",
    "policy": "each algorithm's policy",
    "main": "each entry point's function",
    "descend": "a gradient step, of one loss or of several",
    "Config": "a recipe's dataclass, as a type variable",
    "Flags": "arrays of bool, in packages that do not import each other",
    "Range": "smallest and largest value, in packages that do not import each other",
}


def test_a_public_name_is_defined_in_one_module():
    found = defaultdict(set)
    for folder in ("nht", "transforms", "envs", "recipes"):
        for file in sorted((ROOT / folder).rglob("*.py")):
            for name in defined(ast.parse(file.read_text())):
                found[name].add(str(file.relative_to(ROOT)))
    several = {name: files for name, files in found.items() if len(files) > 1}
    assert several.keys() - SHARED == set(), {name: several[name] for name in several.keys() - SHARED}
    assert several.keys() >= SHARED.keys()  # no exception outlives its reason


def defined(tree: ast.Module) -> set[str]:
    """Public functions, classes and values of a module, those that it imports left out."""
    names = set()
    for node in tree.body:
        match node:
            case ast.FunctionDef(name=name) | ast.ClassDef(name=name):
                names.add(name)
            case ast.AnnAssign(target=ast.Name(id=name)):
                names.add(name)
            case ast.Assign(targets=targets):
                names |= {target.id for target in targets if isinstance(target, ast.Name)}
    return {name for name in names if not name.startswith("_")}
