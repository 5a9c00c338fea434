"""Demonstrations from HDF5 files in D4RL's style, with ``pip install 'nht[minari]'``."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from types import MappingProxyType

from tensordict import TensorDict

from nht.arrays import as_tensor
from nht.demos import Demos
from nht.episodes import whole_episodes
from nht.hdf5_file import import_h5py, names, opened, read_array
from nht.reading import naming, shown

D4RL_CONTEXT: Mapping[str, str] = MappingProxyType({"observation": "observations"})
# Our names to D4RL's, which are optional.
D4RL_OUTCOMES = {"reward": "rewards", "terminated": "terminals", "truncated": "timeouts"}
MOST_KEYS = 200  # keys that a message looks at, of which it shows some
ROBOMIMIC = (
    "Its layout is robomimic's: a group data/demo_N for every demonstration, which is not read. Put their arrays one "
    "after another and mark the last step of each, with h5py, or hand them to nht.Demos.from_tensors."
)


def from_hdf5(
    path: str | Path,
    *,
    actuation_key: str = "actions",
    context: Mapping[str, str] | Sequence[str] = D4RL_CONTEXT,
    episode_key: str | None = None,
    done_key: str | None = None,
    env: str = "unknown",
) -> Demos:
    """Demonstrations from a file that holds one array per key, with a row per transition, in order of time.

    Rewards, terminals and timeouts are taken along where the file has them, as is "next_observations" beside
    "observations". Files without it give demonstrations without "next", for what followed an episode's last
    step is not in them. Episodes that do not end are left out, and counted in the manifest. Links within the file are
    followed; links, storage and virtual data sets that name other files are refused.

    Args:
        path: the file.
        actuation_key: (T, n), what the motors got.
        context: keys that may serve as context, or such keys by the names they get: ``{"joint": "infos/qpos"}``.
        episode_key: (T,) integers that differ between episodes, if the file has them.
        done_key: (T,), true at an episode's last step, where that is neither "terminals" nor "timeouts".
        env: a name for where they come from.

    Raises:
        ImportError: without the extra.
        FileNotFoundError: if there is no such file.
        KeyError: on a key that is not in the file; the message lists those that are.
        ValueError: on a file that cannot be read, is cut short or names other files, on arrays that hold no numbers
            or are of different lengths, on values that are no finite demonstrations, and if no episode ends.
    """
    data, left_out = hdf5_episodes(
        path, actuation_key=actuation_key, context=context, episode_key=episode_key, done_key=done_key
    )
    with naming(path):
        return Demos.from_episodes(data, env=env, settings={"left_out_episodes": left_out})


def hdf5_episodes(
    path: str | Path,
    *,
    actuation_key: str = "actions",
    context: Mapping[str, str] | Sequence[str] = D4RL_CONTEXT,
    episode_key: str | None = None,
    done_key: str | None = None,
) -> tuple[TensorDict, int]:
    """The transitions of a file, their values not checked yet, and the number of episodes that are left out."""
    sources = context if isinstance(context, Mapping) else {key: key for key in context}
    needed: dict[tuple[str, ...], str] = {("actuation",): actuation_key}
    needed |= {("context", name): key for name, key in sources.items()}
    needed |= {(name,): key for name, key in (("number", episode_key), ("end", done_key)) if key is not None}
    optional: dict[tuple[str, ...], str] = {("next", name): key for name, key in D4RL_OUTCOMES.items()}
    optional |= {("next", "context", name): f"next_{key}" for name, key in sources.items()}
    data = _read(Path(path), needed, optional)
    with naming(path):
        return whole_episodes(
            data,
            actuation_key="actuation",
            context={tuple(name.split("/")): ("context", name) for name in sources},
            episode_key=None if episode_key is None else "number",
            done_key=None if done_key is None else "end",
        )


def _read(path: Path, needed: dict[tuple[str, ...], str], optional: dict[tuple[str, ...], str]) -> TensorDict:
    """The arrays of the file by our keys."""
    import_h5py()
    if not path.is_file():
        raise FileNotFoundError(f"there is no file {path}.")
    wanted = {**needed, **optional}
    with opened(path) as file:
        arrays = {name: read_array(file, name) for name in sorted(set(wanted.values()))}
        missing = sorted(name for name in set(needed.values()) if arrays[name] is None)
        present = names(file, MOST_KEYS) if missing else []
    robomimic = any(name.startswith("data/demo_") for name in present)
    if missing:
        hint = f" {ROBOMIMIC}" if robomimic else ""
        raise KeyError(f"keys {shown(missing)} are not in {path}, which has {shown(present)}.{hint}.")
    rows = {
        key: as_tensor(array, f"{path}: {name!r}")
        for key, name in wanted.items()
        if (array := arrays[name]) is not None
    }
    lengths = {wanted[key]: len(tensor) if tensor.ndim else 0 for key, tensor in rows.items()}
    if len(set(lengths.values())) > 1:
        raise ValueError(f"the arrays of {path} must have a row per transition each, got lengths {lengths}.")
    return TensorDict(rows, batch_size=list(lengths.values())[:1])
