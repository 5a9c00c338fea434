"""The Python examples of the README and of docs/, run as they stand; what they quote is quoted right."""

from __future__ import annotations

import ast
import importlib
import inspect
import re

import pytest

from shell_commands import PAGES, ROOT, blocks, name_of

EXAMPLES = {
    f"{name_of(page)}-{number}": example
    for page in PAGES
    for number, example in enumerate(blocks(page, "python"))
}
# A line or two out of context: names that are there, or a quotation.
FRAGMENTS = [(name_of(page), fragment) for page in PAGES for fragment in blocks(page, "py")]
OUTSIDE = ROOT / "tests" / "outside"


@pytest.mark.parametrize("name", EXAMPLES)
def test_example_runs(name, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    exec(compile(EXAMPLES[name], name, "exec"), {"__name__": "readme"})


def test_there_are_examples():
    assert len(EXAMPLES) >= 12


def test_a_package_of_ones_own_is_quoted_as_it_is():
    quoted = [block for page in PAGES for block in blocks(page, "toml")]
    assert quoted
    declared = (OUTSIDE / "pyproject.toml").read_text()
    assert all(block in declared for block in quoted)
    assert (OUTSIDE / "six_joints" / "two_sided.py").read_text() in EXAMPLES.values()


@pytest.mark.parametrize(("page", "fragment"), FRAGMENTS)
def test_a_fragment_is_a_quotation_or_names_what_is_there(page, fragment):
    if any(fragment in file.read_text() for file in OUTSIDE.rglob("*.py")):
        return
    calls = [node for node in ast.walk(ast.parse(fragment)) if isinstance(node, ast.Call)]
    assert calls
    for call in calls:
        called = resolved(ast.unparse(call.func))
        taken = inspect.signature(called).parameters
        assert {word.arg for word in call.keywords} <= set(taken) or any(
            each.kind is each.VAR_KEYWORD for each in taken.values()
        )


def resolved(name: str) -> object:
    """What a dotted name stands for."""
    module, *attributes = name.split(".")
    found = pytest.importorskip(module)
    for attribute in attributes:
        if not hasattr(found, attribute):
            importlib.import_module(f"{found.__name__}.{attribute}")
        found = getattr(found, attribute)
    return found


# Links within docs/ are checked, with their anchors, when the site is built.
@pytest.mark.parametrize("page", [*PAGES, ROOT / "benchmarks" / "README.md"], ids=name_of)
def test_links_lead_somewhere(page):
    text = re.sub(r"^```.*?^```|`[^`\n]*`", "", page.read_text(), flags=re.DOTALL | re.MULTILINE)
    for link in re.findall(r"\]\(([^)#\s]+)(?:#[^)]*)?\)", text):
        target = page.parent / link
        # A notebook is a page of the site under another name.
        assert link.startswith("https://") or target.exists() or target.with_suffix(".py").exists(), link


def test_the_readme_is_short():
    assert len((ROOT / "README.md").read_text().splitlines()) <= 130
