"""What people do becomes demonstrations that maps are trained on."""

import pytest
import torch

import nht
from nht.recipes import train_map
from nht.recipes.config import TrainMap
from nht.recipes.launch import configure
from nht.recipes.live.recording import free_folder
from steered import moves, session


@pytest.fixture
def taught(tmp_path):
    """Two episodes, taught through the Jacobian."""
    opened = session(f"out={tmp_path / 'by-hand'}", "seed=2")
    opened.choose("jacobian")
    opened.record(True)
    moves(opened, [0.0] * 6, 3)
    moves(opened, [0.8, 0.3, 0, 0, 0, 0], 12)
    opened.next_goal()
    moves(opened, [-0.4, 0.9, 0, 0, 0, 0], 15)
    opened.record(False)
    yield opened
    opened.close()


def test_episodes_begin_with_the_first_motion_and_end_where_they_are_cut(taught):
    demos = taught.recorder.demos()
    assert demos.episode.bincount().tolist() == [12, 15]
    assert demos.data["done"].nonzero()[:, 0].tolist() == [11, 26]
    assert demos.data["truncated"].nonzero()[:, 0].tolist() == [11, 26]
    assert (demos.manifest["env"], demos.manifest["expert"]) == ("wam_wipe", "person")


def test_every_step_follows_from_the_one_before(taught):
    data = taught.recorder.demos().data[:12]
    for key in ("joint_angle", "tool_position"):
        assert torch.equal(data["next", key][:-1], data[key][1:])
    moved = data["next", "joint_angle"] - data["joint_angle"]
    assert torch.allclose(moved / 0.02, data["actuation"], atol=0.02)  # [rad/s]


def test_what_was_recorded_trains_a_map(taught, tmp_path):
    taught.save()
    words = [f"demos.path={tmp_path / 'by-hand'}", "map=svd", f"out={tmp_path / 'map.safetensors'}"]
    train_map.main(configure(TrainMap, "train_map", words))
    map = nht.load_map(tmp_path / "map.safetensors")
    demos = nht.load_demos(tmp_path / "by-hand")
    error = nht.train.projection_error(map, demos.context(map.context_keys), demos.actuation)
    assert error < 0.2
    again = session(f"map.file={tmp_path / 'map.safetensors'}")
    assert next(iter(again.interfaces)) == "svd"
    again.close()


def test_saving_twice_makes_two_folders_and_tells_how_to_go_on(taught, tmp_path):
    taught.save()
    assert taught.message.endswith(f"python -m nht.recipes.train_map demos.path={tmp_path / 'by-hand'}")
    taught.record(True)
    moves(taught, [0.5, 0, 0, 0, 0, 0], 4)
    taught.save()
    assert len(nht.load_demos(tmp_path / "by-hand-2")) == 4
    assert free_folder(tmp_path / "by-hand").name == "by-hand-3"


def test_an_end_in_mid_recording_loses_nothing(tmp_path):
    opened = session(f"out={tmp_path / 'kept'}")
    opened.record(True)
    moves(opened, [0.5, 0, 0, 0, 0, 0], 6)
    opened.close()
    assert len(nht.load_demos(tmp_path / "kept")) == 6


def test_the_last_episode_can_be_thrown_away(taught):
    taught.recorder.discard()
    assert taught.recorder.transitions == 12
    taught.record(True)
    moves(taught, [0.5, 0, 0, 0, 0, 0], 4)
    taught.recorder.discard()
    assert taught.recorder.transitions == 12
    taught.record(False)
    taught.recorder.discard()
    assert taught.recorder.transitions == 0
    with pytest.raises(ValueError, match="nothing is recorded: press record"):
        taught.save()


def test_nothing_is_kept_while_it_is_off(tmp_path):
    opened = session(f"out={tmp_path / 'none'}")
    moves(opened, [0.5, 0, 0, 0, 0, 0], 6)
    opened.close()
    assert not (tmp_path / "none").exists()


def test_a_minari_dataset_is_written_beside_it(tmp_path, monkeypatch):
    pytest.importorskip("minari")
    monkeypatch.setenv("MINARI_DATASETS_PATH", str(tmp_path / "minari"))
    opened = session(f"out={tmp_path / 'by-hand'}", "minari=wam/by-hand-v0")
    for _ in range(2):
        opened.record(True)
        moves(opened, [0.5, 0, 0, 0, 0, 0], 6)
        opened.save()
    opened.close()
    found = [
        nht.from_minari(name, context=["joint_angle"]) for name in ("wam/by-hand-v0", "wam/by-hand-2-v0")
    ]
    assert [len(demos) for demos in found] == [6, 6]
