"""The site: its reference is whole, its errors are those of the code, and its numbers are those of the rows."""

from __future__ import annotations

import ast
import importlib.util
import re
import sys
from collections import Counter
from pathlib import Path
from types import SimpleNamespace

import pandas
import pytest
import yaml

import nht
import nht.envs
import nht.transforms

ROOT = Path(__file__).parents[2]
DOCS = ROOT / "docs"


def hook(name):
    """A file of docs/hooks as a module."""
    spec = importlib.util.spec_from_file_location(f"docs_{name}", DOCS / "hooks" / f"{name}.py")
    sys.modules[spec.name] = module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


@pytest.fixture(scope="module")
def rows():
    return hook("rows")


# The reference


@pytest.mark.parametrize("package", [nht, nht.transforms, nht.envs], ids=lambda package: package.__name__)
def test_every_public_name_is_in_the_reference_once(package):
    named = Counter(
        name
        for page in (DOCS / "reference").glob("*.md")
        for name in re.findall(r"^::: ([\w.]+)$", page.read_text(), re.MULTILINE)
    )
    assert {f"{package.__name__}.{name}" for name in package.__all__} <= set(named)
    assert [name for name, times in named.items() if times > 1] == []


def test_nothing_else_is_in_the_reference():
    public = {
        f"{package.__name__}.{name}"
        for package in (nht, nht.transforms, nht.envs)
        for name in package.__all__
    }
    for page in (DOCS / "reference").glob("*.md"):
        assert set(re.findall(r"^::: ([\w.]+)$", page.read_text(), re.MULTILINE)) <= public


def test_every_recipe_is_on_the_page_of_commands():
    recipes = {
        file.stem for file in (ROOT / "recipes").glob("*.py") if '__name__ == "__main__"' in file.read_text()
    }
    assert (
        set(re.findall(r"\{\{ help\((\w+)\) \}\}", (DOCS / "reference" / "commands.md").read_text()))
        == recipes
    )


def test_help_is_what_a_recipe_prints():
    assert "python -m nht.recipes.evaluate" in hook("commands").help_of("evaluate")


# Errors


def sentences():
    """Every text of the package and its scripts, with dots for what is filled in."""
    for folder in ("nht", "transforms", "envs", "recipes"):
        for file in (ROOT / folder).rglob("*.py"):
            for node in ast.walk(ast.parse(file.read_text())):
                if isinstance(node, ast.JoinedStr):
                    yield "".join(
                        str(part.value) if isinstance(part, ast.Constant) else "..." for part in node.values
                    )
                elif isinstance(node, ast.Constant) and isinstance(node.value, str):
                    yield node.value
    yield (ROOT / "Makefile").read_text()


def test_errors_on_the_page_are_those_of_the_code():
    page = (DOCS / "errors.md").read_text()
    terms = [
        term
        for line in re.findall(r"^(`.*)\n:   ", page, re.MULTILINE)
        for term in re.findall(r"`([^`]+)`", line)
    ]
    assert len(terms) > 30
    texts = list(sentences())
    for term in terms:
        pieces = [re.escape(piece.strip(" .")) for piece in term.split("...") if piece.strip(" .")]
        found = re.compile(".*?".join(pieces), re.DOTALL)
        assert any(found.search(text) for text in texts), term


# Rows


def test_a_table_shows_rows_as_they_are(rows):
    data = pandas.DataFrame({"map": ["nht", "svd"], "time [s]": [0.25, float("nan")]})
    assert rows.table(data, {"map": "{map}", "seconds": "{time [s]:.1f}"}) == (
        "| map | seconds |\n| --- | --- |\n| nht | 0.2 |\n| svd |  |\n"
    )


def test_a_summary_has_a_line_for_each_group(rows):
    data = pandas.DataFrame({"map": ["b", "a", "a"], "frames": [1, 1, 2], "score": [3.0, 1.0, 2.0]})
    cells = {
        "all": ("score", "", "{mean:.1f} ({min:.0f} .. {max:.0f})"),
        "late": ("score", "frames == 2", "{count}"),
    }
    assert rows.summary(data, {"map": "map"}, cells, order=["a"]) == (
        "| map | all | late |\n| --- | --- | --- |\n| a | 1.5 (1 .. 2) | 1 |\n| b | 3.0 (3 .. 3) | 0 |\n"
    )


def test_a_grid_has_a_column_for_each_value(rows):
    data = pandas.DataFrame({"map": ["a", "a", "b"], "k": [1, 2, 2], "error": [0.1, 0.2, 0.3]})
    assert rows.grid(data, {"map": "map"}, "k", "error", show="{mean:.1f}", heading="k = {}") == (
        "| map | k = 1 | k = 2 |\n| --- | --- | --- |\n| a | 0.1 | 0.2 |\n| b |  | 0.3 |\n"
    )


def test_what_is_not_there_is_an_error(rows):
    data = pandas.DataFrame({"map": ["a"]})
    with pytest.raises(ValueError, match="no row where"):
        rows.number(data, "map", where="map == 'b'")
    with pytest.raises(ValueError, match="has no rows"):
        rows.table(data, {"map": "{map}"}, where="map == 'b'")
    with pytest.raises(KeyError, match="score"):
        rows.table(data, {"map": "{score}"})
    with pytest.raises(FileNotFoundError):
        rows.rows("nowhere.csv")


def test_the_numbers_of_a_page_are_those_of_the_rows(rows):
    from jinja2 import Environment, StrictUndefined

    page = (DOCS / "results" / "wam_wipe.md").read_text()
    shown = Environment(undefined=StrictUndefined).from_string(page).render(rows.FUNCTIONS)
    curves = pandas.read_csv(ROOT / "benchmarks" / "results" / "wam_wipe" / "curves.csv")
    last = curves[(curves["interface"] == "svd") & (curves["frames"] == 300_000)]["eval_success"]
    assert f"{last.mean():.3f} ({last.min():.2f} .. {last.max():.2f})" in shown


# Notebooks


def test_a_notebook_becomes_a_page(tmp_path):
    notebooks = hook("notebooks")
    told = "# %% [markdown]\n# # Title\n#\n# Text.\n\n"
    printed, drawn = "print('two')\na + 1\n", "from matplotlib import pyplot\n_ = pyplot.plot([1])\n"
    source = f"{told}# %%\na = 2\n{printed}\n# %%\n{drawn}"
    text, figures = notebooks.as_page(source, "small")
    assert text.startswith("# Title\n\nText.\n\n```python\na = 2\n")
    assert "```text\ntwo\n3\n```" in text
    assert list(figures) == ["small-1.svg"]
    assert "![Figure 1](small-1.svg)" in text
    assert figures["small-1.svg"].startswith(b"<?xml")


def test_an_error_in_a_notebook_ends_the_build():
    with pytest.raises(ZeroDivisionError):
        hook("notebooks").as_page("# %%\n1 / 0\n", "broken")


# Pages


@pytest.mark.parametrize(
    ("written", "made"),
    [
        ("[`a`](../LICENSE)", "[`a`](files/LICENSE)"),
        (
            "![a](../benchmarks/results/wam_grasp/film.png)",
            "![a](files/benchmarks/results/wam_grasp/film.png)",
        ),
        ("[a](../CONTRIBUTING.md#versions)", "[a](contributing.md#versions)"),
        ("[a](../README.md)", "[a](index.md)"),
        ("[a](../pyproject.toml)", "[a](files/pyproject.toml.txt)"),
        ("[a](../tests/outside)", "a"),
        ("[a](../nowhere.md)", "a"),
        ("[a](errors.md#questions)", "[a](errors.md#questions)"),
        ("[a](https://mujoco.org)", "[a](https://mujoco.org)"),
        ("`[a](../LICENSE)`", "`[a](../LICENSE)`"),
        ("```sh\n[a](../LICENSE)\n```", "```sh\n[a](../LICENSE)\n```"),
    ],
)
def test_links_out_of_the_folder_lead_into_the_site(written, made, caplog, monkeypatch):
    from mkdocs.config import load_config
    from mkdocs.structure.files import File, Files

    page = SimpleNamespace(file=SimpleNamespace(abs_src_path=str(DOCS / "page.md"), src_uri="page.md"))
    config = load_config(str(ROOT / "mkdocs.yml"))
    links = hook("links")
    # MkDocs makes files only while it builds.
    monkeypatch.setattr(links.File, "generated", lambda _, place, **__: File(place, "docs", "site", False))
    assert links.on_page_markdown(written, page, config, Files([])) == made
    assert ("not in the repository" in caplog.text) == ("nowhere" in written)


def test_every_page_is_in_the_navigation():
    text = (ROOT / "mkdocs.yml").read_text()
    pages = {str(page.relative_to(DOCS)) for page in DOCS.rglob("*.md")}
    pages |= {str(page.relative_to(DOCS).with_suffix(".md")) for page in (DOCS / "notebooks").glob("*.py")}
    named = set(re.findall(r"[\w/]+\.md", text[text.index("nav:") : text.index("hooks:")]))
    assert pages <= named
    assert yaml.safe_load(text)["strict"] is True


def test_pictures_and_films_are_small():
    files = [file for file in (DOCS / "assets").rglob("*") if file.is_file()]
    assert max(file.stat().st_size for file in files) < 500_000
    assert sum(file.stat().st_size for file in files) < 4_000_000


def test_formulas_become_mathml():
    import markdown

    text = markdown.markdown(
        "An $n \\times k$ basis costs 5$ and 6$.\n\n$$u = Q(c)\\,a$$\n", extensions=[hook("maths").Maths()]
    )
    assert text.count("<math") == 2
    assert "5$ and 6$" in text
