"""The Python examples of the README and of docs/, run as they stand; what they quote is quoted right."""

import re
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]
PAGES = [ROOT / "README.md", *sorted((ROOT / "docs").glob("*.md"))]
EXAMPLES = {
    f"{page.name}-{number}": example
    for page in PAGES
    for number, example in enumerate(re.findall(r"```python\n(.*?)```", page.read_text(), re.DOTALL))
}


@pytest.mark.parametrize("name", EXAMPLES)
def test_example_runs(name, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    exec(compile(EXAMPLES[name], name, "exec"), {"__name__": "readme"})


def test_there_are_examples():
    assert len(EXAMPLES) >= 2


def test_a_package_of_ones_own_is_quoted_as_it_is():
    readme, package = (ROOT / "README.md").read_text(), ROOT / "tests" / "outside"
    assert (package / "six_joints" / "two_sided.py").read_text() in readme
    (quoted,) = re.findall(r"```toml\n(.*?)```", readme, re.DOTALL)
    assert quoted in (package / "pyproject.toml").read_text()


def test_links_lead_somewhere():
    for page in PAGES:
        for link in re.findall(r"\]\(([^)#]+)(?:#[^)]*)?\)", page.read_text()):
            assert link.startswith("https://") or (page.parent / link).exists(), f"{page.name}: {link}"
