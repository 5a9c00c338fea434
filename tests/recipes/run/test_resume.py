"""Stopped in any way, a run goes on exactly as if it had not been: killed, told to end, out of room, broken files."""

import errno
import os
import pickle
import shutil
import signal
import zipfile
from pathlib import Path

import pandas
import pytest
import torch
from torchrl.checkpoint import Checkpoint, CheckpointRotation

import killed_runs
import tiny_runs
from nht.recipes.run import checkpoints, folder
from nht.recipes.run.checkpoint_file import CheckpointFile
from nht.recipes.run.checkpoint_writing import write_checkpoint
from nht.recipes.run.folder import RunFolder
from nht.recipes.run.record import Record
from nht.recipes.run.statistics import Counters
from nht.recipes.sections import RunConfig

SETTINGS = ["algo.total_frames=600", "evaluation.every=300"]


def train(algorithm: str, folder: Path, *overrides: str) -> pandas.DataFrame:
    return tiny_runs.train(algorithm, folder, *SETTINGS, *overrides)


@pytest.fixture(scope="module", params=tiny_runs.RECIPES)
def whole(request, tmp_path_factory):
    """The algorithm, and a run that nothing stopped: its folder and metrics."""
    folder = tmp_path_factory.mktemp(request.param) / "whole"
    return request.param, folder, train(request.param, folder)


def assert_same(folder: Path, metrics: pandas.DataFrame, whole) -> None:
    pandas.testing.assert_frame_equal(metrics, whole[2])
    weights = [(path / "policy.safetensors").read_bytes() for path in (folder, whole[1])]
    assert weights[0] == weights[1]


@pytest.mark.parametrize("checkpoint", [1, 2])
def test_killed_while_writing_a_checkpoint(whole, checkpoint, tmp_path):
    killed_runs.kill_at_checkpoint(checkpoint, whole[0], tmp_path / "run", SETTINGS)
    written = tmp_path / "run" / "checkpoints"
    assert len(list(written.glob("checkpoint-*"))) == checkpoint - 1
    assert list(written.glob(".*"))
    metrics = train(whole[0], tmp_path / "run", "run.resume=auto")
    assert_same(tmp_path / "run", metrics, whole)
    assert not list(written.glob(".*"))


@pytest.mark.parametrize("number", [signal.SIGTERM, signal.SIGINT])
def test_told_to_end_between_two_evaluations(whole, number, tmp_path, monkeypatch, capsys):
    before, count = signal.getsignal(number), Record.count_steps

    def tell(self, data):
        count(self, data)
        if self.counters.frames == 500:
            os.kill(os.getpid(), number)
            os.kill(os.getpid(), number)  # its echo: `timeout` tells the process and then its group

    with monkeypatch.context() as patched:
        patched.setattr(Record, "count_steps", tell)
        with pytest.raises(SystemExit) as stopped:
            train(whole[0], tmp_path / "run")
    assert signal.getsignal(number) == before
    assert stopped.value.code == 128 + number
    assert "was told to end: go on with run.resume=true" in capsys.readouterr().out
    assert (tmp_path / "run" / "checkpoints" / "checkpoint-000000000500.torchrl").exists()
    assert_same(tmp_path / "run", train(whole[0], tmp_path / "run", "run.resume=true"), whole)


@pytest.mark.parametrize("resume", ["auto", "true", "false"])
def test_a_run_that_is_whole_is_left_as_it_is(whole, resume, monkeypatch, capsys):
    def refuse(*_):
        raise AssertionError("a run on W&B was begun")

    monkeypatch.setattr(folder, "open_dashboard", refuse)
    before = {path: path.stat().st_mtime_ns for path in whole[1].rglob("*")}
    told = [f"run.resume={resume}", "run.wandb=true", "algo.total_frames=300"]
    pandas.testing.assert_frame_equal(train(whole[0], whole[1], *told), whole[2])
    assert {path: path.stat().st_mtime_ns for path in whole[1].rglob("*")} == before
    assert "policy.safetensors" in capsys.readouterr().out


def break_off(algorithm: str, folder: Path) -> list[Path]:
    """A run that breaks off a moment before its end; its checkpoints, oldest first."""
    log = RunFolder.log

    def end(self, frames, row):
        if frames == 600:
            raise KeyboardInterrupt
        log(self, frames, row)

    with pytest.MonkeyPatch.context() as patched:
        patched.setattr(RunFolder, "log", end)
        with pytest.raises(KeyboardInterrupt):
            train(algorithm, folder)
    return checkpoints_in(folder)


def checkpoints_in(folder: Path) -> list[Path]:
    return sorted((folder / "checkpoints").glob("checkpoint-*"))


@pytest.fixture(scope="module")
def once_broken_off(whole, tmp_path_factory):
    folder = tmp_path_factory.mktemp(whole[0]) / "broken off"
    break_off(whole[0], folder)
    return folder


@pytest.fixture
def broken_off(once_broken_off, tmp_path):
    """The checkpoints of a run in ``tmp_path / "run"`` that broke off."""
    shutil.copytree(once_broken_off, tmp_path / "run")
    return checkpoints_in(tmp_path / "run")


def cut_short(checkpoint: Path) -> None:
    os.truncate(checkpoint, checkpoint.stat().st_size // 2)


def flip_a_bit(checkpoint: Path) -> None:
    with zipfile.ZipFile(checkpoint) as archive:
        largest = max(archive.infolist(), key=lambda entry: entry.file_size)
    content = bytearray(checkpoint.read_bytes())
    content[largest.header_offset + largest.file_size // 2] ^= 1
    checkpoint.write_bytes(content)


@pytest.mark.parametrize("damage", [cut_short, flip_a_bit])
def test_a_broken_checkpoint_is_passed_over(whole, broken_off, damage, tmp_path):
    _, newest = broken_off
    damage(newest)
    with pytest.warns(UserWarning, match=rf"{newest} cannot be read and is passed over"):
        metrics = train(whole[0], tmp_path / "run", "run.resume=true")
    assert_same(tmp_path / "run", metrics, whole)


def save_as_torchrl(self: checkpoints.Checkpoints, frames: int) -> None:
    """As earlier versions wrote checkpoints: TorchRL's archive, in which a buffer's queue is pickled."""
    parts = {name: getattr(part, "_buffer", part) for name, part in self._parts.items()}
    rotation = CheckpointRotation(self._folder, keep_last=2)
    rotation.save(Checkpoint(**parts, format="archive"), step=frames)


def test_checkpoints_of_earlier_versions_are_read_without_unpickling(whole, tmp_path, monkeypatch):
    with monkeypatch.context() as patched:
        patched.setattr(checkpoints.Checkpoints, "save", save_as_torchrl)
        _, newest = break_off(whole[0], tmp_path / "run")
    with zipfile.ZipFile(newest) as archive:
        assert any(name.endswith("prefetch.pkl") for name in archive.namelist()) == (whole[0] != "ppo")

    def refuse(*_, **__):
        raise AssertionError("unpickled")

    for module, name in ((pickle, "load"), (pickle, "loads"), (pickle, "Unpickler"), (torch, "load")):
        monkeypatch.setattr(module, name, refuse)
    assert_same(tmp_path / "run", train(whole[0], tmp_path / "run", "run.resume=true"), whole)


def test_torchrl_reads_our_checkpoints(whole):
    checkpoint = max((whole[1] / "checkpoints").glob("checkpoint-*"))
    counters = Counters()
    Checkpoint(counters=counters).load(checkpoint)
    assert counters.frames == 600


def rewritten(checkpoint: Path, change) -> None:
    """The archive with other contents of members, and right checksums of ZIP."""
    with zipfile.ZipFile(checkpoint) as archive:
        members = {name: archive.read(name) for name in archive.namelist()}
    change(members)
    with zipfile.ZipFile(checkpoint, "w") as archive:
        for name, content in members.items():
            archive.writestr(name, content)


def change_weights(members: dict[str, bytes]) -> None:
    name = max((name for name in members if "-loss/" in name), key=lambda name: len(members[name]))
    members[name] = members[name][:-1] + bytes([members[name][-1] ^ 1])


def test_memory_mapped_parts_that_were_changed_are_noticed(whole, broken_off, tmp_path):
    _, newest = broken_off
    rewritten(newest, change_weights)
    with pytest.warns(UserWarning, match=r"checkpoint-\d+.*was changed since it was written: its checksum"):
        metrics = train(whole[0], tmp_path / "run", "run.resume=true")
    assert_same(tmp_path / "run", metrics, whole)


def test_networks_that_are_not_finite_are_refused(whole, broken_off, tmp_path):
    for checkpoint in broken_off:
        with CheckpointFile(checkpoint) as file:
            states = file.read()
        name = next(name for name in states["loss"] if name.endswith("weight"))
        states["loss"][name][0, 0] = float("nan")
        checkpoint.unlink()
        write_checkpoint(checkpoint, states)
    with pytest.raises(ValueError, match=r"checkpoint-\d+.torchrl, 'loss': .*weight holds 1 NaN or infinite"):
        train(whole[0], tmp_path / "run", "run.resume=true")


def test_stray_files_are_passed_over(whole, broken_off, tmp_path):
    folder = tmp_path / "run" / "checkpoints"
    for name in ("notes", "checkpoint-000000000300 (1).torchrl", "checkpoint-last", ".mine"):
        (folder / name).write_text("hello")
    assert_same(tmp_path / "run", train(whole[0], tmp_path / "run", "run.resume=true"), whole)
    assert (folder / "notes").exists()
    assert (folder / ".mine").exists()


def test_nothing_but_broken_checkpoints(whole, broken_off, tmp_path):
    for checkpoint in broken_off:
        cut_short(checkpoint)
    with (
        pytest.warns(UserWarning, match="cannot be read"),
        pytest.raises(ValueError, match=r"none of the checkpoints in .* can be read"),
    ):
        train(whole[0], tmp_path / "run", "run.resume=true")


def test_a_row_cut_short_is_written_again(whole, broken_off, tmp_path):
    with (tmp_path / "run" / "metrics.csv").open("a") as file:
        file.write("30")  # of 300,0.0,...
    assert_same(tmp_path / "run", train(whole[0], tmp_path / "run", "run.resume=true"), whole)


def test_a_run_that_lacks_only_its_policy_is_finished(whole, tmp_path):
    folder = tmp_path / "run"
    shutil.copytree(whole[1], folder)
    (folder / "policy.safetensors").unlink()
    (folder / "whole.json").unlink()
    before = pandas.read_csv(folder / "metrics.csv")
    assert_same(folder, train(whole[0], folder, "run.resume=auto"), whole)
    pandas.testing.assert_frame_equal(pandas.read_csv(folder / "metrics.csv"), before)


def test_a_run_that_is_whole_says_so_and_stays(whole, tmp_path, capsys):
    folder = tmp_path / "run"
    shutil.copytree(whole[1], folder)
    before = {path: path.stat().st_mtime_ns for path in folder.rglob("*") if path.name != "config.yaml"}
    assert_same(folder, train(whole[0], folder, "run.resume=auto"), whole)
    assert f"{folder}: " in capsys.readouterr().out
    after = {path: path.stat().st_mtime_ns for path in before if path.is_file()}
    assert after == {path: before[path] for path in after}


def test_the_clock_goes_on(whole, broken_off, tmp_path):
    metrics = tmp_path / "run" / "metrics.csv"
    pandas.read_csv(metrics).assign(seconds=1000.0).to_csv(metrics, index=False)
    train(whole[0], tmp_path / "run", "run.resume=true")
    assert pandas.read_csv(metrics)["seconds"].iloc[-1] > 1000.0


@pytest.mark.parametrize("warned", [True, False])
def test_a_full_disk(whole, broken_off, tmp_path, monkeypatch, warned):
    def full(*_):
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    with monkeypatch.context() as patched:
        if warned:
            room = shutil.disk_usage(tmp_path)._replace(free=1000)
            patched.setattr(shutil, "disk_usage", lambda _: room)
            reason = r"the next takes [\d.]+ MB, only 0\.0 MB are left in .*checkpoints"
        else:
            patched.setattr(checkpoints, "publish", full)
            reason = "No space left on device"
        match = rf"no checkpoint after 600 steps: {reason}. The last one is .*checkpoint-000000000400"
        with pytest.raises(OSError, match=match):
            train(whole[0], tmp_path / "run", "run.resume=true")
    assert_same(tmp_path / "run", train(whole[0], tmp_path / "run", "run.resume=true"), whole)


def test_a_run_without_a_checkpoint_cannot_go_on_but_begin_anew(whole, broken_off, tmp_path):
    shutil.rmtree(tmp_path / "run" / "checkpoints")
    (tmp_path / "run" / "metrics.csv").write_text("frames,tra")
    with pytest.raises(FileNotFoundError, match="holds no checkpoint to resume from"):
        train(whole[0], tmp_path / "run", "run.resume=true")
    assert_same(tmp_path / "run", train(whole[0], tmp_path / "run", "run.resume=auto"), whole)


def test_ways_to_resume():
    with pytest.raises(ValueError, match=r"run\.resume must be true, false or auto, got 'yes'"):
        RunConfig(resume="yes")
