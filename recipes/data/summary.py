"""Statistics of demonstrations."""

from __future__ import annotations

import numpy as np
import pandas
import torch
from numpy.typing import NDArray
from tensordict import TensorDictBase

from nht.episodes import items, key_name
from nht.recipes.data.files import Episodes, episode_returns


def lengths_of(data: TensorDictBase) -> NDArray[np.int64]:
    """Number of transitions of every episode, ``(episodes,)``."""
    return np.asarray(data["episode"].unique_consecutive(return_counts=True)[1])


def energy(actuation: torch.Tensor) -> NDArray[np.float64]:
    """Share of the actuations' energy, their squared length, in the first k global directions, k = 1 .. n.

    The directions are the singular vectors of the actuations ``(T, n)``: what ``nht.SVD`` spans. Rows with values that
    are not finite are left out.
    """
    rows = actuation[actuation.isfinite().all(dim=1)].double()
    eigenvalues = torch.linalg.eigvalsh(rows.T @ rows).flip(0).clamp_min(0.0)
    return np.asarray(eigenvalues.cumsum(0) / eigenvalues.sum().clamp_min(torch.finfo(torch.float64).tiny))


def demos_summary(episodes: Episodes, directions: int) -> str:
    """Counts, lengths, returns, success, values that are not finite, and the energy of the first directions."""
    data, lengths = episodes.data, lengths_of(episodes.data)
    bad = sum(int((~value.isfinite()).sum()) for _, value in items(data))
    shares = energy(data["actuation"])[:directions]
    lines = {
        "env": episodes.env,
        "expert": episodes.expert,
        "transitions": f"{len(data):,}",
        "episodes": f"{len(lengths):,}, and {episodes.left_out:,} left out",
        "lengths": _spread(lengths.astype(float)),
        "returns": _spread(np.asarray(episode_returns(data))) if "reward" in data else "no rewards",
        "success": f"{_success(data):.3f} of the episodes, at their last step"
        if "success" in data
        else "not known",
        "not finite": f"{bad:,} values" if bad else "none",
        "energy": "  ".join(f"k={k}: {share:.4f}" for k, share in enumerate(shares, 1)),
    }
    return "\n".join(f"{name:>12}  {text}" for name, text in lines.items())


def _spread(values: NDArray[np.float64]) -> str:
    return f"{values.mean():.6g} on average, {values.min():.6g} .. {values.max():.6g}"


def _success(data: TensorDictBase) -> float:
    last = lengths_of(data).cumsum() - 1
    return float(data["success"].reshape(len(data))[last].double().mean())


def ranges(data: TensorDictBase) -> pandas.DataFrame:
    """Per key: width, type, least, mean and largest finite value, and the number of those that are not finite."""
    rows = []
    for key, value in items(data):
        finite = value[value.isfinite()].double()
        rows.append(
            {
                "key": key_name(key),
                "width": "x".join(map(str, value.shape[1:])) or "-",
                "type": str(value.dtype).removeprefix("torch."),
                "lowest": f"{float(finite.min()):.4g}" if len(finite) else "-",
                "mean": f"{float(finite.mean()):.4g}" if len(finite) else "-",
                "highest": f"{float(finite.max()):.4g}" if len(finite) else "-",
                "not finite": value.numel() - len(finite),
            }
        )
    return pandas.DataFrame(rows)
