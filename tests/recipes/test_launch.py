"""Configurations: what the command line may say, and what it is told when it is wrong."""

import re
import subprocess
import sys
from dataclasses import dataclass
from operator import attrgetter

import pytest
import torch
from hydra.core.override_parser.overrides_parser import OverridesParser
from hypothesis import given
from hypothesis import strategies as st

from nht.recipes.agents.sac import SAC
from nht.recipes.agents.td3 import TD3
from nht.recipes.config import (
    DDPG,
    CollectDemos,
    CompareMaps,
    Evaluate,
    ExportMap,
    InspectDemos,
    Report,
    Search,
    TrainMap,
)
from nht.recipes.launch import configure, launch
from nht.recipes.overrides import QUOTED, as_text, quoted

SCHEMAS = {
    "collect_demos": CollectDemos,
    "inspect_demos": InspectDemos,
    "train_map": TrainMap,
    "compare_maps": CompareMaps,
    "ddpg": DDPG,
    "sac": SAC,
    "td3": TD3,
    "evaluate": Evaluate,
    "report": Report,
    "search": Search,
    "export_map": ExportMap,
}


@pytest.mark.parametrize("name", SCHEMAS)
def test_every_recipe_has_a_configuration(name):
    assert isinstance(configure(SCHEMAS[name], name), SCHEMAS[name])


def test_overrides_and_choices_arrive():
    config = configure(DDPG, "ddpg", ["map=svd", "algo=ddpg_paper", "algo.batch_size=64", "seed=3"])
    assert config.map.kind == "svd"
    assert (config.algo.gamma, config.algo.polyak, config.algo.target_update_every) == (0.995, 0.95, 40)
    assert config.algo.batch_size == 64
    assert config.run.folder == "runs/ddpg-wam_wipe-svd-seed3"


def test_all_settings_of_the_papers_table_2_can_be_set():
    overrides = [
        "map.learning_rate=1e-4",
        "map.batch_size=32",
        "map.activation=relu",
        "map.hidden=[64,64,64]",
        "map.lipschitz=10.0",
        "map.action_scale=2.0",
        "algo.actor_learning_rate=1e-4",
        "algo.critic_learning_rate=1e-2",
        "algo.random_action=0.4",
        "algo.exploration_noise=0.4",
        "algo.action_l2=1.0",
        "algo.batch_size=32",
        "algo.polyak=0.99",
    ]
    config = configure(DDPG, "ddpg", overrides)
    assert config.map.hidden == [64, 64, 64]
    assert config.algo.critic_learning_rate == 1e-2


PATHS = [
    "/data/lr=0.1/demos",
    "/data/demos (1)",
    "/data/a,b",
    "/data/it's",
    "/data/a#1",
    "/data/x[1]",
    "/data/{x}: $y @ 5%",
    "/data/josé",
    "/data/two\nlines",
    "/data/back\\slash",
    "/data/ends with \\",
    "'begins with a quote",
    "'a' and 'b'",
    '"a" and b"',
    " spaces ",
    "a:b",
    "(1)",
    "--",
    r"C:\'",
]
PLACES = [
    (TrainMap, "train_map", "out", []),
    (TrainMap, "train_map", "demos.path", []),
    (DDPG, "ddpg", "map.file", []),
    (DDPG, "ddpg", "run.folder", []),
    (CollectDemos, "collect_demos", "source.path", ["source=hdf5"]),
    (InspectDemos, "inspect_demos", "out", ["demos=x"]),
    (Evaluate, "evaluate", "run", []),
    (Report, "report", "folder", []),
    (Search, "search", "demos.path", []),
    (ExportMap, "export_map", "file", []),
]


@pytest.mark.parametrize(("schema", "name", "key", "more"), PLACES)
def test_paths_hold_any_character_at_every_depth(schema, name, key, more):
    for path in PATHS:
        assert read(schema, f"{key}={path}") == path
        assert read(schema, f"{key}={quoted(path)}") == path
    together = "/".join(PATHS)
    assert attrgetter(key)(configure(schema, name, [*more, f"{key}={together}"])) == together


def read(schema, word):
    """The value that Hydra reads from a word of the command line."""
    return OverridesParser.create().parse_override(as_text(schema, word)).value()


@pytest.mark.parametrize(("schema", "name", "key", "more"), PLACES)
def test_a_tilde_is_home_at_every_depth(schema, name, key, more, monkeypatch):
    monkeypatch.setenv("HOME", "/home/somebody")
    found = configure(schema, name, [*more, f"{key}=~/a=b (1)"])
    assert attrgetter(key)(found) == "/home/somebody/a=b (1)"


@pytest.mark.parametrize("path", ["a~b", "./~", "~nobody-of-this-name/x"])
def test_another_tilde_is_none(path):
    assert configure(ExportMap, "export_map", [f"file={path}"]).file == path


def test_the_shells_own_escapes_stand_for_themselves():
    assert configure(TrainMap, "train_map", [r"out=\${HOME}/x"]).out == "${HOME}/x"


@given(st.text(st.one_of(st.sampled_from("'\"\\\n =,[](){}#~$"), st.characters(exclude_categories=["Cs"]))))
def test_text_is_read_as_it_was_typed(text):
    if not QUOTED.fullmatch(text):
        assert read(Report, f"title={text}") == text
    assert read(Report, f"title={quoted(text)}") == text


@pytest.mark.parametrize(
    ("runs", "found"),
    [
        ("[lr=0.1,demos (1)]", ["lr=0.1", "demos (1)"]),
        ("[ a b , c ]", ["a b", "c"]),
        ("[josé,~/x,7,null]", ["josé", "/home/somebody/x", "7", "null"]),
        ("['a [1','b, c']", ["a [1", "b, c"]),
        ("[a [1],b (2, 3), {c}]", ["a [1]", "b (2, 3)", "{c}"]),
        ("[hidden=[8,8],map=nht]", ["hidden=[8,8]", "map=nht"]),
        ("[]", []),
        ("[a]", ["a"]),
    ],
)
def test_lists_of_paths(runs, found, monkeypatch):
    monkeypatch.setenv("HOME", "/home/somebody")
    assert configure(Report, "report", [f"runs={runs}"]).runs == found


@pytest.mark.parametrize(
    "path",
    [
        "runs/demos",
        "runs/lr=0.1/demos",
        "it's (mine), {really}: $1 @ 5%/a b",
        "-",
        "a=b",
        "'a' and 'b'/c",
        "x\\",
    ],
)
def test_a_word_without_a_key_sets_the_positional_setting(path, monkeypatch):
    word = path if path not in ("-", "a=b") else f"demos='{path}'"
    monkeypatch.setattr(sys, "argv", ["inspect_demos", word, "directions=3"])
    told = []
    launch(told.append, InspectDemos, "inspect_demos", positional="demos")
    assert told == [InspectDemos(demos=path, directions=3)]


def test_a_folder_that_lies_there_is_meant_unless_its_name_begins_like_a_setting(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    for name in ("lr=0.1", "directions=3"):
        (tmp_path / name).mkdir()
    told = []
    monkeypatch.setattr(sys, "argv", ["inspect_demos", "lr=0.1", "directions=3"])
    launch(told.append, InspectDemos, "inspect_demos", positional="demos")
    assert told == [InspectDemos(demos="lr=0.1", directions=3)]
    monkeypatch.setattr(sys, "argv", ["inspect_demos", "direction=3"])
    with pytest.raises(SystemExit, match=r"Could not override 'direction'.*Keys here: .*'directions'"):
        launch(told.append, InspectDemos, "inspect_demos", positional="demos")


def test_suites_of_others_are_choices():
    env = configure(DDPG, "ddpg", ["env=gymnasium"]).env
    assert (env.suite, env.name, env.options) == ("gymnasium", "HalfCheetah-v5", {})
    env = configure(DDPG, "ddpg", ["env=torchrl", "env.name=robots:make"]).env
    assert (env.suite, env.name, env.options) == ("torchrl", "robots:make", {})


def test_an_algorithm_of_ones_own_takes_the_choices_of_what_it_is_made_of():
    @dataclass
    class Own(DDPG):
        """Mine."""

    assert configure(Own, "ddpg", ["algo=ddpg_paper"]).algo.polyak == 0.95
    with pytest.raises(ValueError, match=r"another recipe: python -m nht\.recipes\.sac"):
        configure(Own, "ddpg", ["algo=sac"])


@pytest.mark.parametrize(
    "title", ["k = 3", "start fixed, k=2", "it's 5 {%}", "a 'b' [c]: d", "null", "", "7"]
)
def test_text_is_taken_as_it_is(title):
    assert configure(Report, "report", [f"title={title}"]).title == title
    assert configure(Report, "report", ["title='quoted, too'"]).title == "quoted, too"


def test_dictionaries_take_new_keys_and_nothing_else_does():
    config = configure(
        CollectDemos, "collect_demos", ["source.context={joint: info/joint}", "env.options.new=1"]
    )
    assert config.source.context == {"joint": "info/joint"}
    assert config.env.options["new"] == 1
    assert config.env.options["start"] == "fixed"
    assert CollectDemos().source.context == {}
    with pytest.raises(ValueError, match=r"Could not override 'source.contxt'.*Keys here: \['kind', 'path'"):
        configure(CollectDemos, "collect_demos", ["source.contxt={joint: info/joint}"])


@pytest.mark.parametrize(
    ("override", "message"),
    [
        ("algo.gama=0.9", "Key 'gama' not in 'DDPGConfig'.*'gamma'"),
        ("mpa=svd", "Could not override 'mpa'.*'map'"),
        ("map=pca", "Could not find 'map/pca'.*nht.*none.*svd"),
        ("env=moon", "Could not find 'env/moon'.*wam_wipe"),
        ("algo.gamma=fast", "Value 'fast' of type 'str' could not be converted to Float"),
        ("algo.gamma=1.0", r"algo.gamma must lie in \(0, 1\), got 1.0"),
        ("algo.polyak=-0.1", r"algo.polyak must lie in \[0, 1\], got -0.1"),
        ("algo.batch_size=0", "algo.batch_size must be at least 1, got 0"),
        ("algo.noise_memory=0.5", "algo.noise_memory must be at least 1, got 0.5"),
        ("env.num_envs=7", "algo.frames_per_batch=200 must be a multiple of env.num_envs=7"),
        ("evaluation.every=300", "evaluation.every must be a multiple of algo.frames_per_batch=200, got 300"),
        ("--multirun", "unknown flag '--multirun'.*multirun.*is not supported.*for seed in 0 1 2; do"),
        ("--cfg", "unknown flag '--cfg': settings are written key=value, and --help lists them"),
        ("seed=0,1", "no sweeps.*for seed in 0 1; do python -m nht.recipes.ddpg seed=\\$seed; done"),
        ("map=nht,svd", "several runs.*for map in nht svd; do"),
        ("algo.gamma=range(0.9,0.99)", "several runs.*for gamma in ...; do"),
        ("algo.hidden=64,64", r"a list is written algo.hidden=\[64,64\]"),
        ("algo=ppo", "algo=ppo is a choice of another recipe: python -m nht.recipes.ppo algo=ppo"),
        ("algo=td3", "another recipe: python -m nht.recipes.td3"),  # though it would fit
        ("env=torchrl", "env.name must name a task of torchrl.*env.name=my_package.robots:make"),
        ("env.context_keys=[a [1,b]", r"cannot be read.*stands in quotes.*runs=\['a \[1','b, c'\]"),
        ("env.context_keys=[a 1],b]", "cannot be read.*stands in quotes"),
        ("env.context_keys=['a',b=c]", "cannot be read.*stands in quotes"),
        ("env.options={a: b=c}", "cannot be read.*stands in quotes"),
        ("demos.path=${HOME}", r"\${...} names another setting.*oc.env:HOME"),
        ("demos.path=${", r"\${...} names another setting.*\\\${ stands for"),
    ],
)
def test_mistakes_are_named_with_what_exists(override, message):
    with pytest.raises(ValueError, match=re.compile(message, re.DOTALL)):
        configure(DDPG, "ddpg", [override])


def test_the_command_line_prints_a_mistake_in_one_line(tmp_path):
    command = [sys.executable, "-m", "nht.recipes.ddpg", "algo.gama=0.9"]
    found = subprocess.run(command, cwd=tmp_path, capture_output=True, text=True, check=False)
    assert found.returncode == 1
    assert found.stderr.strip().splitlines()[-1].startswith("error: Could not override 'algo.gama'")
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize(
    ("rank", "error", "waits"),
    [
        ("0", ValueError("no."), False),
        ("1", ValueError("no."), True),
        ("0", RuntimeError("[gloo/transport/tcp/pair.cc:534] Connection closed by peer"), True),
        ("0", torch.distributed.DistNetworkError("The client socket has timed out."), True),
    ],
)
def test_ranks_let_the_first_one_speak(rank, error, waits, monkeypatch):
    def fail(_):
        raise error

    slept = []
    monkeypatch.setattr("time.sleep", slept.append)
    monkeypatch.setattr(sys, "argv", ["ddpg"])
    for name, value in {"WORLD_SIZE": "2", "RANK": rank}.items():
        monkeypatch.setenv(name, value)
    with pytest.raises(SystemExit, match=f"error: {re.escape(str(error))}"):
        launch(fail, DDPG, "ddpg")
    assert len(slept) == waits
    monkeypatch.setenv("WORLD_SIZE", "1")
    with pytest.raises(SystemExit):
        launch(fail, DDPG, "ddpg")
    assert len(slept) == (waits and 1)
