"""Demonstrations from Minari datasets and to them, with ``pip install 'nht[minari]'``. Nothing is ever downloaded."""

from __future__ import annotations

import os
import warnings
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from types import ModuleType
from typing import TYPE_CHECKING, Any

import numpy as np
import torch
from numpy.typing import NDArray
from tensordict import TensorDict, TensorDictBase

from nht.arrays import as_tensor
from nht.demos import Demos
from nht.episodes import FLAGS, items, key_name, whole_episodes
from nht.minari_file import (
    METADATA,
    check_dataset,
    datasets_root,
    leaves_that_are_no_arrays,
    local_datasets,
)
from nht.reading import naming, shortened, shown
from nht.writing import check_room, publish, scratch

if TYPE_CHECKING:
    from minari import EpisodeData, MinariDataset
    from minari.data_collector import EpisodeBuffer

Array = NDArray[Any]
# What minari, gymnasium and h5py raise on files that are damaged.
UNREADABLE = (
    OSError,
    ValueError,
    LookupError,
    AssertionError,
    RuntimeError,
    TypeError,
    AttributeError,
    ArithmeticError,
    MemoryError,
)


def from_minari(
    dataset: MinariDataset | str | Path,
    *,
    context: Mapping[str, str] | Sequence[str] | None = None,
    env: str | None = None,
) -> Demos:
    """Demonstrations from a local Minari dataset; those of its episodes that do not end are left out.

    Args:
        dataset: the id of a local dataset, a dataset's folder or the HDF5 file in it. Opening it runs nothing. Or
            a dataset that you opened yourself, whatever Minari ran for that.
        context: which entries may serve as context, or such entries by the names they get: "observation",
            the entries of a Dict space by their own names, those of a Tuple as "observation/0"; "infos/qpos" and
            the like. By default all observations that are arrays; others, such as text, are named in the
            manifest's settings as "left_out_observations".
        env: id of the Gymnasium env that the dataset must be of, if that matters.

    Raises:
        ImportError: without the extra.
        FileNotFoundError: on a dataset that is not here; the message lists those that are.
        KeyError: on an entry that it lacks; the message lists those that are there.
        ValueError: on a dataset of another env, one that cannot be read, is cut short or has other shapes than
            its spaces say, one that Minari would have to run code for or that names other files, and on values
            that are no finite demonstrations.
    """
    opened = open_minari(dataset)
    found = opened.env_spec.id if opened.env_spec is not None else "unknown"
    if env is not None and found != env:
        raise ValueError(f"{opened.id} holds demonstrations of env {found!r}, expected {env!r}.")
    data, left_out = minari_episodes(opened, context)
    notes = left_out_observations(opened, context)
    with naming(opened.storage.data_path):
        return Demos.from_episodes(
            data,
            env=found,
            expert=opened.storage.metadata.get("algorithm_name", "unknown"),
            settings={"minari_dataset": opened.id, "left_out_episodes": left_out, **notes},
        )


def left_out_observations(dataset: MinariDataset, context: Any) -> dict[str, list[str]]:
    """For a manifest's settings: which observations are no arrays, where all were asked for. Empty if all are."""
    names = [] if context is not None else list(leaves_that_are_no_arrays(dataset.observation_space))
    return {"left_out_observations": names} if names else {}


def open_minari(dataset: MinariDataset | str | Path) -> MinariDataset:
    """A local dataset from its id, folder or HDF5 file. Raises as ``from_minari`` does."""
    minari = _import_minari()
    if isinstance(dataset, minari.MinariDataset):
        return dataset
    folder = _data_folder(dataset)
    try:
        check_dataset(folder)
        return minari.MinariDataset(folder)
    except UNREADABLE as error:
        raise ValueError(f"the Minari dataset {dataset} cannot be read: {shortened(error, 600)}.") from error


def _data_folder(dataset: str | Path) -> Path:
    """Where the files of a dataset are, which is named by its id, its folder or the HDF5 file in it."""
    path = Path(dataset)
    folder = path.parent if path.is_file() else path
    for found in (folder, folder / "data", datasets_root() / str(dataset) / "data"):
        if (found / METADATA).is_file():
            return found
    raise FileNotFoundError(
        f"{dataset} is neither the folder of a Minari dataset, with a metadata.json, nor the id of a local one: "
        f"there are {shown(local_datasets())}."
    )


def minari_episodes(
    dataset: MinariDataset, context: Mapping[str, str] | Sequence[str] | None = None
) -> tuple[TensorDict, int]:
    """What ``from_minari`` makes demonstrations of, values unseen: transitions, and how many episodes are left out."""
    targets = context if context is None or isinstance(context, Mapping) else {name: name for name in context}
    with naming(dataset.storage.data_path):
        parts, lengths = [], []
        for episode in _episodes(dataset):
            moments = _moments(dataset, episode)
            if targets is None:
                targets = {name: name for name in moments if not name.startswith("infos/")}
            if missing := set(targets.values()) - moments.keys():
                raise KeyError(
                    f"entries {sorted(missing)} are not in episode {episode.id} of {dataset.id}, which has "
                    f"{shown(moments)}."
                )
            parts.append(_transitions(episode, moments, set(targets.values())))
            lengths.append(len(episode))
        if targets is None or not sum(lengths):
            raise ValueError(f"the Minari dataset {dataset.id} has no transitions.")
        return whole_episodes(
            _joined(dataset.id, parts, lengths),
            context={tuple(name.split("/")): ("context", key) for name, key in targets.items()},
        )


def _joined(name: str, parts: list[dict[tuple[str, ...], Array]], lengths: list[int]) -> TensorDict:
    """The rows of all episodes one after another, with the number of each one's episode."""
    if differing := {key for part in parts for key in part.keys() ^ parts[0].keys()}:
        entries = sorted("/".join(key) for key in differing)
        raise ValueError(f"some episodes of {name} have the entries {shown(entries)}, others lack them.")
    columns = {key: np.concatenate([part[key] for part in parts]) for key in parts[0]}
    rows = {key: as_tensor(column, f"{name}, {'/'.join(key)}") for key, column in columns.items()}
    rows["episode",] = torch.arange(len(lengths)).repeat_interleave(torch.tensor(lengths))
    return TensorDict(rows, [sum(lengths)])


def _episodes(dataset: MinariDataset) -> Iterator[EpisodeData]:
    try:
        yield from dataset.iterate_episodes()
    except UNREADABLE as error:
        raise ValueError(
            f"the Minari dataset {dataset.id} cannot be read, it may be cut short or of another env: "
            f"{shortened(error, 600)}."
        ) from error


def _moments(dataset: MinariDataset, episode: EpisodeData) -> dict[str, Array]:
    """What was known at each moment of an episode of T steps, (T + 1, *shape) by name. Checks all shapes."""
    steps = len(episode)
    moments: dict[str, Array] = {}
    for name, values, space in _leaves(episode.observations, dataset.observation_space, "observation"):
        _check_shape(
            dataset, episode, f"entry {name!r} of the observations", values, (steps + 1, *space.shape)
        )
        moments[name] = values
    actions = episode.actions
    if not isinstance(actions, np.ndarray):
        raise ValueError(
            f"the actions of {dataset.id} must be arrays, its action space is {dataset.action_space}."
        )
    _check_shape(dataset, episode, "actions", actions, (steps, *dataset.action_space.shape))
    for name in ("terminations", "truncations"):
        _check_shape(dataset, episode, name, getattr(episode, name), (steps,))
    for name, values in _arrays(episode.infos or {}, "infos"):
        if values.dtype.kind in "biuf" and values.shape[:1] == (steps + 1,):
            moments[name] = values
    return moments


def _transitions(
    episode: EpisodeData, moments: dict[str, Array], names: set[str]
) -> dict[tuple[str, ...], Array]:
    """The rows of an episode, (T, *shape) by key, in TorchRL's layout."""
    rows: dict[tuple[str, ...], Array] = {
        ("action",): episode.actions,
        ("next", "reward"): episode.rewards,
        ("next", "terminated"): episode.terminations,
        ("next", "truncated"): episode.truncations,
    }
    for name in names:
        rows["context", name], rows["next", "context", name] = moments[name][:-1], moments[name][1:]
    if "infos/success" in moments:
        rows["next", "success"] = moments["infos/success"][1:]
    return rows


def _leaves(values: Any, space: Any, name: str) -> Iterator[tuple[str, Array, Any]]:
    """Arrays of an observation with their names and spaces; the entries of a Dict space have their own names."""
    if isinstance(values, dict):
        for key, value in values.items():
            yield from _leaves(value, space[key], key if name == "observation" else f"{name}/{key}")
    elif isinstance(values, tuple):
        for number, value in enumerate(values):
            yield from _leaves(value, space[number], f"{name}/{number}")
    elif isinstance(values, np.ndarray):
        yield name, values, space


def _arrays(values: Any, name: str) -> Iterator[tuple[str, Array]]:
    if isinstance(values, dict):
        for key, value in values.items():
            yield from _arrays(value, f"{name}/{key}")
    elif isinstance(values, np.ndarray):
        yield name, values


def _check_shape(
    dataset: MinariDataset, episode: EpisodeData, name: str, values: Array, expected: tuple[int, ...]
) -> None:
    if values.shape != expected:
        raise ValueError(
            f"{name} in episode {episode.id} of {dataset.id} must have shape {expected}, got {values.shape}."
        )


def to_minari(
    demos: Demos,
    dataset_id: str,
    *,
    env: str | None = None,
    observation_keys: Sequence[str] | None = None,
) -> MinariDataset:
    """Writes demonstrations as a new local Minari dataset, all or nothing.

    Minari decides where: in the folder that the environment variable MINARI_DATASETS_PATH names, else in the
    user's home. Author, licence and the like can be added by ``dataset.storage.update_metadata``.

    Args:
        demos: with reward, terminated, truncated, and the observations under "next" too.
        dataset_id: such as "wam/wipe-v0".
        env: id of the Gymnasium env that they are of: the dataset then has its spec and its spaces. Otherwise the
            spaces are unbounded boxes.
        observation_keys: what makes up the observation: "observation" alone is a Box, all else a Dict. By
            default "observation" where ``env`` is given, otherwise all. Other keys go into the infos.

    Raises:
        ImportError: without the extra.
        FileExistsError: on a dataset that exists.
        ValueError: on an id that is none, and on demonstrations that lack something or do not fit the env.
    """
    minari = _import_minari()
    from minari.dataset.minari_dataset import parse_dataset_id

    parse_dataset_id(dataset_id)
    folder = datasets_root() / dataset_id
    if folder.exists():
        raise FileExistsError(f"the Minari dataset {dataset_id} exists: choose another name or version.")
    if observation_keys is None and env is not None:
        observation_keys = ["observation"]
    buffers = _buffers(demos, observation_keys)
    spaces = _unbounded_spaces(buffers[0]) if env is None else {}
    about = {
        "algorithm_name": demos.manifest["expert"],
        "description": f"Demonstrations of {demos.manifest['env']}, fingerprint {demos.fingerprint}",
    }
    size = sum(value.numel() * value.element_size() for _, value in items(demos.data))
    check_room(folder.parent, 2 * size, f"writing the Minari dataset {dataset_id}")
    with scratch(folder) as root:
        try:
            with (
                _datasets_in(root),
                warnings.catch_warnings(),
            ):  # on author and the like, which Minari recommends
                warnings.simplefilter("ignore", UserWarning)
                dataset = minari.create_dataset_from_buffers(dataset_id, buffers, env=env, **about, **spaces)
            for episode in dataset.iterate_episodes():
                _moments(dataset, episode)
        except UNREADABLE as error:
            raise ValueError(
                f"the demonstrations cannot be written as a dataset of env {env}: {error}"
            ) from error
        publish(root / dataset_id, folder)
        for about_namespace in root.rglob("namespace_metadata.json"):
            if not (known := datasets_root() / about_namespace.relative_to(root)).exists():
                publish(about_namespace, known)
    return minari.MinariDataset(folder / "data")


@contextmanager
def _datasets_in(root: Path) -> Iterator[None]:
    """Let Minari write below ``root``, which it only takes from the environment of the process."""
    before = os.environ.get("MINARI_DATASETS_PATH")
    os.environ["MINARI_DATASETS_PATH"] = str(root)
    try:
        yield
    finally:
        os.environ.pop("MINARI_DATASETS_PATH")
        if before is not None:
            os.environ["MINARI_DATASETS_PATH"] = before


def _buffers(demos: Demos, observation_keys: Sequence[str] | None) -> list[EpisodeBuffer]:
    """The episodes as Minari's buffers."""
    data = demos.data
    now, following = _now_and_next(data)
    names = [key_name(key) for key, value in items(now) if value.is_floating_point()]
    observed = names if observation_keys is None else list(observation_keys)
    if missing := set(observed) - set(names):
        raise ValueError(f"observation_keys {sorted(missing)} are not among the demonstrations' {names}.")
    lengths = demos.episode.unique_consecutive(return_counts=True)[1].tolist()
    return [
        _buffer(data[rows], torch.cat([now[rows], following[rows[-1:]]]), observed)
        for rows in torch.arange(len(data)).split(lengths)
    ]


def _buffer(steps: TensorDictBase, moments: TensorDictBase, observed: list[str]) -> EpisodeBuffer:
    """An episode of (T,) steps and (T + 1,) moments."""
    from minari.data_collector import EpisodeBuffer

    chosen = moments.select(*(tuple(name.split("/")) for name in observed))
    infos = moments.exclude(*chosen.keys(include_nested=True, leaves_only=True)).numpy()
    if "success" in steps:
        infos["success"] = np.append(False, steps["success"].numpy())
    # Minari says lists, and takes arrays, which keep their types.
    arrays: dict[str, Any] = {
        name: steps[key].numpy().reshape(-1)
        for name, key in (("rewards", "reward"), ("terminations", "terminated"), ("truncations", "truncated"))
    }
    observations = chosen["observation"] if observed == ["observation"] else chosen
    return EpisodeBuffer(
        observations=observations.numpy(), actions=steps["actuation"].numpy(), infos=infos, **arrays
    )


def _now_and_next(data: TensorDictBase) -> tuple[TensorDictBase, TensorDictBase]:
    """The context keys of all transitions, before and after the step."""
    following = data.get("next", TensorDict(batch_size=data.batch_size)).exclude("reward", *FLAGS)
    missing = [name for name in ("reward", "terminated", "truncated") if name not in data]
    if missing or following.is_empty():
        lacking = [*missing, *(["observations under 'next'"] if following.is_empty() else [])]
        raise ValueError(f"a Minari dataset needs {', '.join(lacking)}, which the demonstrations lack.")
    now = data.select(*following.keys(include_nested=True, leaves_only=True))
    within = data["episode"][1:] == data["episode"][:-1]
    if not (now[1:][within] == following[:-1][within]).all():
        raise ValueError(
            "a Minari dataset has one observation per moment, but these demonstrations hold under 'next' another one "
            "than their next row."
        )
    return now, following


def _unbounded_spaces(buffer: EpisodeBuffer) -> dict[str, Any]:
    return {
        "observation_space": _unbounded(buffer.observations),
        "action_space": _unbounded(buffer.actions),
    }


def _unbounded(values: Any) -> Any:
    from gymnasium.spaces import Box, Dict

    if isinstance(values, dict):
        return Dict({key: _unbounded(value) for key, value in values.items()})
    return Box(-np.inf, np.inf, values.shape[1:], values.dtype)


def _import_minari() -> ModuleType:
    try:
        import minari
    except ImportError as error:
        raise ImportError("Minari datasets need an optional package: pip install 'nht[minari]'.") from error
    return minari
