"""Demonstrations come back as they were saved, and what is no demonstration is refused with a reason."""

import json
import os
import pickle
import shutil
import signal
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from tensordict import TensorDict
from torchrl.data import ReplayBuffer

import fresh_process
import nht
from nht.demos import Demos
from nht.demos_folder import load_demos, save_demos
from nht.reading import checksum
from nht.writing import scratch


def episodes(count: int = 4, length: int = 5) -> TensorDict:
    """Random demonstrations with two context keys, nested next entries and flags."""
    generator = torch.Generator().manual_seed(0)
    total = count * length
    last = torch.arange(total).add(1).remainder(length).eq(0).unsqueeze(-1)
    return TensorDict(
        {
            "tool_position": torch.randn(total, 3, generator=generator),
            "joint_angle": torch.randn(total, 7, generator=generator),
            "actuation": torch.randn(total, 7, generator=generator),
            "episode": torch.arange(count).repeat_interleave(length),
            "done": last,
            "success": last.clone(),
            "next": {"tool_position": torch.randn(total, 3, generator=generator)},
        },
        batch_size=total,
    )


def save(path: Path, data: TensorDict | None = None) -> Demos:
    return save_demos(
        episodes() if data is None else data,
        path,
        env="toy",
        seed=7,
        expert="scripted",
        settings={"start": "fixed"},
    )


def test_saved_demonstrations_come_back_bit_for_bit(tmp_path: Path) -> None:
    data = episodes()
    saved, loaded = save(tmp_path / "demos", data), load_demos(tmp_path / "demos", env="toy")
    for demos in (saved, loaded):
        assert len(demos) == 20
        assert set(demos.data.keys(True, True)) == set(data.keys(True, True))
        assert (demos.data == data).all()
        assert torch.equal(demos.actuation, data["actuation"])
        assert torch.equal(demos.episode, data["episode"])


def test_the_buffer_samples_from_mapped_files_and_takes_nothing(tmp_path: Path) -> None:
    demos = save(tmp_path / "demos")
    assert isinstance(demos.buffer, ReplayBuffer)
    batch = demos.buffer.sample(64)
    assert batch["actuation"].shape == (64, 7)
    assert batch["next", "tool_position"].shape == (64, 3)
    file = tmp_path / "demos" / "data" / "actuation.memmap"
    assert str(file) in Path("/proc/self/maps").read_text()
    before = file.read_bytes()
    demos.data["actuation"].zero_()
    assert file.read_bytes() == before
    with pytest.raises(RuntimeError):
        demos.buffer.extend(episodes())


def test_the_manifest_says_where_the_data_come_from(tmp_path: Path) -> None:
    manifest = save(tmp_path / "demos").manifest
    written = json.loads((tmp_path / "demos" / "manifest.json").read_text())
    assert written == manifest | {"checksum": checksum(manifest)}
    assert (manifest["env"], manifest["seed"], manifest["expert"]) == ("toy", 7, "scripted")
    assert manifest["settings"] == {"start": "fixed"}
    assert (manifest["episodes"], manifest["transitions"]) == (4, 20)
    assert manifest["keys"]["tool_position"] == {"shape": [3], "dtype": "torch.float32"}
    assert manifest["keys"]["next/tool_position"] == {"shape": [3], "dtype": "torch.float32"}
    assert {"nht", "torch", "torchrl", "tensordict"} <= manifest["versions"].keys()


def test_the_fingerprint_is_that_of_the_data_alone(tmp_path: Path) -> None:
    first = save(tmp_path / "first").fingerprint
    again = save_demos(episodes(), tmp_path / "again", env="other", seed=8, expert="someone").fingerprint
    changed = episodes()
    changed["actuation"][3, 2] += 1e-6
    renamed = episodes().rename_key_("joint_angle", "angle")
    assert first == again
    assert (
        len({first, save(tmp_path / "b", changed).fingerprint, save(tmp_path / "c", renamed).fingerprint})
        == 3
    )


def test_context_is_put_together_in_the_order_of_the_keys(tmp_path: Path) -> None:
    demos = save(tmp_path / "demos")
    context = demos.context(["tool_position", "joint_angle", ("next", "tool_position")])
    assert torch.equal(context[:, :3], demos.data["tool_position"])
    assert torch.equal(context[:, 3:10], demos.data["joint_angle"])
    assert torch.equal(context[:, 10:], demos.data["next", "tool_position"])
    assert demos.context([]).shape == (20, 0)


def test_tensors_of_ones_own_become_demonstrations() -> None:
    data = episodes()
    single = Demos.from_tensors(
        actuation=data["actuation"], episode=data["episode"].int(), context=data["joint_angle"]
    )
    several = Demos.from_tensors(
        actuation=data["actuation"],
        episode=data["episode"],
        context={"angle": data["joint_angle"], "tool": data["tool_position"]},
        env="mine",
    )
    assert torch.equal(single.context(["context"]), data["joint_angle"])
    assert several.context(["tool", "angle"]).shape == (20, 10)
    assert several.manifest["env"] == "mine"


def test_numpy_arrays_become_demonstrations() -> None:
    data = episodes()
    found = Demos.from_tensors(
        actuation=data["actuation"].numpy().astype(">f4"),
        episode=data["episode"].numpy().astype(np.uint16),
        context={"angle": data["joint_angle"].numpy().astype(np.float16)},
        next_context={"angle": data["joint_angle"].tolist()},
    )
    assert torch.equal(found.actuation, data["actuation"])
    assert torch.equal(found.episode, data["episode"])
    assert torch.equal(found.data["angle"], data["joint_angle"].half().float())
    with pytest.raises(ValueError, match=r"context, key 'order' must hold numbers or truth values.*<U4"):
        Demos.from_tensors(
            actuation=data["actuation"], episode=data["episode"], context={"order": np.array(20 * ["open"])}
        )


def test_demonstrations_are_saved_as_they_are(tmp_path: Path) -> None:
    first = save(tmp_path / "first")
    second = save_demos(first, tmp_path / "second")
    assert second.manifest == first.manifest
    assert save_demos(first, tmp_path / "third", expert="another").manifest["expert"] == "another"
    assert repr(second) == (
        "Demos(20 transitions in 4 episodes, env='toy', expert='scripted', keys: actuation (7,), done (1,), "
        "episode (), joint_angle (7,), next/tool_position (3,), success (1,), tool_position (3,))"
    )


def test_nothing_is_overwritten_and_nothing_is_left_half_written(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    before = save(tmp_path / "demos").fingerprint
    with pytest.raises(FileExistsError, match="never overwritten"):
        save(tmp_path / "demos")
    assert load_demos(tmp_path / "demos").fingerprint == before

    def fail(*_: Any) -> None:
        raise OSError("disk full")

    with monkeypatch.context() as patched:
        patched.setattr(Path, "write_bytes", fail)
        with pytest.raises(OSError, match="disk full"):
            save(tmp_path / "more")
    assert [path.name for path in tmp_path.iterdir()] == ["demos"]


def test_a_full_disk_is_noticed_before_anything_is_written(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    room = shutil.disk_usage(tmp_path)._replace(free=1000)
    monkeypatch.setattr(shutil, "disk_usage", lambda _: room)
    with pytest.raises(OSError, match=r"takes 0\.0 MB, only 0\.0 MB are left"):
        save(tmp_path / "demos")
    assert not list(tmp_path.iterdir())


def save_and_be_killed(path: Path) -> None:
    """Save, and be killed when all is written but not yet in its place."""
    os.rename = lambda *_: os.kill(os.getpid(), signal.SIGKILL)  # type: ignore[assignment]
    save(path)


def test_what_a_killed_process_left_is_removed_by_the_next_and_what_lives_stays(tmp_path: Path) -> None:
    here = [str(Path(__file__).parent), str(Path(__file__).parents[1] / "support")]
    code = f"import sys; sys.path[:0] = {here}; import test_demos; from pathlib import Path; "
    process = fresh_process.run(code + f"test_demos.save_and_be_killed(Path({str(tmp_path / 'demos')!r}))")
    assert process.returncode == -signal.SIGKILL, process.stderr
    (left,) = tmp_path.iterdir()
    assert left.name.startswith(".demos.")
    with scratch(tmp_path / "demos") as living:
        assert not left.exists()
        living.mkdir()
        save(tmp_path / "demos")
        assert living.exists()


def test_settings_that_are_not_json_leave_nothing_behind(tmp_path: Path) -> None:
    with pytest.raises(TypeError, match="not JSON serializable"):
        save_demos(
            episodes(), tmp_path / "demos", env="toy", seed=0, expert="e", settings={"start": object()}
        )
    assert not list(tmp_path.iterdir())


def spoiled(key: str, value: float) -> TensorDict:
    data = episodes()
    data[key][2:4, 0] = value
    return data


def torn() -> TensorDict:
    data = episodes()
    data["episode"][-1] = 0
    return data


def cut_short() -> TensorDict:
    return episodes()[:-2]


def with_text() -> TensorDict:
    data = episodes()
    data["note"] = "hello"
    return data


@pytest.mark.parametrize(
    ("data", "error", "message"),
    [
        (
            spoiled("joint_angle", float("nan")),
            ValueError,
            "key 'joint_angle' holds 2 NaN or infinite values",
        ),
        (spoiled("actuation", float("inf")), ValueError, "key 'actuation' holds 2 NaN or infinite values"),
        (episodes()[:0], ValueError, r"T >= 1, got \(0,\)"),
        (episodes().reshape(4, 5), ValueError, r"batch size \(T,\)"),
        (episodes().exclude("actuation"), KeyError, "need the key 'actuation', these have .*'joint_angle'"),
        (episodes().exclude("episode"), KeyError, "need the key 'episode'"),
        (torn(), ValueError, "must stand together, but those of 1 do not, the first being episode 0"),
        (cut_short(), ValueError, "1 of 4 end without done, the first being episode 3"),
        (with_text(), ValueError, "tensors only, but key 'note' holds a"),
    ],
)
def test_what_is_no_demonstration_is_refused(
    tmp_path: Path, data: TensorDict, error: type[Exception], message: str
) -> None:
    with pytest.raises(error, match=message):
        save(tmp_path / "demos", data)
    assert not list(tmp_path.iterdir())


def test_shapes_of_actuation_and_episode_are_checked() -> None:
    with pytest.raises(ValueError, match=r"actuation must be floats \(T, n\) and episode integers \(T,\)"):
        Demos.from_tensors(actuation=torch.ones(5), episode=torch.zeros(5), context=torch.ones(5, 2))
    with pytest.raises(ValueError, match=r"torch.int64 \(5, 1\)"):
        Demos.from_tensors(actuation=torch.ones(5, 2), episode=torch.zeros(5, 1), context=torch.ones(5, 2))


def test_context_keys_that_are_not_there_or_no_rows_of_floats_are_named(tmp_path: Path) -> None:
    demos = save(tmp_path / "demos")
    with pytest.raises(KeyError, match=r"'elbow' is not in the demonstrations, which have .*'joint_angle'"):
        demos.context(["tool_position", "elbow"])
    with pytest.raises(KeyError, match="'next' is not in"):
        demos.context(["next"])
    with pytest.raises(ValueError, match="'episode' must hold floats"):
        demos.context(["episode"])


def test_folders_that_hold_no_demonstrations_are_refused(tmp_path: Path) -> None:
    with pytest.raises(FileNotFoundError, match=r"no manifest\.json"):
        load_demos(tmp_path)
    with pytest.raises(FileNotFoundError, match="holds no demonstrations"):
        load_demos(tmp_path / "nowhere")
    (tmp_path / "manifest.json").write_text('{"name": "something else"}')
    with pytest.raises(ValueError, match=r"not marked 'nht.demos'"):
        load_demos(tmp_path)
    (tmp_path / "manifest.json").write_text('{"format": "nht.de')
    with pytest.raises(ValueError, match="is not JSON"):
        load_demos(tmp_path)


def test_another_env_or_format_version_is_refused(tmp_path: Path) -> None:
    save(tmp_path / "demos")
    with pytest.raises(ValueError, match="demonstrations of env 'toy', expected 'wam_wipe'"):
        load_demos(tmp_path / "demos", env="wam_wipe")
    manifest = tmp_path / "demos" / "manifest.json"
    manifest.write_text(manifest.read_text().replace('"format_version": 1', '"format_version": 2'))
    with pytest.raises(ValueError, match="format version 2, this version of nht reads 1"):
        load_demos(tmp_path / "demos")


def test_changed_short_or_missing_data_are_noticed(tmp_path: Path) -> None:
    for name in ("changed", "short", "missing"):
        save(tmp_path / name)
    changed = tmp_path / "changed" / "data" / "actuation.memmap"
    changed.write_bytes(b"\x01" + changed.read_bytes()[1:])
    short = tmp_path / "short" / "data" / "actuation.memmap"
    short.write_bytes(short.read_bytes()[:100])
    (tmp_path / "missing" / "data" / "actuation.memmap").unlink()
    for name in ("changed", "short", "missing"):
        with pytest.raises(ValueError, match=f"the data of .*{name}"):
            load_demos(tmp_path / name)


def test_nothing_is_unpickled(tmp_path: Path) -> None:
    class Bomb:
        def __reduce__(self) -> tuple[Any, ...]:
            return (Path.touch, (tmp_path / "exploded",))

    save(tmp_path / "demos")
    data = tmp_path / "demos" / "data"
    meta = json.loads((data / "meta.json").read_text())
    meta["note"] = {"type": "<class 'tensordict.tensorclass.NonTensorData'>"}
    (data / "meta.json").write_text(json.dumps(meta))
    (data / "note").mkdir()
    (data / "note" / "meta.json").write_text(
        json.dumps({"_type": "<class 'tensordict.tensorclass.NonTensorData'>", "_metadata": {}})
    )
    (data / "note" / "other.pickle").write_bytes(pickle.dumps({"data": Bomb()}))
    with pytest.raises((ValueError, RuntimeError)):
        load_demos(tmp_path / "demos")
    assert not (tmp_path / "exploded").exists()


def test_public_names() -> None:
    assert (nht.load_demos, nht.save_demos, nht.Demos) == (load_demos, save_demos, Demos)
