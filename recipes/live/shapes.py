"""The geoms of a MuJoCo model as things that a viewer in a browser can draw."""

from __future__ import annotations

import math
from dataclasses import dataclass, field

import mujoco
import numpy as np
from numpy.typing import NDArray

from nht.envs.arrays import Array

Colour = tuple[int, int, int]

ROUND = 32
"""Sides of what is round."""
INFINITE = 20.0
"""Half of the side of a plane without end [m]."""
SHOWN_GROUPS = 3
"""Geoms of the first groups are shown, as MuJoCo's own viewer does; the others are for collisions."""
COLOURLESS = np.array([0.5, 0.5, 0.5, 1.0], dtype=np.float32)
"""MuJoCo's colour of a geom that has none."""
G = mujoco.mjtGeom


@dataclass(frozen=True)
class Shape:
    """A geom: its kind and sizes as MuJoCo has them, its colour, and its mesh if it is none of the simple ones.

    Attributes:
        kind: of the geom.
        size: ``(3,)`` [m].
        colour: red, green, blue in 0 .. 255.
        opacity: in 0 .. 1.
        mesh: vertices ``(V, 3)`` and faces ``(F, 3)``; None for boxes, cylinders, spheres and ellipsoids.
    """

    kind: mujoco.mjtGeom
    size: tuple[float, float, float]
    colour: Colour
    opacity: float
    mesh: tuple[Array, NDArray[np.int32]] | None = field(default=None, compare=False)  # follows from the rest


def shape_of_geom(model: mujoco.MjModel, geom: int) -> Shape | None:
    """A geom of a model; None if it is not to be seen, or cannot be drawn."""
    rgba = _colour(model, geom)
    if model.geom_group[geom] >= SHOWN_GROUPS or rgba[3] == 0:
        return None
    kind = G(model.geom_type[geom])
    if kind == G.mjGEOM_MESH:
        mesh = _asset(model, int(model.geom_dataid[geom]))
        return Shape(kind, (1.0, 1.0, 1.0), *_parted(rgba), mesh)
    if kind == G.mjGEOM_HFIELD:
        return Shape(kind, (1.0, 1.0, 1.0), *_parted(rgba), _terrain(model, int(model.geom_dataid[geom])))
    return simple_shape(kind, model.geom_size[geom], rgba)


def shape_of_mark(mark: mujoco.MjvGeom) -> Shape | None:
    """A geom of an abstract scene, which has the length of what is round at another place than a model has."""
    size = np.array(mark.size, dtype=np.float64)
    if mark.type in (G.mjGEOM_CAPSULE, G.mjGEOM_CYLINDER):
        size[1] = size[2]
    return simple_shape(mark.type, size, mark.rgba)


def simple_shape(kind: int, size: Array, rgba: NDArray[np.floating]) -> Shape | None:
    """A geom that needs no asset; None for kinds that cannot be drawn, such as lines.

    Args:
        kind: an ``mjtGeom``.
        size: ``(3,)`` [m].
        rgba: red, green, blue, opacity in 0 .. 1.
    """
    kind, (x, y, z) = G(kind), (float(value) for value in size)
    drawn = {G.mjGEOM_BOX, G.mjGEOM_CYLINDER, G.mjGEOM_SPHERE, G.mjGEOM_ELLIPSOID}
    colour, opacity = _parted(rgba)
    if kind in drawn:
        return Shape(kind, (x, y, z), colour, opacity)
    if kind == G.mjGEOM_CAPSULE:
        return Shape(kind, (x, y, z), colour, opacity, capsule(x, y))
    if kind == G.mjGEOM_PLANE:
        return Shape(kind, (x, y, z), colour, opacity, _rectangle(x or INFINITE, y or INFINITE))
    return None


def capsule(radius: float, half_length: float) -> tuple[Array, NDArray[np.int32]]:
    """Vertices and faces of a capsule along z: a sphere whose halves are drawn apart [m]."""
    latitudes = np.concatenate([np.linspace(-math.pi / 2, 0, 9), np.linspace(0, math.pi / 2, 9)])
    longitudes = np.linspace(0, 2 * math.pi, ROUND, endpoint=False)
    shift = np.repeat([-half_length, half_length], 9)
    ring = np.stack([np.cos(longitudes), np.sin(longitudes)], axis=-1)
    xy = radius * np.cos(latitudes)[:, None, None] * ring
    z = np.broadcast_to((radius * np.sin(latitudes) + shift)[:, None, None], (18, ROUND, 1))
    return np.concatenate([xy, z], axis=-1).reshape(-1, 3), _grid_faces(18, ROUND, closed=True)


def _rectangle(x: float, y: float) -> tuple[Array, NDArray[np.int32]]:
    corners = np.array([[-x, -y, 0.0], [x, -y, 0.0], [x, y, 0.0], [-x, y, 0.0]])
    return corners, np.array([[0, 1, 2], [0, 2, 3]], dtype=np.int32)


def _asset(model: mujoco.MjModel, mesh: int) -> tuple[Array, NDArray[np.int32]]:
    first, count = model.mesh_vertadr[mesh], model.mesh_vertnum[mesh]
    face, faces = model.mesh_faceadr[mesh], model.mesh_facenum[mesh]
    vertices = np.array(model.mesh_vert[first : first + count], dtype=np.float64)
    return vertices, np.array(model.mesh_face[face : face + faces], dtype=np.int32)


def _terrain(model: mujoco.MjModel, field: int) -> tuple[Array, NDArray[np.int32]]:
    rows, columns = int(model.hfield_nrow[field]), int(model.hfield_ncol[field])
    start = int(model.hfield_adr[field])
    x, y, height, _ = model.hfield_size[field]
    z = height * np.array(model.hfield_data[start : start + rows * columns]).reshape(rows, columns)
    grid = np.meshgrid(np.linspace(-x, x, columns), np.linspace(-y, y, rows))
    return np.stack([*grid, z], axis=-1).reshape(-1, 3), _grid_faces(rows, columns)


def _grid_faces(rows: int, columns: int, *, closed: bool = False) -> NDArray[np.int32]:
    """Two triangles for each cell of a grid of vertices; closed, the last column meets the first."""
    row, column = np.mgrid[0 : rows - 1, 0 : columns if closed else columns - 1]
    a, b = row * columns + column, row * columns + (column + 1) % columns
    c, d = b + columns, a + columns
    faces = np.stack([np.stack([a, b, c], axis=-1), np.stack([a, c, d], axis=-1)], axis=-2)
    return faces.reshape(-1, 3).astype(np.int32)


def _colour(model: mujoco.MjModel, geom: int) -> NDArray[np.float32]:
    own, material = model.geom_rgba[geom], int(model.geom_matid[geom])
    if material >= 0 and np.array_equal(own, COLOURLESS):
        return np.array(model.mat_rgba[material])
    return np.array(own)


def _parted(rgba: NDArray[np.floating]) -> tuple[Colour, float]:
    red, green, blue = (round(255 * float(min(max(part, 0.0), 1.0))) for part in rgba[:3])
    return (red, green, blue), float(rgba[3])
