"""Minari datasets, read and written; what is told of those that are damaged or not here."""

import json
import re
import sys
from pathlib import Path

import numpy as np
import pytest

import nht
import nht.envs
from nht.recipes import collect_demos
from nht.recipes.config import CollectDemos
from nht.recipes.launch import configure
from toy_demos import demonstrations, episodes, same


@pytest.fixture(autouse=True)
def minari_home(tmp_path, monkeypatch):
    """Minari's datasets are those of the test."""
    monkeypatch.setenv("MINARI_DATASETS_PATH", str(tmp_path / "home"))
    return tmp_path / "home"


@pytest.mark.parametrize("observation_keys", [None, ["observation"], ["joint"]])
def test_what_minari_was_given_comes_back_bit_for_bit(observation_keys, minari_home):
    spaces = pytest.importorskip("gymnasium.spaces")
    pytest.importorskip("minari")
    demos = demonstrations()
    dataset = nht.to_minari(demos, "toy/three-v0", observation_keys=observation_keys)
    assert (dataset.total_episodes, dataset.total_steps) == (3, 15)
    assert dataset.action_space == spaces.Box(-np.inf, np.inf, (3,), np.float32)
    if observation_keys == ["observation"]:
        assert dataset.observation_space == spaces.Box(-np.inf, np.inf, (4,), np.float32)
    else:
        assert isinstance(dataset.observation_space, spaces.Dict)
        assert dataset.observation_space["joint"] == spaces.Box(-np.inf, np.inf, (2,), np.float64)
    within = observation_keys or ["joint", "observation"]
    context = {key: key if key in within else f"infos/{key}" for key in ("observation", "joint")}
    places = ["toy/three-v0", minari_home / "toy/three-v0", minari_home / "toy/three-v0/data/main_data.hdf5"]
    for place in [dataset, *places]:
        found = nht.from_minari(place, context=context)
        assert same(found, episodes())
        assert found.fingerprint == demos.fingerprint
        assert found.manifest["expert"] == "Toy"
    default = nht.from_minari(dataset)
    assert set(default.data.keys()) & set(context) == set(within)


@pytest.fixture(scope="module")
def wiping(tmp_path_factory):
    path = tmp_path_factory.mktemp("wiping") / "demos"
    collect_demos.main(configure(CollectDemos, "collect_demos", ["demos.transitions=300", f"out={path}"]))
    return path


def test_a_minari_dataset_has_the_spec_and_the_spaces_of_its_env(wiping, minari_home):
    pytest.importorskip("minari")
    demos = nht.load_demos(wiping)
    dataset = nht.to_minari(demos, "wam/wipe-v0", env="nht/WAMWipe-v0")
    env = dataset.recover_environment()
    assert dataset.spec.env_spec.id == "nht/WAMWipe-v0"
    assert (dataset.action_space, dataset.observation_space) == (env.action_space, env.observation_space)
    context = {key: f"infos/{key}" for key in ("joint_angle", "tool_position", "goal")}
    found = nht.from_minari(
        "wam/wipe-v0", env="nht/WAMWipe-v0", context=context | {"observation": "observation"}
    )
    assert found.fingerprint == demos.fingerprint
    env.close()


def test_a_dataset_that_others_wrote():
    minari = pytest.importorskip("minari")
    from gymnasium.spaces import Box, Dict, Text
    from minari.data_collector import EpisodeBuffer

    generator = np.random.default_rng(0)
    buffers = [
        EpisodeBuffer(
            observations={
                "achieved": generator.normal(size=(4, 2)),
                "hand": {"joints": generator.normal(size=(4, 3))},
                "order": ["open"] * 4,
            },
            actions=generator.normal(size=(3, 5)).astype(np.float32),
            rewards=[0.0, 0.5, 1.0],
            terminations=[False] * 3,
            truncations=[False, False, whole],
            infos={"success": [False, False, True, True], "name": ["x"] * 4},
        )
        for whole in (True, False)
    ]
    space = Dict({"achieved": Box(-9, 9, (2,)), "hand": Dict({"joints": Box(-9, 9, (3,))}), "order": Text(9)})
    with pytest.warns(UserWarning, match="author"):
        minari.create_dataset_from_buffers(
            "others-v3", buffers, observation_space=space, action_space=Box(-1, 1, (5,))
        )
    found = nht.from_minari("others-v3")
    assert (len(found), found.manifest["settings"]["left_out_episodes"]) == (3, 1)
    achieved = buffers[0].observations["achieved"]
    np.testing.assert_array_equal(found.data["achieved"], achieved[:-1])
    np.testing.assert_array_equal(found.data["next", "achieved"], achieved[1:])
    assert found.data["hand", "joints"].shape == (3, 3)
    assert found.data["success"].squeeze(-1).tolist() == [False, True, True]
    assert found.data["reward"].squeeze(-1).tolist() == [0.0, 0.5, 1.0]
    assert "order" not in found.data
    assert found.manifest["settings"]["left_out_observations"] == ["order"]


def test_observations_in_tuples_are_all_taken():
    minari = pytest.importorskip("minari")
    from gymnasium.spaces import Box, Dict, Tuple
    from minari.data_collector import EpisodeBuffer

    generator = np.random.default_rng(0)
    first, second, third = (generator.normal(size=(4, width)) for width in (2, 3, 1))
    space = Dict({"hand": Tuple((Box(-9, 9, (2,)), Box(-9, 9, (3,)))), "height": Box(-9, 9, (1,))})
    buffer = EpisodeBuffer(
        observations={"hand": (first, second), "height": third},
        actions=np.zeros((3, 5), np.float32),
        rewards=[0.0] * 3,
        terminations=[False, False, True],
        truncations=[False] * 3,
        infos={},
    )
    with pytest.warns(UserWarning, match="author"):
        minari.create_dataset_from_buffers(
            "tuple-v0", [buffer], observation_space=space, action_space=Box(-1, 1, (5,))
        )
    found = nht.from_minari("tuple-v0")
    for key, values in {("hand", "0"): first, ("hand", "1"): second, "height": third}.items():
        np.testing.assert_array_equal(found.data[key], values[:-1])
        np.testing.assert_array_equal(found.data["next"][key], values[1:])
    assert "left_out_observations" not in found.manifest["settings"]
    chosen = nht.from_minari("tuple-v0", context={"fingers": "hand/1"})
    np.testing.assert_array_equal(chosen.data["fingers"], second[:-1])


def test_a_minari_dataset_that_is_not_here_or_of_another_env(minari_home):
    pytest.importorskip("minari")
    nht.to_minari(demonstrations(), "toy-v0")
    with pytest.raises(FileNotFoundError, match=r"door-v0 is neither the folder .*there are \['toy-v0'\]"):
        nht.from_minari("door-v0")
    with pytest.raises(ValueError, match=r"toy-v0 holds demonstrations of env 'unknown', expected 'Ant-v5'"):
        nht.from_minari("toy-v0", env="Ant-v5")
    with pytest.raises(
        KeyError, match=r"\['infos/elbow'\] are not in episode 0 of toy-v0, which has .*'joint'"
    ):
        nht.from_minari("toy-v0", context=["infos/elbow", "joint"])


def damage_cut(folder: Path) -> None:
    file = folder / "main_data.hdf5"
    file.write_bytes(file.read_bytes()[: file.stat().st_size // 2])


def damage_missing(folder: Path) -> None:
    import h5py

    with h5py.File(folder / "main_data.hdf5", "a") as file:
        del file["episode_2"]


def damage_actions(folder: Path) -> None:
    import h5py

    with h5py.File(folder / "main_data.hdf5", "a") as file:
        del file["episode_1/actions"]
        file["episode_1/actions"] = np.zeros((3, 4), dtype=np.float32)


def damage_observations(folder: Path) -> None:
    import h5py

    with h5py.File(folder / "main_data.hdf5", "a") as file:
        kept = file["episode_1/observations/joint"][:-1]
        del file["episode_1/observations/joint"]
        file["episode_1/observations/joint"] = kept


def damage_spaces(folder: Path) -> None:
    metadata = folder / "metadata.json"
    about = json.loads(metadata.read_text())
    about["observation_space"] = about["observation_space"].replace('"joint"', '"elbow"')
    metadata.write_text(json.dumps(about))


def damage_metadata(folder: Path) -> None:
    (folder / "metadata.json").write_text('{"total_episodes": 3')


@pytest.mark.parametrize(
    ("damage", "message"),
    [
        (
            damage_cut,
            r"the Minari dataset toy-v0 cannot be read: .*main_data.hdf5 cannot be read, it is cut short",
        ),
        (damage_missing, r"toy-v0 cannot be read: .*metadata.json says 3 episodes, main_data.hdf5 has 2"),
        (damage_actions, r"actions in episode 1 of toy-v0 must have shape \(3, 3\), got \(3, 4\)"),
        (
            damage_observations,
            r"entry 'joint' of the observations in episode 1 of toy-v0 must have shape \(4, 2\)",
        ),
        (damage_spaces, r"toy-v0 cannot be read, it may be cut short or of another env: 'joint'"),
        (
            damage_metadata,
            r"the Minari dataset toy-v0 cannot be read: .*metadata.json is not JSON: Expecting",
        ),
    ],
)
def test_a_damaged_minari_dataset_is_refused_and_nothing_is_written(damage, message, minari_home, tmp_path):
    pytest.importorskip("minari")
    nht.to_minari(demonstrations(), "toy-v0")
    damage(minari_home / "toy-v0" / "data")
    with pytest.raises(ValueError, match=message):
        nht.from_minari("toy-v0")
    out = tmp_path / "out" / "demos"
    overrides = ["source=minari", "source.path=toy-v0", "env.name=toy", f"out={out}"]
    with pytest.raises(ValueError, match=message):
        collect_demos.main(configure(CollectDemos, "collect_demos", overrides))
    assert not out.parent.exists()


@pytest.mark.parametrize(
    ("change", "arguments", "message"),
    [
        (lambda data: data.exclude("reward"), {}, r"needs reward, which the demonstrations lack"),
        (lambda data: data.exclude("next"), {}, r"needs observations under 'next', which"),
        (
            lambda data: data,
            {"observation_keys": ["elbow"]},
            r"\['elbow'\] are not among .*\['joint', 'observation'\]",
        ),
        (
            lambda data: data,
            {"env": "nht/WAMWipe-v0"},
            r"as a dataset of env nht/WAMWipe-v0.*must have shape \(6, 16\)",
        ),
        (lambda data: data.roll(1), {}, r"hold under 'next' another one"),
    ],
)
def test_what_minari_cannot_hold_leaves_nothing_behind(change, arguments, message, minari_home):
    pytest.importorskip("minari")
    data = episodes()
    if "another one" in message:
        data["next", "joint"] = data["next", "joint"].roll(1, 0)
    else:
        data = change(data)
    with pytest.raises(ValueError, match=message):
        nht.to_minari(nht.Demos.from_episodes(data), "toy-v0", **arguments)
    assert not (minari_home / "toy-v0").exists()


def test_minari_datasets_are_never_overwritten_and_have_proper_names(minari_home):
    pytest.importorskip("minari")
    demos = demonstrations()
    nht.to_minari(demos, "toy-v0")
    with pytest.raises(
        FileExistsError, match=r"the Minari dataset toy-v0 exists: choose another name or version"
    ):
        nht.to_minari(demos, "toy-v0")
    assert nht.from_minari("toy-v0").fingerprint == demos.fingerprint
    with pytest.raises(ValueError, match=r"Malformed dataset ID"):
        nht.to_minari(demos, "no good name")
    assert [entry.name for entry in minari_home.iterdir()] == ["toy-v0"]


@pytest.mark.parametrize(
    ("package", "use"),
    [("minari", lambda: nht.from_minari("toy-v0")), ("h5py", lambda: nht.from_hdf5("toy.h5"))],
)
def test_a_missing_package_is_named_with_the_way_to_get_it(package, use, monkeypatch):
    monkeypatch.setitem(sys.modules, package, None)
    with pytest.raises(ImportError, match=re.escape("pip install 'nht[minari]'")):
        use()
