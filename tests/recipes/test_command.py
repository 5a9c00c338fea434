"""The command ``nht``: it starts what ``python -m`` starts, and a shell completes its words at once."""

import shutil
import subprocess
import sys
from dataclasses import fields
from pathlib import Path

import pytest

import fresh_process
from nht.envs.table import installed
from nht.recipes import command
from nht.recipes.agents.table import ALGORITHMS
from nht.recipes.completion import SCRIPTS, candidates
from nht.recipes.config import DDPG, Evaluate, Report, Search, TrainMap
from nht.recipes.overrides import section

RECIPES = sorted(command.recipes())


def dotted(schema, prefix=""):
    """The settings of a dataclass by dotted name, as its fields are when it is imported."""
    for entry in fields(schema):
        kind = section(entry)
        yield from dotted(kind, f"{prefix}{entry.name}.") if kind is not None else [f"{prefix}{entry.name}"]


def typed(*words):
    return candidates(words, RECIPES)


def test_every_recipe_is_known_with_a_sentence():
    assert {"ddpg", "ppo", "train_map", "report", "search"} <= set(RECIPES)
    assert not {"config", "launch", "sections", "command"} & set(RECIPES)
    text = command.about()
    assert all(f"  {name}" in text for name in RECIPES)
    assert all(said.endswith(".") for said in command.recipes().values())


@pytest.mark.parametrize("name", RECIPES)
def test_a_recipe_becomes_the_process(monkeypatch, name):
    called = []
    monkeypatch.setattr("os.execv", lambda program, words: called.append((program, words)))
    monkeypatch.setattr(sys, "argv", ["nht", name, "seed=3", "run.folder=a b"])
    command.main()
    words = [sys.executable, "-m", f"nht.recipes.{name}", "seed=3", "run.folder=a b"]
    assert called == [(sys.executable, words)]


def test_recipes_of_other_packages_are_found_by_their_entry_points(monkeypatch):
    monkeypatch.setattr(command, "others", lambda: {"mine": "my_package.mine:ALGORITHM"})

    class Found:
        main = "my_package.mine:main"

    monkeypatch.setattr("nht.recipes.agents.table.find_algorithm", lambda name: Found)
    assert command.module_of("mine") == "my_package.mine"
    assert "mine" in command.about()


def test_an_unknown_recipe_is_told_what_there_is(monkeypatch):
    monkeypatch.setattr(sys, "argv", ["nht", "ddgp"])
    with pytest.raises(SystemExit, match=r"unknown recipe 'ddgp': choose from .*Did you mean ddpg\?"):
        command.main()


@pytest.mark.parametrize("words", [[], ["tcsh"], ["bash", "zsh"]])
def test_a_shell_must_be_named(words):
    with pytest.raises(SystemExit, match="name a shell, one of bash, zsh, fish"):
        command.completion_script(words)


def test_first_words_are_recipes():
    assert typed("") == sorted([*RECIPES, "completion"])
    assert typed("dd") == ["ddpg"]
    assert typed("completion", "") == ["bash", "fish", "zsh"]


@pytest.mark.parametrize(
    ("recipe", "schema"),
    [
        ("ddpg", DDPG),
        ("ppo", ALGORITHMS["ppo"].schema),
        ("sac", ALGORITHMS["sac"].schema),
        ("train_map", TrainMap),
        ("report", Report),
        ("evaluate", Evaluate),
        ("search", Search),
    ],
)
def test_settings_read_from_the_source_are_those_of_the_dataclass(recipe, schema):
    found = {word.removesuffix("=") for word in typed(recipe, "") if word.endswith("=")}
    expected = set(dotted(schema))
    groups = {word for word in found - expected if word in {entry.name for entry in fields(schema)}}
    assert found - groups == expected


def test_choices_and_flags_have_their_values():
    assert "map=nht" in typed("ddpg", "map=")
    assert {word.split("=")[1].split("_")[0] for word in typed("ddpg", "algo=")} == {"ddpg"}
    assert typed("ddpg", "algo.bfloat16=") == ["algo.bfloat16=false", "algo.bfloat16=true"]
    assert "env=named" not in typed("ddpg", "env=")
    assert typed("ddpg", "env=wam_g") == ["env=wam_grasp"]


def test_what_has_been_said_is_not_offered_again():
    assert "seed=" in typed("ddpg", "se")
    assert "seed=" not in typed("ddpg", "seed=3", "se")


def test_nothing_heavy_is_imported_to_complete():
    code = """
import sys
from nht.recipes import command
sys.argv = ["nht", "__complete", "ddpg", "algo."]
command.main()
heavy = {"torch", "torchrl", "tensordict", "mujoco", "pandas", "hydra", "omegaconf", "numpy", "matplotlib", "wandb"}
print("heavy:", *sorted(heavy & set(sys.modules)))
"""
    done = fresh_process.run(code)
    assert done.stdout.splitlines()[-1] == "heavy:", done.stderr
    assert "algo.gamma=" in done.stdout


@pytest.mark.parametrize(
    ("line", "expected"),
    [
        ("nht tra", ["train_map"]),
        ("nht ddpg env=wam_w", ["wam_wipe"]),
        ("nht ddpg seed=1 algo.gam", ["algo.gamma="]),
        ("nht ddpg algo.bfloat16=", ["false", "true"]),
        ("nht export_map nothing_like_it", []),
    ],
)
def test_bash_completes(tmp_path, line, expected):
    """Where bash divides words at ``=``, the part behind it is what is filled in."""
    program = Path(sys.executable).with_name("nht")
    assert program.exists()
    script = f"""
nht() {{ "{program}" "$@"; }}
compopt() {{ :; }}
eval "$(nht completion bash)"
COMP_LINE='{line}' COMP_POINT={len(line)}
_nht
printf '%s\\n' "${{COMPREPLY[@]}}"
"""
    done = subprocess.run(["bash", "-c", script], capture_output=True, text=True, cwd=tmp_path)
    assert done.returncode == 0, done.stderr
    assert [word for word in done.stdout.split("\n") if word] == expected


@pytest.mark.parametrize("shell", ["zsh", "fish"])
def test_the_other_shells_can_read_their_scripts(shell):
    if shutil.which(shell) is None:
        pytest.skip(f"{shell} is not installed")
    done = subprocess.run([shell, "-n"], input=SCRIPTS[shell], capture_output=True, text=True)
    assert done.returncode == 0, done.stderr


def test_without_other_packages_there_are_no_others():
    assert set(command.others()) == set(installed("nht.algorithms"))
