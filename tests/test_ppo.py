"""PPO: its loss against TorchRL's, advantages worked out by hand, and the recipe, a few steps at a time."""

import math
import re
from pathlib import Path

import pandas
import pytest
import torch
from tensordict import TensorDict
from tensordict.nn import (
    ProbabilisticTensorDictModule,
    ProbabilisticTensorDictSequential,
    TensorDictModule,
    TensorDictSequential,
)
from torch import nn
from torchrl.collectors import Collector
from torchrl.envs.utils import ExplorationType, set_exploration_type
from torchrl.modules import IndependentNormal
from torchrl.objectives import ClipPPOLoss
from torchrl.objectives.value import GAE

import nht
import nht.envs
from nht.recipes import ddpg, evaluate, ppo
from nht.recipes.config import DDPG, PPO, Evaluate, PPOConfig
from nht.recipes.environments import mapped_env
from nht.recipes.launch import configure
from nht.recipes.losses import GaussianPPOLoss, estimate_advantages
from nht.recipes.networks import GaussianActor, ReturnNorm, ppo_networks
from nht.recipes.run_folder import RunFolder, read_config

GAMMA, LAMBDA = 0.9, 0.8

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


# The loss is TorchRL's, faster.


def minibatch(size: int = 64) -> TensorDict:
    column = (size, 1)
    entries = {"features": torch.randn(size, 5), "sample": torch.randn(size, 3)}
    entries |= {"sample_log_prob": -4.0 + 0.3 * torch.randn(size), "advantage": 2.0 + torch.randn(column)}
    return TensorDict(
        entries | {"value_target": torch.randn(column), "state_value": torch.randn(column)}, [size]
    )


def networks() -> tuple[GaussianActor, nn.Module]:
    mean = nn.Sequential(nn.Linear(5, 8), nn.Tanh(), nn.Linear(8, 3))
    return GaussianActor(mean, 3, initial_std=0.7), nn.Sequential(nn.Linear(5, 8), nn.Tanh(), nn.Linear(8, 1))


@pytest.mark.parametrize("clip_value", [False, True])
@pytest.mark.parametrize("entropy_coeff", [0.0, 0.01])
def test_loss_and_gradients_equal_those_of_torchrl(clip_value, entropy_coeff):
    actor, critic = networks()
    value = TensorDictModule(critic, ["features"], ["state_value"])
    ours = GaussianPPOLoss(
        TensorDictModule(actor, ["features"], ["sample", "sample_log_prob", "action"]),
        value,
        clip=0.2,
        clip_value=clip_value,
        critic_coeff=0.5,
        entropy_coeff=entropy_coeff,
    )

    class Parameters(nn.Module):
        def forward(self, features):
            mean = actor.network(features)
            return mean, actor.log_std.exp().expand_as(mean)

    theirs = ClipPPOLoss(
        ProbabilisticTensorDictSequential(
            TensorDictModule(Parameters(), ["features"], ["loc", "scale"]),
            ProbabilisticTensorDictModule(
                ["loc", "scale"], ["sample"], distribution_class=IndependentNormal, return_log_prob=True
            ),
        ),
        value,
        clip_epsilon=0.2,
        clip_value=clip_value,
        critic_coeff=0.5,
        entropy_coeff=entropy_coeff,
        normalize_advantage=True,
        loss_critic_type="l2",
        functional=False,
    )
    batch = minibatch()
    found = ours(batch)
    expected = theirs(batch)
    for name in GaussianPPOLoss.reports:
        torch.testing.assert_close(
            found[name], expected[name].squeeze(), msg=lambda m, name=name: f"{name}: {m}"
        )
    parts = expected["loss_objective"] + expected["loss_critic"] + expected["loss_entropy"]
    torch.testing.assert_close(found["loss"], parts.squeeze())
    assert 0 < found["clip_fraction"] < 1
    parameters = [*actor.parameters(), *critic.parameters()]
    for mine, other in zip(
        torch.autograd.grad(found["loss"], parameters), torch.autograd.grad(parts, parameters), strict=True
    ):
        torch.testing.assert_close(mine, other)


def test_the_actor_is_a_gaussian_whose_actions_are_clipped():
    actor, _ = networks()
    features = torch.randn(100, 5)
    sample, log_prob, action = actor(features)
    normal = torch.distributions.Normal(actor.network(features), actor.log_std.exp())
    torch.testing.assert_close(log_prob, normal.log_prob(sample).sum(-1))
    assert sample.abs().max() > 1
    assert action.equal(sample.clamp(-1, 1))
    again, entropy = actor.log_prob(features, sample)
    torch.testing.assert_close(again, log_prob)
    torch.testing.assert_close(entropy.expand(100), normal.entropy().sum(-1))
    with set_exploration_type(ExplorationType.DETERMINISTIC):
        assert actor(features)[0].equal(actor.network(features))


# Time limits.


def value_is_the_observation() -> tuple[TensorDictModule, TensorDictModule, GAE]:
    features = TensorDictModule(nn.Identity(), ["observation"], ["features"])
    critic = TensorDictModule(nn.Identity(), ["features"], ["state_value"])
    return features, critic, GAE(gamma=GAMMA, lmbda=LAMBDA, value_network=None)


def steps(observation, following, reward, terminated, truncated) -> TensorDict:
    values = {"observation": observation, "following": following, "reward": reward}
    observation, following, reward = (torch.tensor([row])[..., None] for row in values.values())
    terminated, truncated = (torch.tensor([row])[..., None] for row in (terminated, truncated))
    outcome = {"observation": following, "reward": reward}
    outcome |= {"terminated": terminated, "truncated": truncated, "done": terminated | truncated}
    return TensorDict({"observation": observation, "features": observation, "next": outcome}, [1, 4])


@pytest.mark.parametrize("terminates", [False, True])
def test_advantages_at_the_end_of_an_episode(terminates):
    # Two steps 1 -> 2 -> 5, an end, then a new episode from -3 that goes on: -3 -> 4 -> 6.
    ends = [False, True, False, False]
    never = [False] * 4
    data = steps(
        [1.0, 2.0, -3.0, 4.0],
        [2.0, 5.0, 4.0, 6.0],
        [0.5, 1.0, -1.0, 2.0],
        terminated=ends if terminates else never,
        truncated=never if terminates else ends,
    )
    estimate_advantages(data, *value_is_the_observation())
    bootstrap = 0.0 if terminates else GAMMA * 5.0  # of the state that the time limit cut off, not of -3
    last = 1.0 + bootstrap - 2.0
    first = 0.5 + GAMMA * 2.0 - 1.0 + GAMMA * LAMBDA * last
    fourth = 2.0 + GAMMA * 6.0 - 4.0
    third = -1.0 + GAMMA * 4.0 + 3.0 + GAMMA * LAMBDA * fourth
    advantage = data["advantage"].flatten()
    torch.testing.assert_close(advantage, torch.tensor([first, last, third, fourth]))
    torch.testing.assert_close(
        data["value_target"].flatten(), advantage + torch.tensor([1.0, 2.0, -3.0, 4.0])
    )


def test_what_is_collected_at_a_time_limit_is_the_episodes_own_last_observation():
    config = configure(PPO, "ppo", [*TINY, "run.folder=unused"])
    config.env.options |= {"max_episode_steps": 3, "start": "random", "terminate_on_failure": False}
    env = mapped_env(config.env, nht.Identity(7), 1.0, seed=0, num_envs=2)
    features, actor, critic = ppo_networks(env, PPOConfig(hidden=[8]))
    policy = TensorDictSequential(features, actor)
    collector = Collector(
        env,
        policy,
        frames_per_batch=12,
        total_frames=-1,
        track_traj_ids=False,
        auto_register_policy_transforms=False,
    )
    data = next(iter(collector))
    collector.shutdown()
    assert data["next", "truncated"][:, 2].all()
    assert not data["next", "terminated"].any()
    reached, started = data["next", "observation"][:, 2], data["observation"][:, 3]
    assert (reached - started).abs().max() > 0.1  # another start, drawn at random
    for step in (0, 1, 3, 4):
        assert data["next", "observation"][:, step].equal(data["observation"][:, step + 1])
    gae = GAE(gamma=GAMMA, lmbda=LAMBDA, value_network=None)
    estimate_advantages(data, features, critic, gae)
    with torch.no_grad():
        value = critic.module(features.module(reached))
    delta = data["next", "reward"][:, 2] + GAMMA * value - data["state_value"][:, 2]
    torch.testing.assert_close(data["advantage"][:, 2], delta)


# Normalisation.


def test_rewards_are_divided_by_the_deviation_of_all_discounted_returns():
    norm = ReturnNorm(2, GAMMA, clip=1.5)
    generator = torch.Generator().manual_seed(0)
    returns, current = [], torch.zeros(2, dtype=torch.float64)
    for _ in range(3):
        reward = 4.0 * torch.randn(2, 5, 1, generator=generator)
        done = torch.rand(2, 5, 1, generator=generator) < 0.3
        for step in range(5):
            current = GAMMA * current + reward[:, step, 0]
            returns.append(current.clone())
            current[done[:, step, 0]] = 0.0
        data = TensorDict({"next": {"reward": reward.clone(), "done": done}}, [2, 5])
        norm(data)
        deviation = torch.stack(returns).std(correction=0).float()
        torch.testing.assert_close(data["next", "reward"], (reward / deviation).clamp(-1.5, 1.5))
    assert data["next", "reward"].abs().max() == 1.5


def test_weights_start_orthogonal():
    config = configure(PPO, "ppo", [*TINY, "run.folder=unused"])
    env = mapped_env(config.env, nht.Identity(7), 1.0, seed=0, num_envs=1)
    _, actor, critic = ppo_networks(env, PPOConfig(hidden=[8, 8], activation="relu", initial_std=0.5))
    for network, last_gain in ((actor.module.network, 0.01), (critic.module, 1.0)):
        layers = [layer for layer in network if isinstance(layer, nn.Linear)]
        for layer, gain in zip(layers, (math.sqrt(2), math.sqrt(2), last_gain), strict=True):
            rows = layer.weight @ layer.weight.T
            torch.testing.assert_close(rows, gain**2 * torch.eye(len(rows)), atol=1e-5, rtol=1e-4)
            assert not layer.bias.any()
    assert sum(isinstance(layer, nn.ReLU) for layer in critic.module) == 2
    torch.testing.assert_close(actor.module.log_std.exp(), torch.full((7,), 0.5))


# The recipe.


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
    step = torch.optim.Adam.step

    def record(self, *args, **kwargs):
        rates.append(self.param_groups[0]["lr"])
        return step(self, *args, **kwargs)

    monkeypatch.setattr(torch.optim.Adam, "step", record)
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
        (("joint_angle", "tool_position"), 10, r"trained on context_keys \['joint_angle', 'tool_position'\]"),
        (
            ("joint_angle", "goal"),
            10,
            r"trained on the observations \['joint_angle', 'goal'\], env.context_keys",
        ),
        (("observation",), 17, r"the map's context has 17 entries, the context keys 10"),
    ):
        map = nht.NHT(width, 7, 2, hidden=(8,))
        map.context_keys = keys
        file = nht.save_map(map, tmp_path / f"{keys[0]}-{width}-{len(keys)}-{keys[-1]}.safetensors")
        folder = tmp_path / file.stem
        with pytest.raises(ValueError, match=message):
            train(folder, "map=nht", f"map.file={file}")


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
    with pytest.raises(
        ValueError, match=re.escape("holds a run with recipe=PPO: it cannot go on with recipe=DDPG")
    ):
        ddpg.main(config)


def test_a_finished_run_has_nothing_to_resume(run):
    folder, _ = run
    with pytest.raises(ValueError, match=r"has made its 512 steps: raise algo.total_frames to go on"):
        train(folder, "run.resume=true")
