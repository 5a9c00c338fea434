"""Demonstrations from Minari datasets, with ``pip install 'nht[minari]'``. Nothing is ever downloaded."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from nht.demos import Demos
from nht.minari_episodes import minari_episodes
from nht.minari_file import check_minari_dataset, leaves_that_are_no_arrays, local_datasets
from nht.minari_internals import FOLDER, METADATA, MINARI_ERRORS, datasets_root, import_minari
from nht.reading import naming, shortened, shown

if TYPE_CHECKING:
    from minari import MinariDataset


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
    """For a manifest's settings: the observations left out as no arrays, if all were asked for; else empty."""
    names = [] if context is not None else list(leaves_that_are_no_arrays(dataset.observation_space))
    return {"left_out_observations": names} if names else {}


def open_minari(dataset: MinariDataset | str | Path) -> MinariDataset:
    """A local dataset from its id, folder or HDF5 file. Raises as ``from_minari`` does."""
    minari = import_minari()
    if isinstance(dataset, minari.MinariDataset):
        return dataset
    folder = _data_folder(dataset)
    try:
        check_minari_dataset(folder)
        return minari.MinariDataset(folder)
    except MINARI_ERRORS as error:
        raise ValueError(f"the Minari dataset {dataset} cannot be read: {shortened(error, 600)}.") from error


def _data_folder(dataset: str | Path) -> Path:
    """The ``data`` folder of a dataset, given by its id, its folder or the HDF5 file in it."""
    path = Path(dataset)
    folder = path.parent if path.is_file() else path
    for found in (folder, folder / FOLDER, datasets_root() / str(dataset) / FOLDER):
        if (found / METADATA).is_file():
            return found
    raise FileNotFoundError(
        f"{dataset} is neither the folder of a Minari dataset, with a metadata.json, nor the id of a local one: "
        f"there are {shown(local_datasets())}."
    )
