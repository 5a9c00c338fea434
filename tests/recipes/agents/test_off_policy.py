"""What TD3 and SAC share: critics called in pairs, the buffer, runs on every task and map, settings out of range."""

from copy import deepcopy

import pandas
import pytest
import torch
from tensordict import TensorDict
from tensordict.nn import TensorDictModule
from torch import nn
from torchrl.modules import MLP

import nht
import nht.envs
import tiny_runs
from nht.recipes import collect_demos, evaluate
from nht.recipes.agents.critics import CriticPair, critic_network
from nht.recipes.agents.norm import RunningNorm
from nht.recipes.agents.policy import load_policy
from nht.recipes.agents.replay import STORED, minibatches, replay_buffer, storable
from nht.recipes.agents.td3 import DirectTD3Loss, TD3Config, networks
from nht.recipes.config import CollectDemos, Evaluate
from nht.recipes.launch import configure
from nht.recipes.run.saved_run import read_config

ALGORITHMS = ("sac", "td3")
SHORT = ("algo.total_frames=100", "evaluation.every=100", "algo.random_frames=0")


@pytest.mark.parametrize("bfloat16", [False, True])
@pytest.mark.parametrize("hidden", [[24, 16], []])
@pytest.mark.parametrize("norm", ["none", "critic"])
def test_a_pair_of_critics_gives_what_each_gives_alone(bfloat16, hidden, norm):
    env = nht.envs.make_env("half_cheetah")
    _, actor, critic = networks(env, TD3Config(hidden=hidden, bfloat16=bfloat16, layer_norm=norm))
    loss = DirectTD3Loss(actor, critic, gamma=0.9)
    pair = CriticPair(critic.module, loss.qvalue_network_params)
    features, action = torch.randn(32, 17), torch.rand(32, 6)
    values = pair(features, action)
    tolerance = {"rtol": 0.02, "atol": 0.02} if bfloat16 else {}  # sums are rounded in another order
    for number in range(2):
        network = deepcopy(critic.module)
        for name, weight in network.named_parameters():
            weight.data.copy_(loss.qvalue_network_params["module", *name.split(".")][number])
        alone = network(features, action).squeeze(-1)
        torch.testing.assert_close(values[number], alone, **tolerance)
    assert not torch.equal(values[0], values[1])  # they start apart
    assert torch.equal(pair.fixed(features, action), values)
    torch.testing.assert_close(pair.fixed(features, action, critics=1), values[:1], **tolerance)


def test_critics_start_near_the_lowest_return():
    algo = TD3Config(gamma=0.9, pessimism=0.5)
    for task, lowest in (("wam_wipe", -10.0), ("half_cheetah", 0.0)):
        critic = critic_network(nht.envs.make_env(task), algo)
        assert critic.module[-1].bias.item() == pytest.approx(0.5 * lowest)


def test_a_critic_of_another_make():
    critic = MLP(3, 1, num_cells=[4], activation_class=nn.Tanh)
    with pytest.raises(
        TypeError, match="a pair of critics needs an MLP of Linear, LayerNorm and ReLU layers, got MLP"
    ):
        CriticPair(critic, None)


def steps(count):
    outcome = {"observation": torch.randn(count, 2), "reward": torch.randn(count, 1)}
    flags = {name: torch.zeros(count, 1, dtype=torch.bool) for name in ("done", "terminated", "success")}
    columns = {
        "observation": torch.randn(count, 2),
        "action": torch.rand(count, 1),
        "noise": torch.ones(count),
    }
    columns["steps_to_next_obs"] = torch.ones(count, dtype=torch.long)
    return TensorDict({**columns, "next": outcome | flags}, [count])


def test_the_buffer_keeps_what_is_needed_of_steps_that_are_sound():
    collected = steps(6)
    collected["action"][2] = float("nan")
    kept = storable(collected.reshape(2, 3))
    assert kept.shape == (5,)
    assert set(kept.keys(True, True)) == set(STORED)
    assert kept["observation"].equal(collected["observation"][[0, 1, 3, 4, 5]])


def test_minibatches_are_normalised_by_todays_statistics():
    norm = RunningNorm(2)
    features = TensorDictModule(norm, ["observation"], ["features"])
    buffer = replay_buffer(100, torch.device("cpu"))
    buffer.extend(storable(steps(50)))
    norm.update(torch.randn(20, 2) * 3.0 + 1.0)
    drawn = list(minibatches(buffer, 3, 8, features, torch.device("cpu")))
    assert [batch.shape for batch in drawn] == [(8,)] * 3
    for batch in drawn:
        torch.testing.assert_close(batch["features"], norm(batch["observation"]))
        torch.testing.assert_close(batch["next", "features"], norm(batch["next", "observation"]))
    assert list(minibatches(buffer, 0, 8, features, torch.device("cpu"))) == []


@pytest.mark.parametrize("algorithm", ALGORITHMS)
def test_a_run_leaves_everything_in_its_folder(algorithm, tmp_path, capsys):
    folder = tmp_path / "run"
    metrics = tiny_runs.train(algorithm, folder, "algo.total_frames=400", "evaluation.every=200")
    present = {entry.name for entry in folder.iterdir()}
    assert {"config.yaml", "metrics.csv", "map.safetensors", "policy.safetensors", "checkpoints"} <= present
    assert metrics["updates"].tolist() == [6, 12]
    assert metrics[["loss_actor", "loss_qvalue", "eval_return"]].notna().all(axis=None)
    assert read_config(folder).algo.updates_per_batch == 3
    evaluate.main(configure(Evaluate, "evaluate", [f"run={folder}", "episodes=2", "video=false"]))
    assert "eval_return" in capsys.readouterr().out


@pytest.mark.parametrize("algorithm", ALGORITHMS)
def test_seeds_act_and_repeat(algorithm, tmp_path):
    first, again, other = (
        tiny_runs.train(algorithm, tmp_path / name, *SHORT, f"seed={seed}")
        for name, seed in (("first", 0), ("again", 0), ("other", 1))
    )
    pandas.testing.assert_frame_equal(first, again)
    assert not other["loss_qvalue"].equals(first["loss_qvalue"])


@pytest.mark.parametrize("algorithm", ALGORITHMS)
@pytest.mark.parametrize("task", sorted(nht.envs.TASKS))
def test_every_task(algorithm, task, tmp_path):
    metrics = tiny_runs.train(algorithm, tmp_path / "run", *SHORT, f"env={task}", "algo.bfloat16=true")
    assert metrics[["loss_actor", "loss_qvalue", "eval_return"]].notna().all(axis=None)


@pytest.mark.parametrize("algorithm", ["ddpg", *ALGORITHMS])
def test_networks_may_see_observations_as_they_are(algorithm, tmp_path):
    """No statistics are taken, kept or needed to go on; and it matters."""
    raw = ["algo.observation_norm=false", "evaluation.every=200"]
    whole = tiny_runs.train(algorithm, tmp_path / "whole", *raw, "algo.total_frames=400")
    tiny_runs.train(algorithm, tmp_path / "run", *raw, "algo.total_frames=200")
    more = tiny_runs.train(algorithm, tmp_path / "run", *raw, "algo.total_frames=400", "run.resume=true")
    pandas.testing.assert_frame_equal(more, whole)
    normed = tiny_runs.train(algorithm, tmp_path / "normed", "evaluation.every=200", "algo.total_frames=400")
    assert not normed["loss_actor"].equals(whole["loss_actor"])
    env, config = nht.envs.make_env("wam_wipe"), read_config(tmp_path / "whole")
    policy = load_policy(tmp_path / "whole", env, config)
    seen = policy(TensorDict({"observation": 9.0 * torch.ones(1, 16)}, [1]))["features"]
    assert seen.equal(9.0 * torch.ones(1, 16))


@pytest.fixture(scope="module")
def demos(tmp_path_factory):
    path = tmp_path_factory.mktemp("demos") / "wam_wipe"
    collect_demos.main(configure(CollectDemos, "collect_demos", ["demos.transitions=1000", f"out={path}"]))
    return path


@pytest.mark.parametrize("algorithm", ALGORITHMS)
@pytest.mark.parametrize("kind", ["nht", "scl", "laser", "cae", "svd", "jacobian"])
def test_every_map(algorithm, kind, demos, tmp_path):
    told = [f"map={kind}", f"demos.path={demos}", "map.max_steps=20", "map.hidden=[16]", "algo.n_steps=2"]
    metrics = tiny_runs.train(algorithm, tmp_path / "run", *SHORT, *told)
    assert metrics["loss_qvalue"].notna().all()
    used = nht.load_map(tmp_path / "run" / "map.safetensors")
    assert used.action_dim == {"jacobian": 6}.get(kind, 2)


# Bad input.


@pytest.mark.parametrize("algorithm", ALGORITHMS)
@pytest.mark.parametrize(
    ("override", "message"),
    [
        ("algo.gamma=1", r"algo.gamma must lie in \(0, 1\), got 1.0."),
        ("algo.polyak=1.1", r"algo.polyak must lie in \[0, 1\], got 1.1."),
        ("algo.pessimism=-0.1", r"algo.pessimism must lie in \[0, 1\], got -0.1."),
        ("algo.batch_size=0", "algo.batch_size must be at least 1, got 0."),
        ("algo.buffer_size=0", "algo.buffer_size must be at least 1, got 0."),
        ("algo.n_steps=0", "algo.n_steps must be at least 1, got 0."),
        ("algo.updates_per_batch=-1", "algo.updates_per_batch must be at least 0, got -1."),
        ("algo.random_frames=-1", "algo.random_frames must be at least 0, got -1."),
        ("algo.observation_clip=0", "algo.observation_clip must be positive, got 0.0."),
        ("algo.actor_learning_rate=0", "algo.actor_learning_rate must be positive, got 0.0."),
        ("algo.critic_learning_rate=nan", "algo.critic_learning_rate must be positive, got nan."),
    ],
)
def test_settings_that_both_refuse(algorithm, override, message, tmp_path):
    with pytest.raises(ValueError, match=message):
        tiny_runs.train(algorithm, tmp_path / "run", override)


@pytest.mark.parametrize(
    ("algorithm", "override", "message"),
    [
        ("td3", "algo.policy_delay=0", "algo.policy_delay must be at least 1, got 0."),
        ("td3", "algo.policy_noise=-0.1", "algo.policy_noise must be at least 0, got -0.1."),
        ("td3", "algo.noise_clip=-1", "algo.noise_clip must be at least 0, got -1.0."),
        ("td3", "algo.exploration_noise=-1", "algo.exploration_noise must be at least 0, got -1.0."),
        ("td3", "algo.noise_memory=0.5", "algo.noise_memory must be at least 1, got 0.5."),
        ("td3", "algo.random_action=2", r"algo.random_action must lie in \[0, 1\], got 2.0."),
        ("sac", "algo.initial_temperature=0", "algo.initial_temperature must be positive, got 0.0."),
        (
            "sac",
            "algo.temperature_learning_rate=-1",
            "temperature_learning_rate must be at least 0, got -1.0.",
        ),
        ("sac", "algo.policy_delay=2", "Key 'policy_delay' not in 'SACConfig'"),
    ],
)
def test_settings_that_one_refuses(algorithm, override, message, tmp_path):
    with pytest.raises(ValueError, match=message):
        tiny_runs.train(algorithm, tmp_path / "run", override)
