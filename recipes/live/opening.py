"""Opens a session and its page as they are configured; what is wrong is told before anything takes long."""

from __future__ import annotations

import importlib.util
from collections.abc import Iterator
from contextlib import closing, contextmanager
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, NamedTuple

from torchrl.envs import EnvBase

from nht.recipes.live.interfaces import Choices
from nht.recipes.live.mirror import Mirror, source_of
from nht.recipes.live.pilot import Pilot
from nht.recipes.live.recording import Recorder
from nht.recipes.live.session import PERSON, POLICY, Session
from nht.recipes.live.tool import Tool
from nht.recipes.maps.kinds import KINDS, known_task
from nht.recipes.run.environments import base_env, lasting_failures
from nht.recipes.run.saved_run import kept_map, read_config
from nht.recipes.sections import EnvConfig, Training

if TYPE_CHECKING:
    from nht.recipes.config import Steer
    from nht.recipes.live.page import Page

SHIPPED = ("viser", "websockets")


@contextmanager
def open_page(config: Steer) -> Iterator[tuple[Session, Page]]:
    """A session and its page, which are closed at the end; what was recorded and not saved is saved then.

    Raises:
        ImportError: without the extra.
        OSError: if the port is in use.
        FileNotFoundError, KeyError, ValueError: as of ``open_session``.
    """
    check_extra()
    from nht.recipes.live.door import Door
    from nht.recipes.live.page import Page

    with Door(config.host, config.port) as door:
        opened = open_session(config)
        with closing(opened.session), closing(Page(*opened, door)) as page:
            yield opened.session, page


def check_extra() -> None:
    """Raise ImportError if the page's packages are not installed."""
    missing = [name for name in SHIPPED if importlib.util.find_spec(name) is None]
    if missing:
        raise ImportError(f"steering in the browser needs {' and '.join(missing)}: pip install 'nht[steer]'.")


class Opened(NamedTuple):
    """A running task, its simulator to be looked at, and the point of it that is drawn."""

    session: Session
    mirror: Mirror
    tool: Tool


def open_session(config: Steer) -> Opened:
    """The running task with its interfaces, without a viewer.

    Raises:
        FileNotFoundError: if there is no such run, map or folder of demonstrations.
        KeyError, ValueError: for a task that does not exist or is not MuJoCo's, a map that does not fit it, or a kind
            of map that cannot be trained.
    """
    run = None if config.run is None else read_config(Path(config.run), config.allow)
    env = session_env(config, run)
    base = base_env(env, seed=config.seed, num_envs=1)
    try:
        mirror = Mirror(source_of(base, env.name))
        tool = Tool(mirror, config.tool, velocities=_moves_joints(base, env))
        choices = Choices(base, env, config.map, config.demos, config.seed)
        pilot = _add_maps(choices, config, run)
        recorder = Recorder(
            list(base.task.observation_sizes),
            env.name,
            config.out,
            minari=config.minari,
            settings={"options": dict(env.options)},
        )
        session = Session(base, choices.found, recorder, pilot)
    except BaseException:
        base.close()
        raise
    session.speed = config.speed
    session.drive(POLICY if pilot is not None else PERSON)
    return Opened(session, mirror, tool)


def session_env(config: Steer, run: Training | None = None) -> EnvConfig:
    """The task: the run's if there is one; failures last, and episodes are as long as a person needs."""
    env = config.env if run is None else run.env
    env = lasting_failures(env)
    task = known_task(env)
    if config.max_episode_steps is None or task is None or "max_episode_steps" not in task.options:
        return env
    return replace(env, options=env.options | {"max_episode_steps": config.max_episode_steps})


def _add_maps(choices: Choices, config: Steer, run: Training | None) -> Pilot | None:
    """Add the interfaces: the run's, those in files, those that are trained, and the teachers."""
    files = [] if config.map.file is None else [config.map.file]
    kinds = [name for name in config.maps if name in KINDS and not Path(name).exists()]
    files += [name for name in config.maps if name not in kinds]
    if config.demos.path is not None and run is None and not files and not kinds:
        kinds = [config.map.kind]
    choices.check_trainable(kinds)
    pilot = None
    if run is not None:
        folder = Path(config.run or "")
        own = choices.add(run.map.kind, kept_map(folder, run, allow=config.allow), str(folder))
        pilot = Pilot(folder, run, own)
    for file in files:
        choices.add_file(file, config.allow)
    for kind in kinds:
        choices.train(kind)
    choices.add_teachers()
    return pilot


def _moves_joints(base: EnvBase, env: EnvConfig) -> bool:
    """Whether actuations are the velocities of all joints: of a known arm whose model has no actuators."""
    task = known_task(env)
    model = getattr(base.task, "model", None)
    return task is not None and task.kinematics is not None and model is not None and model.nu == 0
