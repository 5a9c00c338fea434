"""Films of test episodes: a grid of copies with the tool's trail and the outcome of each, and contact sheets."""

from __future__ import annotations

import math
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import imageio.v2 as imageio
import numpy as np
from numpy.typing import NDArray
from PIL import Image, ImageDraw
from tensordict import TensorDictBase
from torchrl.envs import TransformedEnv

from nht.envs.offscreen import coarse_shadows
from nht.envs.simulation import Simulation
from nht.recipes.progress_bar import progress_bar
from nht.recipes.run.evaluation import Evaluation, Policy, evaluate

Picture = NDArray[np.uint8]

TILE = (480, 360)  # width and height of one copy's picture [pixel]
SHADOWS = 1_024  # pixels of a shadow map's side
SMOOTH = 30  # frames per second that are enough
MOST_FRAMES = 201  # of a film: 200 steps and their start; of longer episodes fewer steps are filmed
JERKY = 15  # frames per second; a film that would have fewer because steps are left out runs faster than time
TRAIL_EVERY = 4  # steps; each piece of a line costs time in software rendering
SHEET_COLUMNS = 6  # moments of an episode on the contact sheet
PRESET = "veryfast"  # of x264; its own choice takes three times as long for a file hardly smaller
GAP = 40  # grey of a tile without a copy
COLOURS = {"failed": (200, 40, 40), "success": (30, 150, 60), "": (120, 120, 120)}
BORDER = 4  # pixels
FONT, MARGIN = 18, (12, 10)  # of what is written into a tile [pixel]
STATE_FONT, STATE_HEIGHT = 15, 22  # and on a contact sheet, at half the size


def record_video(env: TransformedEnv, policy: Policy, path: Path) -> Evaluation:
    """Film one episode of every copy of ``env`` as an MP4 in real time, with a contact sheet beside it.

    A copy's tile has a trail of the tool, where the task has one, the time, and a border that says how the episode
    stands: green for success, red for failure. The tile of an episode that has ended stands still. Films have about
    ``MOST_FRAMES`` pictures at most: of long episodes fewer steps are filmed, and the film may then run several times
    faster than real time, which its tiles say.

    Args:
        env: a batched task behind any transforms.
        policy: reads the observation, writes ``"action"``.
        path: of the MP4; the contact sheet has the suffix ``.png``, a row per copy, from start to end.

    Raises:
        RuntimeError: if this machine cannot render offscreen.
    """
    film = Film(env.base_env.task)
    path.parent.mkdir(parents=True, exist_ok=True)
    try:
        with progress_bar(film.steps, "film", "step") as bar:

            def watch(outcome: TensorDictBase) -> None:
                film.add(outcome)
                bar.update()

            outcome = evaluate(env, policy, on_step=watch)
    finally:
        film.close()
    write_film(path, film.frames, film.frames_per_second)
    imageio.imwrite(path.with_suffix(".png"), contact_sheet(film.frames, film.states))
    return outcome


def write_film(path: Path, frames: list[list[Picture]], frames_per_second: float) -> None:
    """Write moments, each with a picture of every copy, as an MP4."""
    options: dict[str, Any] = {
        "fps": frames_per_second,
        "macro_block_size": 8,
        "ffmpeg_params": ["-preset", PRESET],
    }
    with imageio.get_writer(path, **options) as writer:
        video: Any = writer  # its stub lacks append_data
        for tiles in frames:
            video.append_data(grid(tiles))


@dataclass(frozen=True)
class State:
    """What is said of a copy at a moment.

    Attributes:
        seconds: since its episode began.
        outcome: ``success``, ``failed``, or nothing yet.
        name: of the copy, if it has one.
    """

    seconds: float
    outcome: str = ""
    name: str = ""

    def told(self, digits: int = 1, *more: str) -> str:
        """All that in a line, with ``more`` behind the time."""
        parts = (self.name, f"{self.seconds:.{digits}f} s", *more, self.outcome)
        return "  ".join(part for part in parts if part)


class Film:
    """Takes pictures of all copies of a task, step by step.

    Args:
        task: what to film.
        name: to write into each picture.

    Attributes:
        frames: of every moment filmed, a picture ``(height, width, 3)`` per copy.
        states: of every moment filmed, how each copy stands.
        frames_per_second: at which the film runs at ``speed``.
        speed: as a multiple of real time.
        steps: largest number of steps that are added, the reset included.
    """

    def __init__(self, task: Simulation, name: str = "") -> None:
        self.frames: list[list[Picture]] = []
        self.states: list[list[State]] = []
        self._name = name
        steps_per_second = 1 / task.time_per_step
        smooth = math.ceil(steps_per_second / SMOOTH)
        self.steps = task.max_episode_steps + 1
        self._every = max(smooth, math.ceil(self.steps / MOST_FRAMES))
        rate = steps_per_second / self._every
        self.speed = max(1, math.ceil(JERKY / rate)) if self._every > smooth else 1
        self.frames_per_second = rate * self.speed
        self._seconds_per_step = task.time_per_step
        with coarse_shadows(SHADOWS):
            self._renderer = task.renderer(*TILE)
        self._trail: list[NDArray[np.float64]] = []
        self._steps = 0
        self._running = np.ones(task.num_envs, dtype=bool)

    def add(self, outcome: TensorDictBase) -> None:
        """Film the result of a reset or step if a picture is due or an episode has ended."""
        done, success, failure = (outcome[flag].view(-1).numpy() for flag in ("done", "success", "failure"))
        if (tool := outcome.get("tool_position", None)) is not None:
            self._trail.append(tool.double().numpy())
        if self._steps % self._every == 0 or (done & self._running).any():
            states = [self._state(row, success[row], failure[row]) for row in range(len(done))]
            self.frames.append([self._tile(row, state) for row, state in enumerate(states)])
            self.states.append(states)
        self._running &= ~done
        self._steps += 1

    def _state(self, row: int, success: bool, failure: bool) -> State:
        if not self._running[row]:
            return self.states[-1][row]
        outcome = "failed" if failure else "success" if success else ""
        return State(self._steps * self._seconds_per_step, outcome, self._name)

    def _tile(self, row: int, state: State) -> Picture:
        if not self._running[row]:
            return self.frames[-1][row]
        trail = np.stack([points[row] for points in self._trail[::TRAIL_EVERY]]) if self._trail else None
        picture = Image.fromarray(self._renderer.frame(row, trail))
        frame(picture, state.outcome)
        ImageDraw.Draw(picture).text(
            MARGIN,
            state.told(2, f"{self.speed} x" * (self.speed > 1)),
            fill=(255, 255, 255),
            stroke_width=2,
            stroke_fill=(0, 0, 0),
            font_size=FONT,
        )
        return np.asarray(picture)

    def close(self) -> None:
        """Release the renderer."""
        self._renderer.close()


def frame(picture: Image.Image, outcome: str) -> None:
    """Draw a border in the colour of an outcome."""
    draw = ImageDraw.Draw(picture)
    draw.rectangle((0, 0, picture.width - 1, picture.height - 1), outline=COLOURS[outcome], width=BORDER)


def grid(tiles: list[Picture]) -> Picture:
    """Pictures of one size side by side, in about as many rows as columns; dark where there is none left."""
    columns = grid_columns(len(tiles))
    missing = -len(tiles) % columns
    tiles = tiles + [np.full_like(tiles[0], GAP)] * missing
    rows = [np.concatenate(tiles[start : start + columns], axis=1) for start in range(0, len(tiles), columns)]
    return np.concatenate(rows, axis=0)


def grid_columns(count: int) -> int:
    """Columns of a grid: about as many as rows, or one or two more if that leaves fewer gaps. Three lie in one row."""
    square = math.ceil(math.sqrt(count))
    return min(range(square, max(3, square + 1) + 1), key=lambda columns: (-count % columns, columns))


def contact_sheet(frames: list[list[Picture]], states: list[list[State]] | None = None) -> Picture:
    """One row per copy: pictures of its film from start to end, at half size.

    Args:
        frames: of every moment, a picture of each copy.
        states: how the copies stand then, which is written anew in a size that can be read; None leaves the pictures.
    """
    moments = np.linspace(0, len(frames) - 1, SHEET_COLUMNS).round().astype(int)
    columns = []
    for moment in moments:
        tiles = [tile[::2, ::2] for tile in frames[moment]]
        if states is not None:
            tiles = [_stated(tile, state) for tile, state in zip(tiles, states[moment], strict=True)]
        columns.append(np.concatenate(tiles, axis=0))
    return np.concatenate(columns, axis=1)


def _stated(tile: Picture, state: State) -> Picture:
    """A small picture with a bar that says how the copy stands."""
    picture = Image.fromarray(tile)
    draw = ImageDraw.Draw(picture)
    bar = (0, 0, picture.width - 1, STATE_HEIGHT)
    draw.rectangle(bar, fill=COLOURS[state.outcome] if state.outcome else (60, 60, 60))
    draw.text((BORDER + 4, 2), state.told(), fill=(255, 255, 255), font_size=STATE_FONT)
    frame(picture, state.outcome)
    return np.asarray(picture)
