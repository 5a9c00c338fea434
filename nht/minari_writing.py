"""Demonstrations written as Minari datasets, with ``pip install 'nht[minari]'``."""

from __future__ import annotations

import warnings
from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

import numpy as np
import torch
from tensordict import TensorDict, TensorDictBase

from nht.demos import Demos
from nht.episodes import EPISODE_FLAGS, items, key_name
from nht.minari_episodes import moments_of
from nht.minari_internals import (
    FOLDER,
    MINARI_ERRORS,
    NAMESPACE,
    check_dataset_id,
    datasets_in,
    datasets_root,
    episode_buffer,
    import_minari,
)
from nht.reading import shortened
from nht.writing import check_room, publish, scratch

if TYPE_CHECKING:
    from minari import MinariDataset
    from minari.data_collector import EpisodeBuffer


def to_minari(
    demos: Demos,
    dataset_id: str,
    *,
    env: str | None = None,
    observation_keys: Sequence[str] | None = None,
) -> MinariDataset:
    """Write demonstrations as a new local Minari dataset, all or nothing.

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
    minari = import_minari()
    check_dataset_id(dataset_id)
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
                datasets_in(root),
                warnings.catch_warnings(),
            ):  # on author and the like, which Minari recommends
                warnings.simplefilter("ignore", UserWarning)
                dataset = minari.create_dataset_from_buffers(dataset_id, buffers, env=env, **about, **spaces)
            for episode in dataset.iterate_episodes():
                moments_of(dataset, episode)
        except MINARI_ERRORS as error:
            raise ValueError(
                f"the demonstrations cannot be written as a dataset of env {env}: {shortened(error, 600)}."
            ) from error
        publish(root / dataset_id, folder)
        for about_namespace in root.rglob(NAMESPACE):
            if not (known := datasets_root() / about_namespace.relative_to(root)).exists():
                publish(about_namespace, known)
    return minari.MinariDataset(folder / FOLDER)


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
    chosen = moments.select(*(tuple(name.split("/")) for name in observed))
    infos = moments.exclude(*chosen.keys(include_nested=True, leaves_only=True)).numpy()
    if "success" in steps:
        infos["success"] = np.append(False, steps["success"].numpy())
    arrays: dict[str, Any] = {
        name: steps[key].numpy().reshape(-1)
        for name, key in (("rewards", "reward"), ("terminations", "terminated"), ("truncations", "truncated"))
    }
    observations = chosen["observation"] if observed == ["observation"] else chosen
    return episode_buffer(
        observations=observations.numpy(), actions=steps["actuation"].numpy(), infos=infos, **arrays
    )


def _now_and_next(data: TensorDictBase) -> tuple[TensorDictBase, TensorDictBase]:
    """The context keys of all transitions, before and after the step."""
    following = data.get("next", TensorDict(batch_size=data.batch_size)).exclude("reward", *EPISODE_FLAGS)
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
