"""Every command of the README and the pages: those that take seconds are run, on tiny budgets, the others composed."""

from __future__ import annotations

import os
import re
import shutil
import tomllib
from pathlib import Path
from typing import NamedTuple

import pytest
from torch.distributed.run import get_args_parser

import page_recipes
from shell_commands import PAGES, ROOT, commands, name_of

MODULES = {
    file.stem for file in (ROOT / "recipes").glob("*.py") if '__name__ == "__main__"' in file.read_text()
}


def starts_a_recipe(words: tuple[str, ...]) -> bool:
    """Whether a command is ``python -m``, torchrun, or ``nht`` with a recipe's name."""
    if words[0] == "nht":
        return words[1] in MODULES
    return words[0] in ("python", "torchrun") and "-m" in words


RECIPES = {
    page: [words for words in dict.fromkeys(commands(page)) if starts_a_recipe(words)] for page in PAGES
}
# Composed, not run, and why.
LONG = {
    "device=cuda": "needs a GPU",
    "torchrun": "starts several processes: tests/recipes/run/test_ranks.py does",
    "nht.recipes.steer": "serves a page until it is told to end: tests/recipes/live does",
    "nht.recipes.workspace": "writes to W&B's server",
    "nht.recipes.search": "starts Ray: the slow test below does",
    "collector=multi_sync": "starts processes: tests/recipes/run/test_collecting.py does",
    "compiled=true": "compiles for a minute: tests/nht/test_export.py does",
    "env=dm_control": "needs an extra that not every Python has: tests/envs does",
}
# Looked at, not started, and why.
LISTED = {
    "git": "fetches",
    "wandb": "sends",
    "ray": "starts a cluster",
    "nht": "prints: its own tests read it",
}


def recipe(words: tuple[str, ...]) -> tuple[str, list[str]]:
    """Module and overrides of a command that starts a recipe."""
    if words[0] == "python":
        return words[2], list(words[3:])
    if words[0] == "nht":
        return f"nht.recipes.{words[1]}", list(words[2:])
    told = get_args_parser().parse_args(list(words[1:]))
    assert told.module
    return told.training_script, told.training_script_args


def why_not_run(page: Path, words: tuple[str, ...]) -> str | None:
    """Why a recipe is only composed."""
    if "results" in page.parts:
        return "takes hours: it is how results were made"
    return next((why for mark, why in LONG.items() if mark in (*words, recipe(words)[0])), None)


class Place(NamedTuple):
    """Where commands are run, and which were, whatever their seed: each is run once, on whatever pages it stands."""

    folder: Path
    ran: set[tuple[str, ...]]


@pytest.fixture(scope="module")
def place(tmp_path_factory):
    """A folder with what the pages take for granted."""
    folder = tmp_path_factory.mktemp("user")
    before = Path.cwd()
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("MINARI_DATASETS_PATH", str(folder / "minari"))
        patch.setenv("WANDB_MODE", "disabled")
        patch.syspath_prepend(str(ROOT / "tests" / "outside"))
        os.symlink(ROOT / "benchmarks", folder / "benchmarks")
        os.chdir(folder)
        page_recipes.prepare(ROOT / "tests" / "outside")
        yield Place(folder, set())
        os.chdir(before)


@pytest.mark.parametrize("page", [page for page in PAGES if RECIPES[page]], ids=name_of)
def test_recipes_of_a_page(page, place, request, capsys):
    for words in RECIPES[page]:
        module, overrides = recipe(
            tuple(word.replace("/shared/", f"{place.folder}/shared/") for word in words)
        )
        same = tuple(word for word in words if not word.startswith("seed="))
        if why_not_run(page, words) or same in place.ran:
            page_recipes.compose(module, overrides)
            continue
        place.ran.add(same)
        if "video=true" in words:
            request.getfixturevalue("can_render")
        page_recipes.run(module, overrides)


@pytest.mark.slow
def test_the_smoke_search_of_the_pages_runs(place):
    page_recipes._start(
        "nht.recipes.search", ["search=smoke", f"folder={place.folder}/runs/smoke", "num_workers=1"]
    )
    assert (place.folder / "runs" / "smoke" / "rows.csv").exists()


@pytest.mark.parametrize("page", PAGES, ids=name_of)
def test_other_commands_of_a_page(page):
    for words in commands(page):
        if words not in RECIPES[page]:
            check(words)


def check(words: tuple[str, ...]) -> None:
    """That what a command names is there: targets, extras, files and their options."""
    program, *rest = words
    if program == "make":
        targets = re.findall(r"^([a-z-]+):", (ROOT / "Makefile").read_text(), re.MULTILINE)
        assert {word for word in rest if "=" not in word} <= set(targets), words
    elif program == "pip":
        extras = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]["optional-dependencies"]
        named = re.findall(r"\[(.*)\]", " ".join(rest))
        assert rest[0] == "install", words
        assert {extra for each in named for extra in each.split(",")} <= set(extras), words
    elif program == "python":
        source = (ROOT / rest[0]).read_text()
        assert all(word.lstrip("-") in source for word in rest[1:] if word.startswith("--")), words
    elif program == "pytest":
        assert all((ROOT / word).exists() for word in rest if word.endswith(".py")), words
    else:
        assert program in LISTED, words
        assert shutil.which(program) or program != "git"


def test_commands_in_a_line_of_text_name_files_that_are_there():
    found = [words for page in PAGES for words in re.findall(r"`(python [^`\n]+)`", page.read_text())]
    assert len(found) > 10
    for line in found:
        if "NAME" not in line and "-m" not in line:
            check(tuple(line.split()))


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (["map=nth"], "nth"),
        (["demos.pth=runs/demos"], "pth"),
        (["algo.total_frames=10_001"], "multiple"),
    ],
)
def test_a_command_with_a_mistake_is_noticed(words, message):
    with pytest.raises(SystemExit, match=message):
        page_recipes.compose("nht.recipes.ddpg", words)


def test_a_program_that_no_page_should_need_is_noticed():
    from shell_commands import commands_of

    with pytest.raises(ValueError, match="docker"):
        commands_of("docker run x\n")
    with pytest.raises(ValueError, match="unbound"):
        commands_of("python $forgotten\n")
