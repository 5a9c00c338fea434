"""The layout of demonstrations: whole episodes of finite numbers, checked, or made from data laid out otherwise."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import torch
from tensordict import NestedKey, TensorDict, TensorDictBase
from torch import Tensor

MOST_NAMES = 30  # keys that a message names
EPISODE_FLAGS = ("terminated", "truncated", "done", "success")
# TorchRL's data sets and its collectors number their episodes, and mark as false the padding of split ones.
EPISODE_KEYS: tuple[NestedKey, ...] = ("episode", ("collector", "traj_ids"))
MASK_KEYS: tuple[NestedKey, ...] = ("mask", ("collector", "mask"))


def whole_episodes(
    data: TensorDictBase,
    *,
    actuation_key: NestedKey = "action",
    context: Mapping[NestedKey, NestedKey] | Sequence[NestedKey] = ("observation",),
    episode_key: NestedKey | None = None,
    done_key: NestedKey | None = None,
) -> tuple[TensorDict, int]:
    """Lay TorchRL's data out as demonstrations; episodes that do not end are left out.

    Args:
        data: (T,), or (N, T) with a trajectory in each row; in order of time. What a step brought stands under
            "next", or, where there are no flags under "next", beside the action.
        actuation_key: (*batch, n), what the motors got.
        context: keys that may serve as context, or such keys by the names they get; those that also stand under
            "next" are taken along.
        episode_key: integers that differ between episodes. By default "episode" or a collector's trajectory ids.
        done_key: true at the last step of an episode. By default the data's "done", "terminated" or "truncated".

    Returns:
        transitions (T',) with "actuation", "episode" from 0 on, the context, and "reward" and flags (T', 1) where
        the data have them; and the number of episodes left out. Values are not looked at: see ``check``.

    Raises:
        KeyError: on a key that is not in the data; the message lists those that are.
        ValueError: if nothing says where episodes end, or none does; if the actuation also stands under "next", as
            what ``ActionMapTransform`` executed: then it is, at the root, that of the step before.
    """
    _check_not_late(data, actuation_key)
    if data.batch_dims == 0:
        raise ValueError("transitions need a batch size (T,) or (N, T), got ().")
    data = data.cpu()
    first = torch.zeros(data.batch_size, dtype=torch.bool)
    first[..., :1] = True
    mask = _first_of(data, MASK_KEYS)
    kept = torch.ones_like(first) if mask is None else mask.reshape(first.shape).bool()
    data, first = data[kept], first[kept]

    outcome = _outcome(data)
    done = _done(data, outcome, done_key)
    number = _first_of(data, EPISODE_KEYS) if episode_key is None else _entry(data, episode_key)
    if number is None and done is None and int(first.sum()) < 2:
        raise ValueError(
            f"nothing says where episodes end: name episode_key or done_key; the data have {listed(data)}."
        )
    names = context if isinstance(context, Mapping) else {key: key for key in context}
    laid_out = TensorDict({"actuation": _rows(_entry(data, actuation_key))}, batch_size=len(data))
    for name, key in names.items():
        laid_out[name] = _rows(_entry(data, key))
        following = data.get(("next", *_parts(key)), None)
        if following is not None:
            laid_out["next", *_parts(name)] = _rows(following)
    for name in ("reward", *EPISODE_FLAGS):
        if name in outcome:
            value = outcome[name].reshape(len(data), 1)
            laid_out[name] = value if name == "reward" else value.bool()
    if done is not None:
        laid_out["done"] = done[:, None]
    return _numbered(laid_out, first, None if number is None else number.reshape(-1))


def _check_not_late(data: TensorDictBase, actuation_key: NestedKey) -> None:
    following = ("next", *_parts(actuation_key))
    if isinstance(data.get(following, None), Tensor):
        raise ValueError(
            f"key {actuation_key!r} also stands under 'next': at the root it is what the step before executed. "
            f"The actuation of the same step is actuation_key={following!r}."
        )


def _numbered(data: TensorDict, first: Tensor, number: Tensor | None) -> tuple[TensorDict, int]:
    """Put the rows of an episode together, number the episodes and drop those that do not end."""
    if number is not None:  # the ids of a collector alternate where its batches were stored one after another
        order = torch.argsort(number, stable=True)
        data, number = data[order], number[order]
        first = torch.cat([torch.ones_like(first[:1]), number[1:] != number[:-1]])
    if "done" in data:
        first = first.clone()
        first[1:] |= data["done"][:-1, 0]
    episode = first.long().cumsum(0) - 1
    whole = torch.ones_like(first)
    if "done" in data:
        whole = torch.isin(episode, episode[data["done"][:, 0]])
        if not whole.any():
            raise ValueError(
                f"none of the {int(first.sum())} episodes ends with done, terminated or truncated: set one of them "
                "at their last steps, if they are whole, or name another done_key."
            )
    left_out = len(torch.unique(episode[~whole]))
    data["episode"] = episode
    data = data[whole]
    data["episode"] = data["episode"].unique_consecutive(return_inverse=True)[1]
    return data, left_out


def _outcome(data: TensorDictBase) -> TensorDictBase:
    """The part of the data that has the rewards and flags of each step."""
    following = data.get("next", None)
    found = isinstance(following, TensorDictBase) and any(
        name in following for name in ("reward", *EPISODE_FLAGS)
    )
    return following if found else data


def _done(data: TensorDictBase, outcome: TensorDictBase, done_key: NestedKey | None) -> Tensor | None:
    """Whether an episode ended, (T,), if the data say so."""
    if done_key is not None:
        return _entry(data, done_key).reshape(len(data)).bool()
    flags = [outcome[name].reshape(len(data)).bool() for name in EPISODE_FLAGS[:3] if name in outcome]
    return torch.stack(flags).any(0) if flags else None


def _first_of(data: TensorDictBase, keys: Sequence[NestedKey]) -> Tensor | None:
    return next((data[key] for key in keys if key in data.keys(include_nested=True)), None)


def _entry(data: TensorDictBase, key: NestedKey) -> Tensor:
    value = data.get(key, None)
    if not isinstance(value, Tensor):
        raise KeyError(f"key {key!r} is not in the data, which have {listed(data)}.")
    return value


def _rows(value: Tensor) -> Tensor:
    """A column (T, 1) of one number per transition (T,); other shapes stay."""
    return value[:, None] if value.ndim == 1 else value


def _parts(key: NestedKey) -> tuple[str, ...]:
    return (key,) if isinstance(key, str) else key


def check(data: TensorDictBase) -> None:
    """Check that data are whole episodes of finite numbers with an actuation.

    Raises:
        KeyError: if "actuation" or "episode" is missing.
        ValueError: on shapes, types or values that are no demonstrations, and on episodes in pieces.
    """
    for key in ("actuation", "episode"):
        if key not in data:
            raise KeyError(f"demonstrations need the key {key!r}, these have {listed(data)}.")
    if data.batch_dims != 1 or len(data) == 0:
        raise ValueError(f"demonstrations need a batch size (T,) with T >= 1, got {tuple(data.batch_size)}.")
    actuation, episode = data["actuation"], data["episode"]
    if (
        actuation.ndim != 2
        or episode.ndim != 1
        or not actuation.is_floating_point()
        or episode.is_floating_point()
    ):
        raise ValueError(
            "actuation must be floats (T, n) and episode integers (T,), got "
            f"{actuation.dtype} {tuple(actuation.shape)} and {episode.dtype} {tuple(episode.shape)}."
        )
    for key, value in items(data):
        if not isinstance(value, Tensor):
            raise ValueError(
                f"demonstrations hold tensors only, but key {key!r} holds a {type(value).__name__}."
            )
        bad = int((~value.isfinite()).sum())
        if bad:
            raise ValueError(
                f"demonstrations must be finite, but key {key!r} holds {bad} NaN or infinite values."
            )
    _check_episodes(data)


def _check_episodes(data: TensorDictBase) -> None:
    episode = data["episode"]
    last = torch.cat([episode[1:] != episode[:-1], torch.ones_like(episode[:1], dtype=torch.bool)])
    names, runs = torch.unique(episode[last], return_counts=True)
    if (runs > 1).any():
        raise ValueError(
            f"the rows of an episode must stand together, but those of {int((runs > 1).sum())} do not, "
            f"the first being episode {int(names[runs > 1][0])}."
        )
    if "done" not in data:
        return
    unfinished = episode[last & ~data["done"].reshape(len(data), -1).any(-1)]
    if len(unfinished):
        raise ValueError(
            f"demonstrations must be whole episodes, but {len(unfinished)} of {len(names)} end without done, "
            f"the first being episode {int(unfinished[0])}."
        )


def items(data: TensorDictBase) -> list[tuple[NestedKey, Tensor]]:
    """Every entry with its key, sorted by name."""
    return sorted(
        data.items(include_nested=True, leaves_only=True, is_leaf=_is_leaf),
        key=lambda item: key_name(item[0]),
    )


def _is_leaf(kind: type) -> bool:
    """Whether a type of entry is a leaf; TensorDict itself would hide those that are no tensors."""
    return not issubclass(kind, TensorDictBase)


def key_name(key: NestedKey) -> str:
    """A nested key in one word: "next/reward"."""
    return "/".join(_parts(key))


def listed(data: TensorDictBase) -> str:
    """The keys, for messages; of many the first ones."""
    names = [repr(key) for key, _ in items(data)]
    more = f" and {len(names) - MOST_NAMES:,} more" if len(names) > MOST_NAMES else ""
    return ", ".join(names[:MOST_NAMES]) + more
