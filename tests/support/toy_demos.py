"""Three small episodes, as demonstrations and as others would have stored them."""

from pathlib import Path

import pytest
import torch
from tensordict import TensorDict

import nht

LENGTHS = [5, 3, 7]
FLAGS = ("reward", "terminated", "truncated", "done", "success")


def moments(width: int, seed: int, dtype=torch.float32) -> list[torch.Tensor]:
    """What is seen at each moment of every episode, the last one included."""
    generator = torch.Generator().manual_seed(seed)
    return [torch.randn(length + 1, width, generator=generator, dtype=dtype) for length in LENGTHS]


def episodes() -> TensorDict:
    """Three episodes as demonstrations: the second one is cut off by time, the others end with success."""
    seen = {"observation": moments(4, 0), "joint": moments(2, 1, torch.float64)}
    last = torch.cat([torch.arange(length) == length - 1 for length in LENGTHS])[:, None]
    number = torch.arange(3).repeat_interleave(torch.tensor(LENGTHS))
    generator = torch.Generator().manual_seed(2)
    return TensorDict(
        {
            **{key: torch.cat([rows[:-1] for rows in value]) for key, value in seen.items()},
            "actuation": torch.randn(15, 3, generator=generator),
            "episode": number,
            "reward": torch.randn(15, 1, generator=generator),
            "terminated": last & (number != 1)[:, None],
            "truncated": last & (number == 1)[:, None],
            "done": last,
            "success": last & (number != 1)[:, None],
            "next": {key: torch.cat([rows[1:] for rows in value]) for key, value in seen.items()},
        },
        batch_size=15,
    )


def demonstrations() -> nht.Demos:
    return nht.Demos.from_episodes(episodes(), env="toy", expert="Toy")


def as_rollout(data: TensorDict) -> TensorDict:
    """The same as TorchRL would have recorded it: outcomes under "next", no number of the episode."""
    return TensorDict(
        {
            "observation": data["observation"],
            "info": {"joint": data["joint"]},
            "action": data["actuation"],
            "next": {
                "observation": data["next", "observation"],
                "info": {"joint": data["next", "joint"]},
                **{flag: data[flag] for flag in FLAGS},
            },
        },
        batch_size=len(data),
    )


CONTEXT = {"observation": "observation", "joint": ("info", "joint")}


def same(found: nht.Demos, expected: TensorDict) -> bool:
    assert set(found.data.keys(True, True)) == set(expected.keys(True, True))
    return all(
        torch.equal(found.data[key], value) and found.data[key].dtype == value.dtype
        for key, value in expected.items(True, True)
    )


def write_hdf5(path: Path, **changes) -> Path:
    """The three episodes as D4RL stores them; `None` leaves an array out."""
    h5py = pytest.importorskip("h5py")
    data = episodes()
    arrays = {
        "observations": data["observation"],
        "next_observations": data["next", "observation"],
        "actions": data["actuation"],
        "rewards": data["reward"].squeeze(-1),
        "terminals": data["terminated"].squeeze(-1),
        "timeouts": data["truncated"].squeeze(-1),
        "infos/qpos": data["joint"],
        "metadata/algorithm": torch.tensor(7),
        **changes,
    }
    with h5py.File(path, "w") as file:
        for name, array in arrays.items():
            if array is not None:
                file[name] = array.numpy()
    return path
