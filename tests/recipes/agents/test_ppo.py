"""The PPO recipe, a few steps at a time: what it writes, that seeds act, that resuming changes nothing."""

import re
from pathlib import Path

import pandas
import pytest

import nht
import nht.envs
from nht.recipes import ddpg, evaluate, ppo
from nht.recipes.agents.adam import LearnersAdam
from nht.recipes.agents.ppo import GaussianPPOLoss
from nht.recipes.config import DDPG, PPO, Evaluate
from nht.recipes.launch import configure
from nht.recipes.run.folder import RunFolder
from nht.recipes.run.saved_run import read_config

TINY = [
    "env=wam_wipe",
    "map=none",
    "env.num_envs=4",
    "env.options.max_episode_steps=25",
    "algo.total_frames=512",
    "algo.frames_per_batch=128",
    "algo.minibatches=4",
    "algo.epochs=2",
    "algo.hidden=[16,16]",
    "evaluation.every=256",
    "evaluation.episodes=3",
    "evaluation.video=false",
    "run.checkpoint_every=256",
    "run.wandb=false",
]


def train(folder: Path, *overrides: str) -> pandas.DataFrame:
    ppo.main(configure(PPO, "ppo", [*TINY, f"run.folder={folder}", *overrides]))
    return pandas.read_csv(folder / "metrics.csv").drop(columns="seconds")


@pytest.fixture(scope="module")
def run(tmp_path_factory):
    folder = tmp_path_factory.mktemp("runs") / "raw-seed0"
    return folder, train(folder)


@pytest.fixture(scope="module")
def map_file(tmp_path_factory):
    map = nht.NHT(10, 7, 2, hidden=(8,))
    map.context_keys = ("tool_position", "joint_angle")
    return nht.save_map(map, tmp_path_factory.mktemp("map") / "nht.safetensors")


def test_a_run_leaves_everything_in_its_folder(run):
    folder, metrics = run
    present = {entry.name for entry in folder.iterdir()}
    assert {"config.yaml", "metrics.csv", "map.safetensors", "policy.safetensors", "checkpoints"} <= present
    assert metrics["frames"].tolist() == [256, 512]
    assert metrics["updates"].tolist() == [16, 32]
    assert metrics[[*GaussianPPOLoss.reports, "eval_return"]].notna().all(axis=None)
    assert isinstance(read_config(folder), PPO)


def test_the_same_seed_gives_the_same_run_and_another_a_different_one(run, tmp_path):
    _, metrics = run
    pandas.testing.assert_frame_equal(train(tmp_path / "same"), metrics)
    assert not train(tmp_path / "other", "seed=1")["loss_critic"].equals(metrics["loss_critic"])


def test_a_run_that_broke_off_resumes_as_if_it_had_not(run, tmp_path, monkeypatch):
    folder, metrics = run
    write = RunFolder.log

    def break_off(self, frames, row):
        if frames == 512:
            raise KeyboardInterrupt
        write(self, frames, row)

    with monkeypatch.context() as patched:
        patched.setattr(RunFolder, "log", break_off)
        with pytest.raises(KeyboardInterrupt):
            train(tmp_path / "run")
    found = train(tmp_path / "run", "run.resume=true")
    pandas.testing.assert_frame_equal(found, metrics)
    policies = [(path / "policy.safetensors").read_bytes() for path in (tmp_path / "run", folder)]
    assert policies[0] == policies[1]


def test_the_learning_rate_falls_linearly(tmp_path, monkeypatch):
    rates = []
    step = LearnersAdam.step

    def record(self, *args, **kwargs):
        rates.append(self.param_groups[0]["lr"])
        return step(self, *args, **kwargs)

    monkeypatch.setattr(LearnersAdam, "step", record)
    train(tmp_path / "falling", "algo.learning_rate=0.4", "algo.epochs=1")
    assert rates[::4] == pytest.approx([0.4, 0.3, 0.2, 0.1])
    rates.clear()
    train(tmp_path / "level", "algo.decay_learning_rate=false", "algo.learning_rate=0.4", "algo.epochs=1")
    assert set(rates) == {0.4}


def test_it_acts_through_a_map_and_evaluate_finds_the_policy(map_file, tmp_path, capsys):
    train(tmp_path / "run", "map=nht", f"map.file={map_file}", "algo.total_frames=256")
    capsys.readouterr()
    config = configure(Evaluate, "evaluate", [f"run={tmp_path / 'run'}", "episodes=3", "video=false"])
    evaluate.main(config)
    assert "eval_return" in capsys.readouterr().out


def test_the_papers_settings_run(tmp_path):
    config = configure(PPO, "ppo", ["algo=ppo_paper"])
    assert (config.algo.frames_per_batch, config.algo.minibatches, config.env.num_envs) == (2048, 32, 1)
    metrics = train(tmp_path, "algo=ppo_paper", "env.num_envs=1", "algo.total_frames=256")
    assert metrics["updates"].tolist() == [16]


def test_all_settings_of_the_papers_table_3_can_be_set():
    for steps_per_update in (1024, 2048, 4096):
        overrides = [
            "algo.learning_rate=1e-2",
            "algo.gamma=0.9",
            "algo.lmbda=0.99",
            "algo.critic_coeff=0.125",
            "algo.clip=0.5",
            f"algo.frames_per_batch={steps_per_update}",
        ]
        for settings in ("ppo", "ppo_paper"):
            algo = configure(PPO, "ppo", [f"algo={settings}", *overrides]).algo
            found = (algo.learning_rate, algo.gamma, algo.lmbda, algo.critic_coeff, algo.clip)
            assert found == (1e-2, 0.9, 0.99, 0.125, 0.5)
            assert algo.frames_per_batch == steps_per_update


@pytest.mark.parametrize("task", sorted({"half_cheetah", *nht.envs.TASKS}))
def test_both_algorithms_run_on_every_task(task, tmp_path):
    metrics = train(
        tmp_path / "ppo", f"env={task}", "env.options.max_episode_steps=25", "algo.total_frames=256"
    )
    assert metrics[["loss_critic", "eval_return"]].notna().all(axis=None)
    shared = [line for line in TINY if not re.match("algo.(epochs|minibatches|total)|env=", line)]
    overrides = ["algo=ddpg_locomotion", "algo.updates_per_batch=3", "algo.warmup_frames=0"]
    ddpg.main(
        configure(
            DDPG,
            "ddpg",
            [
                *shared,
                f"env={task}",
                *overrides,
                "algo.buffer_size=500",
                "algo.total_frames=256",
                f"run.folder={tmp_path / 'ddpg'}",
            ],
        )
    )
    assert pandas.read_csv(tmp_path / "ddpg" / "metrics.csv")["loss_value"].notna().all()


# Bad input.


@pytest.mark.parametrize(
    ("override", "message"),
    [
        ("env.num_envs=7", "algo.frames_per_batch=128 must be a multiple of env.num_envs=7"),
        ("algo.minibatches=5", "algo.frames_per_batch=128 must be a multiple of algo.minibatches=5"),
        ("algo.minibatches=128", "algo.minibatches=128 must be less than algo.frames_per_batch"),
        (
            "algo.total_frames=200",
            "algo.total_frames must be a multiple of algo.frames_per_batch=128, got 200",
        ),
        ("algo.gamma=0", r"algo.gamma must lie in \(0, 1\], got 0.0"),
        ("algo.gamma=1.1", r"algo.gamma must lie in \(0, 1\], got 1.1"),
        ("algo.lmbda=0", r"algo.lmbda must lie in \(0, 1\], got 0.0"),
        ("algo.lmbda=1.01", r"algo.lmbda must lie in \(0, 1\], got 1.01"),
        ("algo.clip=0", "algo.clip must be positive, got 0.0"),
        ("algo.epochs=0", "algo.epochs must be at least 1, got 0"),
        ("algo.entropy_coeff=-1", "algo.entropy_coeff must not be negative, got -1.0"),
        ("algo.activation=gelu", "algo.activation must be tanh or relu, got 'gelu'"),
    ],
)
def test_mistakes_are_named(override, message):
    with pytest.raises(ValueError, match=message):
        configure(PPO, "ppo", [*TINY, override])


def test_gamma_and_lambda_may_be_1(tmp_path):
    overrides = ("algo.gamma=1", "algo.lmbda=1", "algo.total_frames=256")
    assert train(tmp_path / "run", *overrides)["loss_critic"].notna().all()


def test_a_map_for_another_observation_layout(tmp_path):
    for keys, width, message in (
        (("joint_angle", "elbow"), 10, r"no context key 'elbow'"),
        (("observation",), 17, r"the map's context has 17 entries, the context keys 16"),
    ):
        map = nht.NHT(width, 7, 2, hidden=(8,))
        map.context_keys = keys
        file = nht.save_map(map, tmp_path / f"{keys[0]}-{width}-{len(keys)}-{keys[-1]}.safetensors")
        folder = tmp_path / file.stem
        with pytest.raises((KeyError, ValueError), match=message):
            train(folder, "map=nht", f"map.file={file}")
        assert not folder.exists()
        told = "env.context_keys=[tool_position, joint_angle]"
        with pytest.raises(ValueError, match=r"trained on the observations \['.*'\], env.context_keys are"):
            train(folder, "map=nht", f"map.file={file}", told)


@pytest.mark.parametrize(
    "override",
    [
        "env.num_envs=8",
        "env.name=moon",
        "env.options.max_episode_steps=50",
        "algo.hidden=[32,32]",
        "algo.activation=tanh",
        "map.kind=svd",
        "evaluation.episodes=5",
    ],
)
def test_a_checkpoint_of_another_env_or_network(run, override):
    folder, metrics = run
    name = override.split("=")[0].removesuffix(".max_episode_steps")
    with pytest.raises(ValueError, match=rf"holds a run with {name}=.*: it cannot go on with {name}="):
        train(folder, "run.resume=true", "algo.total_frames=1024", override)
    pandas.testing.assert_frame_equal(
        pandas.read_csv(folder / "metrics.csv").drop(columns="seconds"), metrics
    )


def test_a_checkpoint_of_another_algorithm(run):
    folder, _ = run
    shared = [line for line in TINY if "epochs" not in line and "minibatches" not in line]
    config = configure(DDPG, "ddpg", [*shared, f"run.folder={folder}", "run.resume=true"])
    with pytest.raises(ValueError, match="holds a run of ppo: it cannot go on with ddpg"):
        ddpg.main(config)


def test_a_finished_run_has_nothing_to_resume(run, capsys):
    folder, metrics = run
    pandas.testing.assert_frame_equal(train(folder, "run.resume=true"), metrics)
    assert f"{folder}: " in capsys.readouterr().out
