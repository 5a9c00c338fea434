"""One dialect in the package: errors and docstrings end in a full stop, annotations are postponed."""

from __future__ import annotations

import ast
import builtins
import re
import tomllib
from collections.abc import Iterator
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]
FOLDERS = tomllib.loads((ROOT / "pyproject.toml").read_text())["tool"]["setuptools"]["package-dir"].values()
TREES = {
    str(file.relative_to(ROOT)): ast.parse(file.read_text())
    for folder in ("nht", "transforms", "envs", "recipes")
    for file in sorted((ROOT / folder).rglob("*.py"))
}
QUOTED = {"{diverged(self.members[0].path)}"}  # the whole sentence of an error, as a file keeps it
OF_SYSTEM = {"OSError"}  # built from a number and a sentence


def test_all_folders_of_the_package_are_read():
    assert set(FOLDERS) - {"configs"} <= {str(Path(file).parent) for file in TREES}


def test_errors_end_in_a_full_stop():
    wrong = [f"{file}:{line}: {end}" for file, tree in TREES.items() for line, end in unfinished_errors(tree)]
    assert not wrong, "\n".join(wrong)


@pytest.mark.parametrize(
    "source",
    [
        'raise ValueError("no number")',
        'raise ValueError(f"no number: {text}")',
        'raise KeyError("a " "b")',
        'raise ValueError("a." if few else "b")',
        'raise OSError(errno.ENOSPC, "no room")',
        'raise type(error)(f"{file}: {text}") from error',
        'return FloatingPointError(f"{name} diverged")',
    ],
)
def test_an_error_without_a_full_stop_is_noticed(source):
    assert len(list(unfinished_errors(ast.parse(source)))) == 1


@pytest.mark.parametrize(
    "source", ['raise ValueError(f"no {x}.")', "raise ValueError(message)", 'raise OSError(1, "no room.")']
)
def test_a_finished_error_passes(source):
    assert not list(unfinished_errors(ast.parse(source)))


def test_docstrings_end_in_a_full_stop():
    found = [(f"{file}:{node.name}", text) for file, node, text in docstrings(ast.ClassDef | ast.FunctionDef)]
    assert len(found) > 1000
    assert [name for name, text in found if not text.endswith((".", ".``", "```"))] == []


def test_code_in_docstrings_stands_in_double_backticks():
    nodes = ast.Module | ast.ClassDef | ast.FunctionDef
    single = re.compile(r"(?<!`)`(?!`)")
    assert [
        file for file, _, text in docstrings(nodes) if single.search(re.sub(r"``.*?``", "", text, flags=re.S))
    ] == []


def test_annotations_are_postponed_everywhere():
    first = "from __future__ import annotations"
    holding = {file: tree for file, tree in TREES.items() if len(tree.body) > 1}
    assert [file for file, tree in holding.items() if ast.unparse(tree.body[1]) != first] == []


def unfinished_errors(tree: ast.AST) -> Iterator[tuple[int, str]]:
    """Line and end of the sentences given to an error, raised or made, that do not end in a full stop."""
    for node in ast.walk(tree):
        if isinstance(node, ast.Call) and node.args and is_error(node.func):
            sentence = node.args[-1] if ast.unparse(node.func) in OF_SYSTEM else node.args[0]
            yield from (
                (node.lineno, end) for end in ends(sentence) if not end.endswith(".") and end not in QUOTED
            )


def is_error(called: ast.expr) -> bool:
    """Whether a call makes an error: one of Python's own, or one of the type of another (``type(error)(...)``)."""
    name = ast.unparse(called)
    known = getattr(builtins, name, None)
    return (
        name == "type(error)"
        or name.endswith("Error")
        or (isinstance(known, type) and issubclass(known, Exception))
    )


def ends(sentence: ast.expr) -> Iterator[str]:
    """What a literal text ends in: each of them where there is a choice; nothing for other expressions."""
    match sentence:
        case ast.Constant(str(text)):
            yield text
        case ast.JoinedStr(values=[*_, ast.Constant(str(text))]):
            yield text
        case ast.JoinedStr(values=[*_, ast.FormattedValue() as value]):
            yield f"{{{ast.unparse(value.value)}}}"
        case ast.IfExp(body=body, orelse=other):
            yield from ends(body)
            yield from ends(other)
        case ast.BinOp(right=right):
            yield from ends(right)


def docstrings(kinds: type) -> Iterator[tuple[str, ast.AST, str]]:
    """File, node and text of each docstring."""
    for file, tree in TREES.items():
        for node in ast.walk(tree):
            if isinstance(node, kinds) and (text := ast.get_docstring(node)):
                yield file, node, text
