"""What learners cannot share, and whom it is said to: before anything is written."""

from dataclasses import replace
from types import SimpleNamespace

import pytest

import nht
import populations
import tiny_runs
from nht.recipes.agents.ddpg import DDPGConfig
from nht.recipes.agents.ppo import PPOConfig
from nht.recipes.run.population import open_run
from populations import MAINS

ALGORITHMS = pytest.mark.parametrize("algorithm", sorted(MAINS))


def refused(folder, error, message, call):
    before = sorted(folder.rglob("*"))
    with pytest.raises(error, match=message):
        call()
    assert sorted(folder.rglob("*")) == before


def told_seeds(algorithm, folder, *overrides, seeds=3):
    def train():
        MAINS[algorithm](populations.config(algorithm, folder / "run", f"seeds={seeds}", *overrides))

    return train


def told_apart(algorithm, folder, *others, shared=()):
    """Learners of which the first is as usual, and the others are told more."""

    def train():
        learners = {"a": [*shared], **{f"b{at}": [*shared, *words] for at, words in enumerate(others)}}
        populations.train(algorithm, folder / "run", learners)

    return train


@ALGORITHMS
@pytest.mark.parametrize("seeds", [0, -2])
def test_no_learners(algorithm, seeds, tmp_path):
    train = told_seeds(algorithm, tmp_path, seeds=seeds)
    refused(tmp_path, ValueError, f"seeds must be at least 1, got {seeds}", train)


@pytest.mark.parametrize("algorithm", ["sac", "td3"])
def test_algorithms_that_train_one_at_a_time(algorithm, tmp_path):
    def train():
        tiny_runs.train(algorithm, tmp_path / "run", "seeds=2")

    refused(tmp_path, ValueError, "trains one learner at a time: ddpg and ppo train several together", train)


@ALGORITHMS
def test_several_processes(algorithm, tmp_path):
    config = populations.config(algorithm, tmp_path / "run", "seeds=3")
    ranks = SimpleNamespace(size=2, first=True)
    message = "3 learners train in one process, got 2: give each process seeds of its own"
    refused(tmp_path, ValueError, message, lambda: open_run([config], ranks))


@ALGORITHMS
@pytest.mark.parametrize(
    ("overrides", "message"),
    [
        (["collector=multi_sync"], "several learners need collector=single, got multi_sync"),
        (
            ["env.suite=gymnasium", "env.name=Hopper-v5", "env.options={}"],
            "several learners need a task of the suite nht, .* got gymnasium",
        ),
    ],
)
def test_what_steps_no_learners_together(algorithm, overrides, message, tmp_path):
    refused(tmp_path, ValueError, message, told_seeds(algorithm, tmp_path, *overrides))


@ALGORITHMS
@pytest.mark.parametrize(
    ("override", "message"),
    [
        ("algo.hidden=[16,8]", r"share algo.hidden: it is \[16, 16\] for learner 0, \[16, 8\] for learner 2"),
        ("env.name=wam_grasp", "share env.name: it is wam_wipe for learner 0, wam_grasp for learner 2"),
        ("env.num_envs=2", "share env.num_envs: it is 4 for learner 0, 2 for learner 2"),
        ("env.options.max_episode_steps=30", "share env.options: .*25.* for learner 0, .*30.* for learner 2"),
        ("algo.frames_per_batch=200", "share algo.frames_per_batch: it is 100 for learner 0, 200 for"),
        ("evaluation.episodes=4", "share evaluation.episodes: it is 3 for learner 0, 4 for learner 2"),
        ("algo.observation_clip=2", "share algo.observation_clip"),
    ],
)
def test_learners_that_share_too_little(algorithm, override, message, tmp_path):
    more = ["evaluation.every=200", "run.checkpoint_every=200"]  # alike in all of them
    train = told_apart(algorithm, tmp_path, ["seed=1"], ["seed=2", override], shared=more)
    refused(tmp_path, ValueError, f"learners of one population {message}", train)


def test_learners_of_two_algorithms(tmp_path):
    configs = [populations.config(name, tmp_path / "run" / name) for name in ("ddpg", "ppo")]
    message = "learner 1 learns by PPO, learner 0 by DDPG"
    refused(tmp_path, ValueError, message, lambda: MAINS["ddpg"](*configs))


def test_more_steps_in_a_minibatch_than_are_kept(tmp_path):
    train = told_apart("ddpg", tmp_path, ["seed=1", "algo.batch_size=1001"])
    message = "learner 1 has algo.batch_size=1001, more than algo.buffer_size=1000"
    refused(tmp_path, ValueError, message, train)


@ALGORITHMS
@pytest.mark.parametrize(
    ("shared", "other", "message"),
    [
        (["map=svd"], ["map.action_dim=3"], "share action_dim: .* learner 0 has 2, that of learner 1 has 3"),
        (["map=none"], ["map=svd"], "share action_dim: .* learner 0 has 7, that of learner 1 has 2"),
        (["map=svd"], ["map.residual=0.1"], "share action_dim: .* learner 0 has 2, that of learner 1 has 9"),
        (["map=svd"], ["map=jacobian"], "share action_dim: .* learner 0 has 2, that of learner 1 has 6"),
    ],
)
def test_maps_of_other_numbers_of_actions(algorithm, shared, other, message, tmp_path, monkeypatch):
    def refuse(*_, **__):
        raise AssertionError("a map was trained")

    for name in ("train_map", "train_maps"):
        monkeypatch.setattr(nht, name, refuse)
    train = told_apart(algorithm, tmp_path, ["seed=1", *other], shared=shared)
    refused(tmp_path, ValueError, f"learners of one population {message}", train)


@ALGORITHMS
def test_map_files_of_other_numbers_of_actions(algorithm, tmp_path):
    two = populations.map_of(tmp_path / "maps", 0)
    three = nht.NHT(10, 7, 3, hidden=(8,))
    three.context_keys = ("tool_position", "joint_angle")
    other = nht.save_map(three, tmp_path / "maps" / "three.safetensors")
    train = told_apart(algorithm, tmp_path, [f"map.file={other}"], shared=["map=nht", f"map.file={two}"])
    message = "share action_dim: the map of learner 0 has 2, that of learner 1 has 3"
    refused(tmp_path, ValueError, message, train)


@ALGORITHMS
def test_a_map_file_that_is_not_there(algorithm, tmp_path):
    there = populations.map_of(tmp_path / "maps", 0)
    train = told_apart(
        algorithm, tmp_path, [f"map.file={tmp_path / 'none'}"], shared=["map=nht", f"map.file={there}"]
    )
    refused(tmp_path, FileNotFoundError, "none", train)


@ALGORITHMS
def test_two_learners_in_one_folder(algorithm, tmp_path):
    configs = [populations.config(algorithm, tmp_path / "run" / "one", f"seed={seed}") for seed in (0, 1)]
    message = "every learner needs a folder of its own"
    refused(tmp_path, ValueError, message, lambda: MAINS[algorithm](*configs))


@ALGORITHMS
def test_seeds_among_learners(algorithm, tmp_path):
    configs = [
        populations.config(algorithm, tmp_path / "run" / str(seed), f"seed={seed}", f"seeds={seeds}")
        for seed, seeds in ((0, 2), (5, 2))
    ]
    message = "learner 0 says seeds=2"
    refused(tmp_path, ValueError, message, lambda: MAINS[algorithm](*configs))


@ALGORITHMS
def test_a_population_is_never_overwritten(algorithm, tmp_path):
    learners = {"a": ["seed=1"], "b": ["seed=2"]}
    populations.train(algorithm, tmp_path / "run", learners)
    other = {name: [*told, "algo.gamma=0.7"] for name, told in learners.items()}
    message = "holds a run already: go on with run.resume=true"
    refused(tmp_path, FileExistsError, message, lambda: populations.train(algorithm, tmp_path / "run", other))
    changed = {name: [*told, "run.resume=true"] for name, told in other.items()}
    with pytest.raises(ValueError, match="gamma"):
        populations.train(algorithm, tmp_path / "run", changed)


@ALGORITHMS
def test_nothing_to_resume(algorithm, tmp_path):
    train = told_seeds(algorithm, tmp_path, "run.resume=true")
    refused(tmp_path, FileNotFoundError, "holds no run to resume", train)


def test_a_device_that_is_not_there(tmp_path):
    config = populations.config("ddpg", tmp_path / "run", "seeds=2")
    with pytest.raises((ValueError, RuntimeError)):
        MAINS["ddpg"](replace(config, device="cuda:77"))
    assert not (tmp_path / "run").exists()


def test_the_names_of_what_may_differ():
    for algo in (DDPGConfig(), PPOConfig()):
        assert all(hasattr(algo, name) for name in algo.varies)
