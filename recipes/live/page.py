"""The page in the browser: the scene, the basis in it, the panel, and the pads of all who look."""

from __future__ import annotations

import math
from collections import deque
from contextlib import redirect_stdout
from io import StringIO
from typing import Any

import mujoco
import numpy as np
from viser import ViserServer

from nht.recipes.live.basis import AXIS_COLOURS, Arrows, Basis, bars_html, present_basis
from nht.recipes.live.controls import Controls
from nht.recipes.live.door import LOCAL, Door
from nht.recipes.live.mirror import Mirror
from nht.recipes.live.session import POLICY, Session
from nht.recipes.live.stage import WORLD, Stage
from nht.recipes.live.tool import Tool

TRAIL = 400
"""Points of the tool's trail, at most."""
TRAIL_COLOUR = (38, 89, 217)
LIGHT = 0.35
"""Of the surroundings, beside the viewer's own lamps."""
AWAY = 1.3
"""How much farther than the model's camera people stand: the panel takes a part of the picture."""
BASIS_EVERY = 2
"""Frames between two computations of the basis, which cost as much as all else; arrows follow the tool in each."""
WRITE_EVERY = 4
"""Frames between two changes of what is written."""


class Page:
    """Shows a session to everybody who comes through a door, and lets them steer it.

    Args:
        session: what is shown.
        mirror: the session's simulator.
        tool: the point that is drawn.
        door: where browsers come in.
    """

    def __init__(self, session: Session, mirror: Mirror, tool: Tool, door: Door) -> None:
        self._session, self._mirror, self._tool, self._door = session, mirror, tool, door
        with redirect_stdout(StringIO()):  # it prints an address that is not for people
            self._server = ViserServer(host=LOCAL, port=0, label="nht steer", verbose=False)
        scene = self._server.scene
        self._server.gui.configure_theme(control_width="large", show_logo=False, show_share_button=False)
        self._server.gui.main_panel.dock_right()
        scene.world_axes.visible = False
        scene.configure_environment_map("studio", environment_intensity=LIGHT)
        self._stage = Stage(scene, mirror)
        self._arrows = Arrows(scene, mirror.moving_parts()[1])
        self._controls = Controls(self._server.gui, session, goes_about=mirror.root is not None)
        self._trail: deque[Any] = deque(maxlen=TRAIL)
        self._trail_node: Any = None
        self._motors = motor_names(mirror.model, session.base.action_spec.shape[-1])
        self._frames, self._episode, self._told_axes = 0, session.episode, ""
        self._basis: Basis | None = None
        self._told_action: tuple[str, list[float]] = ("", [])
        self._look_through_camera()
        session.commands.on_reached = lambda pad, stamp: door.tell({"reached": stamp}, str(pad))
        self._tell_pads()
        door.open(self._server.get_port(), self._heard)

    @property
    def address(self) -> str:
        """Where a browser finds it."""
        return self._door.address

    def _heard(self, pad: str, said: dict[str, Any]) -> None:
        """What a pad says, in the door's thread."""
        action, stamp = said.get("action"), said.get("stamp", 0.0)
        if not said:
            self._session.commands.drop(pad)
        elif isinstance(action, list) and all(isinstance(each, int | float) for each in action):
            self._session.commands.ask(action, pad, float(stamp) if isinstance(stamp, int | float) else 0.0)

    def show(self, part: float = 1.0) -> None:
        """Send what has changed since the last time, to everybody.

        Args:
            part: of the last step's way that is to be seen, in 0 .. 1.
        """
        now = self._session
        self._frames += 1
        if now.episode != self._episode:
            self._episode = now.episode
            self._mirror.jump()
            self._trail.clear()
            self._stage.renew()
        self._mirror.look(part)
        if self._basis is None or self._frames % BASIS_EVERY == 0:
            self._basis = present_basis(now, self._tool)
        basis = self._basis
        place = self._tool.position
        with self._server.atomic():
            self._stage.update(self._controls.follow.value)
            self._arrows.update(basis if self._controls.arrows.value else None, place)
            self._draw_trail(place)
        if self._frames % WRITE_EVERY == 0:
            self._controls.tell(self._bars(basis), place)
        self._tell_pads()

    def _bars(self, basis: Basis) -> str:
        spec = self._session.base.action_spec.space
        bounds = tuple(end.reshape(-1).double().numpy() for end in (spec.low, spec.high))
        return bars_html(
            basis, self._motors, self._session.actuation[0].double().numpy(), (bounds[0], bounds[1])
        )

    def _draw_trail(self, place: Any) -> None:
        if self._trail and np.linalg.norm(place - self._trail[-1]) < 1e-3:
            return
        self._trail.append(place)
        if self._frames % WRITE_EVERY and self._trail_node is not None:
            return
        points = np.array(self._trail, dtype=np.float32)
        if len(points) < 2 or not self._controls.trail.value:
            points = np.repeat(points[:1], 2, axis=0)
        segments = np.stack([points[:-1], points[1:]], axis=1)
        if self._trail_node is None:
            self._trail_node = self._server.scene.add_line_segments(
                f"{WORLD}/trail", segments, TRAIL_COLOUR, thickness=3.0, thickness_units="screen"
            )
        else:
            self._trail_node.points = segments

    def _tell_pads(self) -> None:
        name = self._session.interface.name
        if name != self._told_axes:
            self._told_axes = name
            axes = self._session.interface.action_dim
            self._door.tell({"axes": axes, "colours": AXIS_COLOURS, "action": [0.0] * axes})
        now = self._session
        by_policy = now.driving == POLICY and now.action.shape[-1] == now.interface.action_dim
        key = "driven" if by_policy else "action"
        action = (now.action if by_policy else now.commands.latest())[0].tolist()
        if (key, action) != self._told_action:
            self._told_action = key, action
            self._door.tell({key: [round(part, 3) for part in action]})

    def _look_through_camera(self) -> None:
        """Start behind the model's first camera, if it stands still, or else beside the robot."""
        model, data, view = self._mirror.model, self._mirror.data, self._server.initial_camera
        centre, radius = self._mirror.moving_parts()
        if model.ncam and model.cam_bodyid[0] == 0:
            place, backwards = data.cam_xpos[0], data.cam_xmat[0].reshape(3, 3)[:, 2]
            at = place - max(float(np.dot(place - centre, backwards)), 0.5 * radius) * backwards
            view.look_at, view.position = at, at + AWAY * (place - at)
            view.fov = float(np.radians(model.cam_fovy[0]))
        else:
            view.look_at, view.position = centre, centre + radius * np.array([0.8, -2.4, 0.9])
            view.fov = math.radians(45)

    def close(self) -> None:
        """Close the door and the viewer."""
        self._door.close()
        with redirect_stdout(StringIO()):
            self._server.stop()


def motor_names(model: mujoco.MjModel, motors: int) -> list[str]:
    """The names of the motors: those of the model's actuators, of its joints, or numbers, as many as there are."""
    actuators = [model.actuator(i).name for i in range(model.nu)]
    joints = [model.joint(i).name for i in range(model.njnt)]
    names = next((found for found in (actuators, joints) if len(found) == motors), [""] * motors)
    return [name or f"motor {number + 1}" for number, name in enumerate(names)]
