from __future__ import annotations

import os
import signal
from pathlib import Path

import pytest

import fresh_process
from nht.writing import publish, replacing, scratch


def write(path: Path, text: str) -> None:
    with replacing(path) as place:
        assert place.name == path.name
        place.write_text(text)


def write_and_be_killed(path: Path) -> None:
    """Write, and be killed when all is written but not yet in its place."""
    os.rename = lambda *_: os.kill(os.getpid(), signal.SIGKILL)  # type: ignore[assignment]
    write(path, "never seen")


def test_a_file_is_replaced_whole_and_nothing_else_stays(tmp_path: Path) -> None:
    path = tmp_path / "folder" / "table.csv"
    for text in ("old", "new"):
        write(path, text)
        assert path.read_text() == text
    assert list(path.parent.iterdir()) == [path]


def test_a_writer_that_fails_leaves_the_file_as_it_was(tmp_path: Path) -> None:
    path = tmp_path / "table.csv"
    write(path, "old")
    with pytest.raises(UnicodeEncodeError):
        write(path, "\ud800")
    with pytest.raises(FileNotFoundError), replacing(path):
        pass  # nothing was written
    assert path.read_text() == "old"
    assert list(tmp_path.iterdir()) == [path]


def test_what_a_killed_process_left_is_removed_by_the_next_and_what_lives_stays(tmp_path: Path) -> None:
    path = tmp_path / "table.csv"
    write(path, "old")
    folders = [str(Path(__file__).parent), str(Path(__file__).parents[1] / "support")]
    code = f"import sys; sys.path[:0] = {folders}; import test_writing; from pathlib import Path; "
    process = fresh_process.run(code + f"test_writing.write_and_be_killed(Path({str(path)!r}))")
    assert process.returncode == -signal.SIGKILL, process.stderr
    assert path.read_text() == "old"
    (left,) = set(tmp_path.iterdir()) - {path}
    assert left.name.startswith(".table.csv.")
    with scratch(path) as living:
        assert not left.exists()
        living.mkdir()
        write(path, "new")
        assert living.exists()
    assert list(tmp_path.iterdir()) == [path]


def test_what_has_no_owner_is_removed_when_it_is_old(tmp_path: Path) -> None:
    old, recent = tmp_path / f".demos.{32 * '0'}", tmp_path / f".demos.{32 * '1'}"
    for folder in (old, recent):
        folder.mkdir()
    os.utime(old, (0, 0))
    with scratch(tmp_path / "demos"):
        assert list(tmp_path.iterdir()) == [recent]


def test_a_folder_is_not_published_over_another(tmp_path: Path) -> None:
    path = tmp_path / "demos"
    path.mkdir()
    with scratch(path) as place:
        place.mkdir()
        with pytest.raises(FileExistsError, match="exists by now"):
            publish(place, path)
