"""The robot in the browser: the geoms of a model, placed anew in every frame."""

from __future__ import annotations

from typing import Any

import mujoco
import numpy as np
from numpy.typing import NDArray
from viser import SceneApi

from nht.envs.arrays import Array
from nht.recipes.live.mirror import Mirror
from nht.recipes.live.shapes import G, Shape, shape_of_geom, shape_of_mark

STILL = 1e-6
"""A smaller change of a position [m] or quaternion is not sent."""
WORLD = "/world"
"""The frame that all but the floor stands in."""
UPRIGHT = np.array([1.0, 0.0, 0.0, 0.0])
GRID, ABOVE = 40.0, 0.002
"""Side of the grid, and its height above the floor [m]."""
CHANGING = ("geom_size", "geom_pos", "geom_quat", "geom_rgba", "mat_rgba")
"""Arrays of the model that tasks change when an episode starts."""


class Stage:
    """Draws a model body by body, with the marks of its task.

    All of it stands in a frame, ``WORLD``, that can be moved: so a robot that goes about stays in sight. Its floor then
    stays where it is, with a grid that shows how the robot moves over it.

    Args:
        scene: of the viewer.
        mirror: what is drawn.
    """

    def __init__(self, scene: SceneApi, mirror: Mirror) -> None:
        self._scene, self._mirror = scene, mirror
        self._marks: list[tuple[Shape, PosedNode]] = []
        self._world = PosedNode(scene.add_frame(WORLD, show_axes=False))
        self._grid: PosedNode | None = None
        self._build()

    def _build(self) -> None:
        model = self._mirror.model
        self._bodies = {
            body: PosedNode(self._scene.add_frame(f"{WORLD}/robot/{body}", show_axes=False))
            for body in sorted(set(map(int, model.geom_bodyid)))
        }
        for geom in range(model.ngeom):
            shape = shape_of_geom(model, geom)
            if shape is None:
                continue
            if self._mirror.root is not None and is_floor(model, geom):
                self._build_floor(geom, shape)
                continue
            name = f"{WORLD}/robot/{int(model.geom_bodyid[geom])}/{geom}"
            node = add_shape(self._scene, name, shape)
            PosedNode(node).move(model.geom_pos[geom], model.geom_quat[geom])
        self._looks = self._model_looks()
        self.update()

    def _build_floor(self, geom: int, shape: Shape) -> None:
        data = self._mirror.data
        place = np.array(data.geom_xpos[geom])
        node = add_shape(self._scene, f"/floor/{geom}", shape)
        PosedNode(node).move(place, quaternion(data.geom_xmat[geom]))
        self._floor = place + np.array([0.0, 0.0, ABOVE])
        grid = self._scene.add_grid("/floor/grid", GRID, GRID, cell_size=1.0, section_size=1.0)
        self._grid = PosedNode(grid)

    def update(self, following: bool = True) -> None:
        """Place all bodies and marks as they stand in the mirror.

        Args:
            following: whether a robot that goes about stays in sight.
        """
        data = self._mirror.data
        way = self._mirror.walked() if following else np.zeros(3)
        self._world.move(-way, UPRIGHT)
        if self._grid is not None:  # its lines are a metre apart
            self._grid.move(self._floor - np.fmod(way, 1.0), UPRIGHT)
        for body, placed in self._bodies.items():
            placed.move(data.xpos[body], data.xquat[body])
        self._update_marks()

    def renew(self) -> None:
        """Draw the geoms anew if the task has changed the model, as some do when an episode starts."""
        if self._model_looks() != self._looks:
            for placed in self._bodies.values():
                placed.node.remove()
            self._build()

    def _model_looks(self) -> bytes:
        return b"".join(getattr(self._mirror.model, name).tobytes() for name in CHANGING)

    def _update_marks(self) -> None:
        found = [
            (shape, np.array(mark.pos, dtype=np.float64), quaternion(mark.mat))
            for mark in self._mirror.marks()
            if (shape := shape_of_mark(mark)) is not None
        ]
        if [shape for shape, _ in self._marks] != [shape for shape, _, _ in found]:
            for _, placed in self._marks:
                placed.node.remove()
            self._marks = [
                (shape, PosedNode(add_shape(self._scene, f"{WORLD}/marks/{number}", shape)))
                for number, (shape, _, _) in enumerate(found)
            ]
        for (_, placed), (_, position, turn) in zip(self._marks, found, strict=True):
            placed.move(position, turn)


def is_floor(model: mujoco.MjModel, geom: int) -> bool:
    """Whether a geom is a plane that does not move."""
    return bool(model.geom_type[geom] == G.mjGEOM_PLANE and model.body_weldid[model.geom_bodyid[geom]] == 0)


class PosedNode:
    """A node of the scene, which is sent again only when it has moved."""

    def __init__(self, node: Any) -> None:
        self.node = node
        self._position, self._turn = np.full(3, np.nan), np.full(4, np.nan)

    def move(self, position: Array, turn: Array) -> None:
        """Place it at ``(3,)`` [m], turned by a quaternion ``(4,)``."""
        if not np.abs(position - self._position).max() < STILL:
            self._position = np.array(position)
            self.node.position = self._position
        if not np.abs(turn - self._turn).max() < STILL:
            self._turn = np.array(turn)
            self.node.wxyz = self._turn


def quaternion(matrix: NDArray[np.floating]) -> Array:
    """The quaternion ``(4,)`` of a rotation matrix, ``(3, 3)``."""
    found = np.zeros(4)
    mujoco.mju_mat2Quat(found, np.array(matrix, dtype=np.float64).ravel())
    return found


def add_shape(scene: SceneApi, name: str, shape: Shape) -> Any:
    """Add a shape to a scene, at its parent's origin."""
    look: dict[str, Any] = {
        "color": shape.colour,
        "opacity": None if shape.opacity >= 1 else shape.opacity,
        "cast_shadow": shape.opacity >= 1,
    }
    x, y, z = shape.size
    if shape.mesh is not None:
        vertices, faces = shape.mesh
        look["side"] = "double" if shape.kind in (G.mjGEOM_PLANE, G.mjGEOM_HFIELD) else "front"
        return scene.add_mesh_simple(name, vertices, faces, **look)
    if shape.kind == G.mjGEOM_BOX:
        return scene.add_box(name, dimensions=(2 * x, 2 * y, 2 * z), **look)
    if shape.kind == G.mjGEOM_CYLINDER:
        return scene.add_cylinder(name, radius=x, height=2 * y, **look)
    scale = (x, y, z) if shape.kind == G.mjGEOM_ELLIPSOID else x
    return scene.add_icosphere(name, radius=1.0, scale=scale, **look)
