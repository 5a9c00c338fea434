"""Shows demonstrations: a summary on the screen, and a figure.

python -m nht.recipes.inspect_demos runs/demos-wam_wipe
"""

from __future__ import annotations

from pathlib import Path

import nht
from nht.minari_internals import FOLDER, METADATA
from nht.recipes.config import InspectDemos
from nht.recipes.data.figure import draw_figure, save
from nht.recipes.data.files import Episodes, read_episodes
from nht.recipes.data.summary import demos_summary, ranges
from nht.recipes.launch import launch
from nht.recipes.sections import SourceConfig


def main(config: InspectDemos) -> None:
    """Read demonstrations, print the summary and draw the figure."""
    if not config.demos:
        raise ValueError("nothing to inspect: name the demonstrations, inspect_demos PATH.")
    if config.directions < 1:
        raise ValueError(f"directions must be at least 1, got {config.directions}.")
    episodes = read_source(config.demos)
    out = Path(config.out or f"{config.demos.rstrip('/')}-inspection.png")
    print(demos_summary(episodes, config.directions))
    print(f"\n{ranges(episodes.data).to_string(index=False)}")
    save(draw_figure(episodes, config.directions), out)
    print(f"\nfigure in {out}")


def read_source(path: str) -> Episodes:
    """The episodes of a folder of demonstrations, an HDF5 file, a TensorDict's folder or a Minari dataset.

    Raises:
        FileNotFoundError: if it is none of them.
        ValueError: if it cannot be read.
    """
    place = Path(path)
    if (place / "manifest.json").is_file():
        demos = nht.load_demos(place)
        about = demos.manifest
        left_out = about["settings"].get("left_out_episodes", 0)
        return Episodes(demos.data, left_out, about["env"], about["expert"])
    if place.is_file() and not (place.parent / METADATA).is_file():
        return read_episodes(SourceConfig(kind="hdf5", path=path))
    if (place / "meta.json").is_file():
        return read_episodes(SourceConfig(kind="tensordict", path=path))
    if place.is_dir() and not any((folder / METADATA).is_file() for folder in (place, place / FOLDER)):
        raise FileNotFoundError(f"{path} holds no demonstrations, no TensorDict and no Minari dataset.")
    return read_episodes(SourceConfig(kind="minari", path=path))


if __name__ == "__main__":
    launch(main, InspectDemos, "inspect_demos", positional="demos")
