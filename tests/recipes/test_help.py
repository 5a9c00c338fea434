"""``--help``: choices, and every setting with its value and its meaning."""

import sys
from dataclasses import dataclass, field, fields

import pytest

from nht.envs import TASKS
from nht.recipes import ddpg, search
from nht.recipes.agents.table import ALGORITHMS
from nht.recipes.config import (
    CollectDemos,
    CompareMaps,
    Evaluate,
    ExportMap,
    InspectDemos,
    Report,
    Search,
    Steer,
    TrainMap,
)
from nht.recipes.help import as_typed, help_text, meanings
from nht.recipes.launch import launch
from nht.recipes.overrides import section

SCHEMAS = [
    CollectDemos,
    CompareMaps,
    Evaluate,
    ExportMap,
    InspectDemos,
    Report,
    Search,
    Steer,
    TrainMap,
    *(ALGORITHMS[name].schema for name in ("ddpg", "td3", "sac", "ppo")),
]


@dataclass
class Parent:
    """A parent."""

    size: int = 1  # how large
    shape: list[int] = field(
        default_factory=lambda: [1, 2],
    )  # how it looks
    # above # the line
    colour: str = "# red"
    silent: bool = False
    label: str = "#no"  # of it: "a # b"


@dataclass
class Child(Parent):
    """A child."""

    size: int = 2
    silent: bool = True  # no more
    own: float = 1.0


def test_meanings_are_the_comments_of_the_fields():
    assert meanings(Child) == {
        "size": "how large",
        "shape": "how it looks",
        "colour": "above # the line",
        "silent": "no more",
        "label": 'of it: "a # b"',
    }
    assert "silent" not in meanings(Parent)


def test_a_class_without_source_has_no_meanings():
    namespace = {"dataclass": dataclass}
    exec("@dataclass\nclass Made:\n    size: int = 1  # how large\n", namespace)
    assert meanings(namespace["Made"]) == {}


@pytest.mark.parametrize("schema", SCHEMAS)
def test_every_setting_says_what_it_means(schema):
    sections = [(f"{entry.name}.", section(entry)) for entry in fields(schema) if section(entry)]
    for prefix, kind in [("", schema), *sections]:
        found = meanings(kind)
        silent = [
            prefix + entry.name
            for entry in fields(kind)
            if section(entry) is None and not found.get(entry.name)
        ]
        assert silent == []
        assert kind.__doc__.strip()


def test_values_are_shown_as_they_are_typed():
    shows = {None: "null", True: "true", 3: "3", "a b": "a b", "null": "null"}
    assert {value: as_typed(value) for value in shows} == shows
    assert as_typed([1, 2]) == "[1, 2]"
    assert as_typed({"start": "fixed", "x": None}) == "{start: fixed, x: null}"


def test_a_setting_too_long_for_its_column_has_its_meaning_below():
    values = {"size": 2, "shape": list(range(30)), "colour": "red", "silent": True, "label": "", "own": 1.0}
    lines = help_text("What it does.", "mine", Child, values, {}).splitlines()
    place = next(number for number, line in enumerate(lines) if line.startswith("  shape=[0, 1"))
    assert lines[place + 1].split() == ["#", "how", "it", "looks"]
    assert "  own=1.0" in lines


def helped(monkeypatch, capsys, recipe, schema, name, *words):
    monkeypatch.setattr(sys, "argv", [name, "--help", *words])
    launch(recipe.main, schema, name)
    return capsys.readouterr().out


def test_help_lists_choices_settings_and_values(monkeypatch, capsys):
    text = helped(monkeypatch, capsys, ddpg, ddpg.DDPG, "ddpg", "algo=ddpg_paper", "map=svd")
    words = set(text.replace(",", " ").split())
    assert text.startswith("DDPG through an action map")
    assert {*TASKS, "gymnasium", "dm_control", "torchrl", "laser", "multi_async"} <= words
    assert {"ddpg_grasp", "ddpg_locomotion"} <= words
    assert not {"named", "ppo_paper", "td3"} & words
    lines = {line.split("#")[0].strip(): line for line in text.splitlines()}
    assert lines["algo.polyak=0.95"].endswith("# share of the old target network that stays at each move")
    assert "map.kind=svd" in lines
    assert "run.folder=runs/ddpg-${env.name}-${map.kind}-seed${seed}" in lines
    assert "for seed in 0 1 2" in text


def test_help_knows_the_choices_of_every_group(monkeypatch, capsys):
    text = helped(monkeypatch, capsys, search, Search, "search")
    assert "search=    half_cheetah, smoke, wam" in text


def test_a_mistake_beside_help_is_told(monkeypatch):
    monkeypatch.setattr(sys, "argv", ["ddpg", "--help", "algo=ppo"])
    with pytest.raises(SystemExit, match="error: algo=ppo is a choice of another recipe"):
        launch(ddpg.main, ddpg.DDPG, "ddpg")
