"""Configurations: what the command line may say, and what it is told when it is wrong."""

import re
import subprocess
import sys

import pytest
import torch

from nht.recipes.agents.sac import SAC
from nht.recipes.agents.td3 import TD3
from nht.recipes.config import DDPG, CollectDemos, CompareMaps, Evaluate, InspectDemos, Report, TrainMap
from nht.recipes.launch import configure, launch

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


@pytest.mark.parametrize(
    "path", ["runs/demos", "runs/lr=0.1/demos", "it's (mine), {really}: $1 @ 5%/a b", "-", "a=b"]
)
def test_a_word_without_a_key_sets_the_positional_setting(path, monkeypatch):
    word = path if path not in ("-", "a=b") else f"demos='{path}'"
    monkeypatch.setattr(sys, "argv", ["inspect_demos", word, "directions=3"])
    told = []
    launch(told.append, InspectDemos, "inspect_demos", positional="demos")
    assert told == [InspectDemos(demos=path, directions=3)]


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
        ("--multirun", "unknown flag '--multirun'.*multirun.*is not supported"),
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
