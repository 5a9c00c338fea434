"""Demonstrations from anywhere: TorchRL's data, HDF5 files, policies, and the recipe that collects them."""

import re
from pathlib import Path

import pytest
import torch
from tensordict import TensorDict
from torchrl.collectors import Collector
from torchrl.collectors.utils import split_trajectories
from torchrl.data import LazyMemmapStorage, LazyTensorStorage, TensorDictReplayBuffer
from torchrl.data.datasets import D4RLExperienceReplay

import nht
import nht.envs
from nht.recipes import collect_demos, ddpg
from nht.recipes.agents.policy import load_policy
from nht.recipes.config import DDPG, CollectDemos
from nht.recipes.data.recording import endings, has_success, record_episodes
from nht.recipes.launch import configure
from nht.recipes.run.environments import mapped_env
from nht.recipes.run.saved_run import read_config
from nht.recipes.sections import DemosConfig
from toy_demos import CONTEXT, FLAGS, LENGTHS, as_rollout, demonstrations, episodes, same, write_hdf5


@pytest.fixture(autouse=True)
def minari_home(tmp_path, monkeypatch):
    """Minari's datasets are those of the test."""
    monkeypatch.setenv("MINARI_DATASETS_PATH", str(tmp_path / "home"))
    return tmp_path / "home"


# TensorDicts.


def test_a_rollout_gives_the_episodes_that_it_holds():
    data = episodes()
    found = nht.Demos.from_tensordict(as_rollout(data), context=CONTEXT, env="toy")
    assert same(found, data)
    assert found.manifest["settings"] == {"left_out_episodes": 0}
    assert found.fingerprint == demonstrations().fingerprint


def test_every_key_can_have_another_name():
    data = episodes()
    renamed = TensorDict(
        {
            "obs": data["observation"],
            "torque": data["actuation"],
            "reward": data["reward"].squeeze(-1),
            "game": {"over": data["done"].squeeze(-1).to(torch.uint8), "name": 10 - 3 * data["episode"]},
        },
        batch_size=15,
    )
    keys = {"actuation_key": "torque", "context": {"observation": "obs"}}
    for ends in ({"done_key": ("game", "over")}, {"episode_key": ("game", "name")}):
        found = nht.Demos.from_tensordict(renamed, **keys, **ends)
        order = [0, 1, 2] if "done_key" in ends else [2, 1, 0]  # episodes stand in the order of their numbers
        rows = torch.cat([torch.where(data["episode"] == episode)[0] for episode in order])
        assert torch.equal(found.actuation, data["actuation"][rows])
        assert torch.equal(found.data["reward"], data["reward"][rows])
        assert [int(count) for count in found.episode.bincount()] == [LENGTHS[episode] for episode in order]
    assert "next" not in found.data


def test_episodes_without_an_end_are_left_out_and_counted():
    data = as_rollout(episodes())[:-1]
    found = nht.Demos.from_tensordict(data, context=CONTEXT)
    assert (len(found), found.manifest["episodes"]) == (8, 2)
    assert found.manifest["settings"]["left_out_episodes"] == 1
    assert same(found, episodes()[:8])


@pytest.fixture(scope="module")
def collected():
    """Two batches of four copies, (4, 12) each: episodes of five steps run from one batch into the next."""
    env = nht.envs.make_env("wam_wipe", num_envs=4, seed=0, max_episode_steps=5, terminate_on_failure=False)
    collector = Collector(env, frames_per_batch=48, total_frames=96)
    batches = [batch.clone() for batch in collector]
    collector.shutdown()
    return batches


def test_a_collectors_batches_in_time_and_one_after_the_other_give_the_same_episodes(collected):
    keys = {"context": ["joint_angle"]}
    in_time = nht.Demos.from_tensordict(torch.cat(collected, dim=1), **keys)
    buffer = TensorDictReplayBuffer(storage=LazyTensorStorage(96))
    for batch in collected:
        buffer.extend(batch.reshape(-1))
    one_by_one = nht.Demos.from_tensordict(buffer[:], **keys)
    assert in_time.fingerprint == one_by_one.fingerprint
    lengths = in_time.episode.bincount()
    assert (lengths <= 5).all()
    assert len(lengths) >= 4 * 4
    within = in_time.episode[1:] == in_time.episode[:-1]
    following = in_time.data["next", "joint_angle"][:-1]
    assert torch.equal(following[within], in_time.data["joint_angle"][1:][within])
    left_out = in_time.manifest["settings"]["left_out_episodes"]
    assert len(in_time) + left_out < 96 + 1
    assert left_out == 4  # 24 is no multiple of 5


def test_rows_are_trajectories_and_padding_is_dropped(collected):
    batch = torch.cat(collected, dim=1)
    expected = nht.Demos.from_tensordict(batch, context=["joint_angle"])
    padded = split_trajectories(batch)
    assert padded.shape[1] == 5
    assert not padded["collector", "mask"].all()
    assert nht.Demos.from_tensordict(padded, context=["joint_angle"]).fingerprint == expected.fingerprint
    anonymous = batch.exclude(("collector", "traj_ids"))
    rows = nht.Demos.from_tensordict(anonymous, context=["joint_angle"])
    assert torch.equal(rows.actuation.sort(0).values, expected.actuation.sort(0).values)  # in another order
    assert rows.manifest["episodes"] == expected.manifest["episodes"]


def test_torchrls_datasets_serve_as_they_are(tmp_path):
    as_rollout(episodes()).memmap(tmp_path / "toy")
    dataset = D4RLExperienceReplay("toy", batch_size=4, root=tmp_path, download=False, direct_download=True)
    assert same(nht.Demos.from_tensordict(dataset[:], context=CONTEXT), episodes())


@pytest.mark.parametrize(
    ("arguments", "error", "message"),
    [
        ({"actuation_key": "torque"}, KeyError, r"key 'torque' is not in the data, which have 'action', "),
        ({"context": ["obs"]}, KeyError, r"key 'obs' is not in the data.*'observation'"),
        ({"episode_key": "run"}, KeyError, r"key 'run' is not in the data"),
        ({"done_key": "end"}, KeyError, r"key 'end' is not in the data"),
        ({"actuation_key": ("next", "done")}, ValueError, r"actuation must be floats \(T, n\).*torch\.bool"),
    ],
)
def test_a_key_that_is_not_there(arguments, error, message):
    with pytest.raises(error, match=message):
        nht.Demos.from_tensordict(as_rollout(episodes()), **arguments)


def test_data_that_do_not_say_where_episodes_end():
    data = as_rollout(episodes())
    silent = data.exclude(*(("next", flag) for flag in FLAGS))
    with pytest.raises(
        ValueError, match=r"nothing says where episodes end: name episode_key or done_key; .*'action'"
    ):
        nht.Demos.from_tensordict(silent)
    with pytest.raises(ValueError, match=r"none of the 1 episodes ends with done, terminated or truncated"):
        nht.Demos.from_tensordict(data[:4])
    with pytest.raises(ValueError, match=r"need a batch size \(T,\) or \(N, T\), got \(\)"):
        nht.Demos.from_tensordict(data[0])
    data["action"][3, 1] = float("nan")
    with pytest.raises(ValueError, match=r"must be finite, but key 'actuation' holds 1 NaN"):
        nht.Demos.from_tensordict(data)


# HDF5.


def test_d4rls_files_give_their_episodes(tmp_path):
    found = nht.from_hdf5(write_hdf5(tmp_path / "toy.hdf5"), env="toy")
    assert same(found, episodes().exclude("joint", ("next", "joint"), "success"))
    context = {"observation": "observations", "joint": "infos/qpos"}
    bare = write_hdf5(tmp_path / "bare.hdf5", next_observations=None, rewards=None)
    found = nht.from_hdf5(bare, context=context)
    assert same(found, episodes().exclude("next", "reward", "success"))


def test_hdf5_keys_can_have_other_names(tmp_path):
    data = episodes()
    changes = {"torque": data["actuation"], "run": data["episode"] + 5, "actions": None}
    path = write_hdf5(tmp_path / "toy.hdf5", **changes, terminals=None, timeouts=None)
    keys = {"actuation_key": "torque", "context": ["infos/qpos"]}
    found = nht.from_hdf5(path, **keys, episode_key="run")
    assert torch.equal(found.data["infos", "qpos"], data["joint"])
    assert torch.equal(found.episode, data["episode"])
    path = write_hdf5(tmp_path / "ends.hdf5", **changes, over=data["done"].to(torch.float32))
    assert torch.equal(nht.from_hdf5(path, **keys, done_key="over").episode, data["episode"])


@pytest.mark.parametrize(
    ("changes", "arguments", "error", "message"),
    [
        (
            {},
            {"actuation_key": "torque"},
            KeyError,
            r"keys \['torque'\] are not in .*toy.hdf5, which has \['actions'",
        ),
        ({}, {"context": ["infos/qvel"]}, KeyError, r"keys \['infos/qvel'\] are not in .*'infos/qpos'"),
        (
            {"rewards": torch.zeros(14)},
            {},
            ValueError,
            r"a row per transition each, got lengths .*'rewards': 14",
        ),
        ({"terminals": None, "timeouts": None}, {}, ValueError, r"nothing says where episodes end"),
        ({"actions": torch.full((15, 3), torch.nan)}, {}, ValueError, r"key 'actuation' holds 45 NaN"),
    ],
)
def test_an_hdf5_file_that_does_not_fit(changes, arguments, error, message, tmp_path):
    path = write_hdf5(tmp_path / "toy.hdf5", **changes)
    with pytest.raises(error, match=message):
        nht.from_hdf5(path, **arguments)


def test_an_hdf5_file_cut_short_or_missing(tmp_path):
    path = write_hdf5(tmp_path / "toy.hdf5")
    path.write_bytes(path.read_bytes()[:-1000])
    with pytest.raises(ValueError, match=r"toy.hdf5 cannot be read, it is cut short or no HDF5 file"):
        nht.from_hdf5(path)
    with pytest.raises(FileNotFoundError, match=r"there is no file .*other.hdf5"):
        nht.from_hdf5(tmp_path / "other.hdf5")


# The recipe.


@pytest.fixture(scope="module")
def wiping(tmp_path_factory):
    path = tmp_path_factory.mktemp("wiping") / "demos"
    collect_demos.main(configure(CollectDemos, "collect_demos", ["demos.transitions=300", f"out={path}"]))
    return path


def collect(out: Path, *overrides: str) -> nht.Demos:
    collect_demos.main(configure(CollectDemos, "collect_demos", [*overrides, f"out={out}"]))
    return nht.load_demos(out)


def test_the_recipe_reads_every_kind_of_file(tmp_path):
    pytest.importorskip("minari")
    task = ["env.name=toy", "env.context_keys=[observation,joint]"]
    demos = demonstrations()
    nht.to_minari(demos, "toy-v0")
    storage = LazyMemmapStorage(40)  # with room for more
    TensorDictReplayBuffer(storage=storage).extend(as_rollout(episodes()))
    storage.dumps(tmp_path / "storage")
    sources = {
        "minari": ["source.path=toy-v0"],
        "hdf5": [
            f"source.path={write_hdf5(tmp_path / 'toy.hdf5')}",
            "source.context={observation: observations, joint: infos/qpos}",
        ],
        "tensordict": [
            f"source.path={tmp_path / 'storage'}",
            "source.context={observation: observation, joint: info/joint}",
        ],
    }
    for kind, overrides in sources.items():
        found = collect(tmp_path / kind, f"source={kind}", *overrides, *task)
        assert torch.equal(found.context(["observation", "joint"]), demos.context(["observation", "joint"]))
        assert torch.equal(found.actuation, demos.actuation)
        assert torch.equal(found.episode, demos.episode)
        assert found.manifest["env"] == "toy"
        assert found.manifest["settings"]["source"]["kind"] == kind
    rewards = demos.data["reward"].squeeze(-1)
    returns = torch.zeros(3).index_add(0, demos.episode, rewards).sort().values
    kept = collect(
        tmp_path / "best",
        "source=minari",
        "source.path=toy-v0",
        *task,
        f"demos.min_return={(returns[0] + returns[1]) / 2}",
    )
    assert kept.manifest["episodes"] == 2
    assert kept.manifest["settings"]["left_out_episodes"] == 1


@pytest.fixture(scope="module")
def run(tmp_path_factory):
    """A run of two updates or so; what its policy does is of no matter, but that it is recorded is."""
    scratch = tmp_path_factory.mktemp("run")
    map = nht.NHT(10, 7, 2, hidden=(16,), seed=0)
    map.context_keys = ("tool_position", "joint_angle")
    nht.save_map(map, scratch / "map.safetensors")
    settings = ["total_frames=200", "frames_per_batch=200", "warmup_frames=100", "updates_per_batch=2"]
    overrides = [
        *(f"algo.{setting}" for setting in settings),
        "evaluation.every=200",
        "evaluation.episodes=2",
    ]
    overrides += ["evaluation.video=false", "run.checkpoint_every=200", "run.wandb=false", "algo.hidden=[16]"]
    overrides += [f"map.file={scratch / 'map.safetensors'}", f"run.folder={scratch / 'run'}"]
    ddpg.main(configure(DDPG, "ddpg", overrides))
    return scratch / "run"


def test_a_policys_demonstrations_are_what_the_motors_got(run, tmp_path):
    overrides = ["source=policy", f"source.path={run}", "demos.transitions=10", "seed=3"]
    demos = collect(tmp_path / "demos", *overrides)
    assert demos.manifest["expert"] == "nht policy"
    assert demos.manifest["settings"]["left_out_episodes"] > 0
    last = torch.cat([demos.episode[1:] != demos.episode[:-1], torch.ones(1, dtype=torch.bool)])
    assert demos.data["success"].squeeze(-1).equal(last)
    trained = read_config(run)
    map = nht.load_map(run / "map.safetensors")
    env = mapped_env(trained.env, map, seed=0, num_envs=1)
    action = load_policy(run, env, trained)(demos.data.select("observation").to_tensordict())["action"]
    low, high = (bound[0] for bound in (env.base_env.action_spec.low, env.base_env.action_spec.high))
    expected = map(action, demos.context(["tool_position", "joint_angle"])).clamp(low, high)
    torch.testing.assert_close(demos.actuation, expected)
    assert collect(tmp_path / "again", *overrides).fingerprint == demos.fingerprint
    assert collect(tmp_path / "other", *overrides, "seed=4").fingerprint != demos.fingerprint


def expected_answers(demos):
    """What the expert does in the recorded states."""
    expert = nht.envs.make_expert("wam_wipe")
    return torch.from_numpy(expert({key: demos.data[key].numpy() for key in ("joint_angle", "goal")})).float()


def test_disturbed_demonstrations_are_the_experts_answers_beside_its_way(tmp_path):
    told = ["demos.transitions=300", "env.options.height_tolerance=0.05"]
    disturbed = collect(tmp_path / "disturbed", *told, "demos.disturbance=0.1")
    torch.testing.assert_close(disturbed.actuation, expected_answers(disturbed), rtol=1e-4, atol=1e-4)
    assert not {"reward", "next"} & set(disturbed.data.keys())
    assert disturbed.manifest["settings"]["expert"] == {"disturbance": 0.1}
    clean = collect(tmp_path / "clean", *told)
    height = [abs(demos.data["tool_position"][:, 2] - 0.0).std() for demos in (clean, disturbed)]
    assert height[1] > 3 * height[0]
    again = collect(tmp_path / "again", *told, "demos.disturbance=0.1")
    assert again.fingerprint == disturbed.fingerprint
    other = collect(tmp_path / "other", *told, "demos.disturbance=0.1", "seed=1")
    assert other.fingerprint != disturbed.fingerprint
    train = ["map.max_steps=10", f"demos.path={tmp_path / 'disturbed'}", "algo.demos.transitions=100"]
    with pytest.raises(KeyError, match=r"lacks \['reward', 'next/observation'\], which algo.demos needs"):
        ddpg.main(configure(DDPG, "ddpg", [*train, f"run.folder={tmp_path / 'run'}"]))


def test_the_expert_answers_where_a_policy_goes(run, tmp_path):
    overrides = ["source=policy", "source.relabel=true", f"source.path={run}", "demos.transitions=300"]
    demos = collect(tmp_path / "demos", *overrides)
    assert demos.manifest["expert"] == "WipeExpert beside a nht policy"
    torch.testing.assert_close(demos.actuation, expected_answers(demos), rtol=1e-4, atol=1e-4)
    assert not {"reward", "next"} & set(demos.data.keys())
    ends = torch.cat([demos.episode[1:] != demos.episode[:-1], torch.ones(1, dtype=torch.bool)])
    success = demos.data["success"][ends]
    assert success.any()  # the expert's episodes
    assert not success.all()  # those of a policy that hardly learned
    nht.train_map(
        demos, nht.NHT(10, 7, 2, hidden=(8,)), context_keys=["tool_position", "joint_angle"], max_steps=5
    )
    assert collect(tmp_path / "again", *overrides).fingerprint == demos.fingerprint


def test_where_a_task_knows_no_success_the_return_decides():
    env = nht.envs.make_env("wam_wipe", num_envs=8, seed=0, max_episode_steps=30)
    expert = nht.envs.make_expert("wam_wipe")

    def act(current):
        return current.set(
            "action", torch.from_numpy(expert({key: current[key].numpy() for key in keys})).float()
        )

    keys = list(env.task.observation_sizes)
    data, left_out = record_episodes(
        env, env.task, act, DemosConfig(transitions=120, min_return=-20.0), judged=False
    )
    returns = torch.zeros(int(data["episode"][-1]) + 1).index_add(
        0, data["episode"], data["reward"].squeeze(-1)
    )
    assert (returns >= -20).all()
    assert left_out > 0
    with pytest.raises(
        RuntimeError, match=r"no episode in 2,400 steps had a success and a return of at least 5.0"
    ):
        record_episodes(env, env.task, act, DemosConfig(transitions=10, min_return=5.0), judged=True)
    env.close()
    assert has_success("wam_wipe")
    assert endings("no task of ours") == {}


@pytest.mark.parametrize(
    ("overrides", "error", "message"),
    [
        (
            ["source=youtube"],
            ValueError,
            r"Could not find 'source/youtube'.*expert.*hdf5.*minari.*policy.*tensordict",
        ),
        (
            ["demos.disturbance=-1"],
            ValueError,
            r"demos.disturbance must be at least 0, got -1",
        ),
        (
            ["source.kind=youtube"],
            ValueError,
            r"unknown source.kind 'youtube': choose from \['expert', 'policy', 'min",
        ),
        (["source=minari"], ValueError, r"source=minari needs source.path: the id of a local Minari dataset"),
        (["source=policy"], ValueError, r"source=policy needs source.path: the folder of a finished run"),
        (["source=policy", "source.path=."], FileNotFoundError, r"holds no run: it has no config.yaml"),
        (
            ["source=tensordict", "source.path=."],
            FileNotFoundError,
            r"holds no TensorDict: there is no meta.json",
        ),
    ],
)
def test_a_source_that_is_none(overrides, error, message, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    with pytest.raises(error, match=re.compile(message, re.DOTALL)):
        collect(tmp_path / "demos", *overrides)
    assert not list(tmp_path.iterdir())


def test_a_source_of_another_task(run, wiping, tmp_path):
    pytest.importorskip("minari")
    nht.to_minari(nht.load_demos(wiping), "wipe-v0", env="nht/WAMWipe-v0")
    out, wipe = tmp_path / "demos", ["source=minari", "source.path=wipe-v0"]
    path = write_hdf5(tmp_path / "toy.hdf5")
    for overrides, error, message in (
        (
            [*wipe, "env.name=half_cheetah"],
            ValueError,
            r"wipe-v0 .* env 'nht/WAMWipe-v0', expected 'half_cheetah'",
        ),
        (wipe, KeyError, r"context key 'tool_position' is not in the demonstrations, which have 'actuation'"),
        ([*wipe, "source.done_key=over"], ValueError, r"source.done_key is not for source=minari"),
        (
            ["source=hdf5", f"source.path={path}", "env.context_keys=[observation]"],
            ValueError,
            r"toy.hdf5 does not fit wam_wipe: 'actuation' has 3 entries, the task's 7",
        ),
        (
            [*wipe, "source.context={joint_angle: observation}", "env.context_keys=[joint_angle]"],
            ValueError,
            r"wipe-v0 does not fit wam_wipe: 'joint_angle' has 16 entries, the task's 7",
        ),
        (
            [*wipe, "env.context_keys=[observation]", "demos.min_return=1"],
            ValueError,
            r"none of \d+ episodes has a return of at least demos.min_return=1.0: the best has 0",
        ),
        (
            ["source=policy", f"source.path={run}", "env.name=half_cheetah"],
            ValueError,
            r"is a run of env 'wam_wipe', expected 'half_cheetah'",
        ),
    ):
        with pytest.raises(error, match=message):
            collect(out, *overrides)
        assert not out.exists()
    assert len(collect(out, *wipe, "env.context_keys=[observation]")) == len(nht.load_demos(wiping))
    named = [*wipe, "env.name=wiping", "source.env=wam_wipe", "env.context_keys=[observation]"]
    assert collect(tmp_path / "named", *named).manifest["env"] == "wiping"
