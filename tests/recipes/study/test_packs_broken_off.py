"""Runs that train together, broken off near their end: taken up again, they end as if nothing had happened."""

from __future__ import annotations

from pathlib import Path

import pytest

from nht.recipes import search
from nht.recipes.study.jobs import Ending, Job, run_job
from nht.recipes.study.packs import Pack, run_pack

TOLD = (
    "map=none",
    "env.num_envs=4",
    "env.options.max_episode_steps=25",
    "algo.frames_per_batch=100",
    "algo.hidden=[16,16]",
    "algo.updates_per_batch=1",
    "algo.warmup_frames=0",
    "algo.buffer_size=1000",
    "algo.total_frames=200",
    "evaluation.every=200",
    "evaluation.episodes=2",
    "evaluation.video=false",
    "run.checkpoint_every=100",
    "run.wandb=false",
)


def job(seed: int) -> Job:
    return Job("search", "wam_wipe", "raw", 0, seed, "ddpg", "success", {}, (*TOLD, f"seed={seed}"))


PACK = Pack((job(0), job(1)))


def files(folder: Path) -> list[str]:
    """All but what a run has said, which it says where it is trained: beside others, or alone."""
    found = (path for path in folder.rglob("*") if path.is_file() and path.name != "train.log")
    return sorted(str(path.relative_to(folder)) for path in found)


@pytest.fixture(scope="module")
def whole(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("whole")
    run_pack(PACK, folder)
    return folder


def assert_ended(folder: Path, whole: Path) -> None:
    assert files(folder) == files(whole)
    assert not [
        name for name in files(folder) if "checkpoint" in name or "members" in name or "claims" in name
    ]
    for one in PACK.jobs:
        assert Ending.read(folder / one.name) == Ending("done")
        policies = [(path / one.name / "policy.safetensors").read_bytes() for path in (folder, whole)]
        assert policies[0] == policies[1]


@pytest.mark.parametrize("written", [pytest.param(0, marks=pytest.mark.slow), 1])
def test_broken_off_between_outcomes(
    written: int, whole: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    write, left = Ending.write, [None] * written

    def break_off(self: Ending, run: Path) -> None:
        if not left:
            raise KeyboardInterrupt
        left.pop()
        write(self, run)

    with monkeypatch.context() as patched:
        patched.setattr(Ending, "write", break_off)
        with pytest.raises(KeyboardInterrupt):
            run_pack(PACK, tmp_path)
    run_pack(PACK, tmp_path)
    assert_ended(tmp_path, whole)


def test_broken_off_while_it_notes_who_trains_together(
    whole: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def break_off(self: Path, text: str) -> int:
        self.open("w").close()  # empty, as a file is that is just being written
        raise KeyboardInterrupt

    with monkeypatch.context() as patched:
        patched.setattr(Path, "write_text", break_off)
        with pytest.raises(KeyboardInterrupt):
            run_pack(PACK, tmp_path)
    run_pack(PACK, tmp_path)
    assert_ended(tmp_path, whole)


def test_a_run_alone_has_no_checkpoints_left_once_its_outcome_stands(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    write = Ending.write

    def break_off(self: Ending, run: Path) -> None:
        write(self, run)
        raise KeyboardInterrupt

    monkeypatch.setattr(Ending, "write", break_off)
    with pytest.raises(KeyboardInterrupt):
        run_job(job(0), tmp_path)
    assert Ending.read(tmp_path / job(0).name) == Ending("done")
    assert not list(tmp_path.rglob("checkpoint*"))


def test_claims_of_killed_processes_are_removed(tmp_path: Path) -> None:
    claims = tmp_path / "claims"
    claims.mkdir()
    (claims / "search-raw-000-seed0").write_text('{"host": "here", "pid": 1}')
    one = job(0)
    Ending("failed", "for a test").write(tmp_path / one.name)
    search.run_all([one], tmp_path, None, {})
    assert list(claims.iterdir()) == []
