# SPDX-License-Identifier: Apache-2.0
"""Describes a scene: solid shapes with materials, lights and instance names; independent of ray casting.

World axes: x and y along the floor, z up, metres.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from enum import IntEnum

import numpy as np

from ggslam.synthetic.materials import Material

Vector = tuple[float, float, float]


class Kind(IntEnum):
    """Kind of solid. Each surface is cut into faces with coordinates (u, v) in [0, 1]."""

    BOX = 0
    """Half extents `half`. Faces -x, +x, -y, +y, -z, +z."""
    ELLIPSOID = 1
    """Radii `half`. One face: longitude, latitude."""
    FRUSTUM = 2
    """Around z, half height half[2], radius half[0] at the bottom and `top` times that at the top. Faces: side, upper
    cap, lower cap."""


FACES = {Kind.BOX: 6, Kind.ELLIPSOID: 1, Kind.FRUSTUM: 3}


@dataclass(frozen=True)
class Shape:
    """One solid.

    Attributes:
        kind: see `Kind`.
        half: half extents or radii, metres.
        T_world_shape: float64 [4, 4].
        material: of every face; `faces` names exceptions by face number.
        instance: id in the masks.
        top: upper radius of a frustum relative to the lower one.
        casts_shadow: false for lamp shades, which would hide the light inside them.
    """

    kind: Kind
    half: Vector
    T_world_shape: np.ndarray
    material: Material
    instance: int
    faces: dict[int, Material] = field(default_factory=dict)
    top: float = 1.0
    casts_shadow: bool = True

    def bounds(self) -> np.ndarray:
        """Half extents [3] of the bounding box in the shape's own axes."""
        radius = max(1.0, self.top) if self.kind == Kind.FRUSTUM else 1.0
        return np.array([self.half[0] * radius, self.half[1] * radius, self.half[2]])

    def radius(self) -> float:
        """Radius of the bounding sphere around the origin of the shape's axes."""
        return float(np.linalg.norm(self.bounds()))

    def distance(self, points: np.ndarray) -> np.ndarray:
        """Distance [n] of world points [n, 3] to the bounding box of the shape; 0 inside."""
        R, t = self.T_world_shape[:3, :3], self.T_world_shape[:3, 3]
        outside = np.maximum(np.abs((points - t) @ R) - self.bounds(), 0)
        return np.sqrt(np.einsum("nk,nk->n", outside, outside))


@dataclass(frozen=True)
class Light:
    """A small area that shines: `points` [n, 3] on it, colour times intensity [3] at 1 m, the direction it faces (None:
    all directions), and the lowest and highest corner of the space that it lights (None: all there is)."""

    points: np.ndarray
    power: Vector
    normal: Vector | None = None
    bounds: tuple[Vector, Vector] | None = None


@dataclass
class Scene:
    """A furnished place.

    Attributes:
        shapes: solids; walls and floors are thick boxes.
        lights: area lights.
        instance_names: mask id -> name, from 1.
        ambient_up, ambient_down: colour of the light that comes from above and from below.
        bounds: lowest and highest corner of the inhabited space; what lies outside is never seen and gets no light.
        walk: centre (x, y, z) and radii (x, y) of an ellipse with free space around it, for the camera.
        interest: points [n, 3] worth looking at; the first is where a recording begins.
        route: [n, 5] x, y, z in metres, heading (from the x axis towards y) and pitch (up) in degrees: a way for
            the camera, closed for the trajectory "route" and open for "walk"; headings run on past 360. Empty where the
            scene is one room.
    """

    shapes: list[Shape] = field(default_factory=list)
    lights: list[Light] = field(default_factory=list)
    instance_names: dict[int, str] = field(default_factory=dict)
    ambient_up: Vector = (0.40, 0.40, 0.40)
    ambient_down: Vector = (0.24, 0.20, 0.16)
    bounds: tuple[Vector, Vector] = ((-1e6, -1e6, -1e6), (1e6, 1e6, 1e6))
    walk: tuple[Vector, tuple[float, float]] = ((0.0, 0.0, 1.4), (0.5, 0.5))
    interest: np.ndarray = field(default_factory=lambda: np.zeros((1, 3)))
    route: np.ndarray = field(default_factory=lambda: np.zeros((0, 5)))


class SceneBuilder:
    """Adds shapes to a scene, in the coordinates of a piece of furniture that can be turned and moved.

    >>> builder = SceneBuilder()
    >>> table = builder.instance("table", at=(2, 1, 0), turn=30)
    >>> table.box((0, 0, 0.7), (1.2, 0.8, 0.04), wood)
    """

    def __init__(self) -> None:
        self.scene = Scene()

    def instance(self, name: str, at: Vector = (0.0, 0.0, 0.0), turn: float = 0.0) -> Placer:
        """A new instance with its own mask id, placed at `at` and turned about z by `turn` degrees."""
        identifier = len(self.scene.instance_names) + 1
        self.scene.instance_names[identifier] = name
        return Placer(self.scene, identifier, _make_transform(at, (0.0, 0.0, turn)))

    def light(self, points: np.ndarray, power: Vector, normal: Vector | None = None) -> None:
        """Adds an area light; see `Light`."""
        self.scene.lights.append(Light(np.asarray(points, float), power, normal))


@dataclass(frozen=True)
class Placer:
    """Adds shapes of one instance. Sizes are full sizes; angles are degrees about x, then y, then z."""

    scene: Scene
    identifier: int
    T_world_own: np.ndarray

    def shift(self, at: Vector, turn: float = 0.0) -> Placer:
        """The same instance with its origin shifted and turned, for repeated parts."""
        return replace(self, T_world_own=self.T_world_own @ _make_transform(at, (0.0, 0.0, turn)))

    def box(
        self, centre: Vector, size: Vector, material: Material, angles: Vector = (0.0, 0.0, 0.0),
        faces: dict[int, Material] | None = None,
    ) -> None:  # fmt: skip
        """A box; `faces` gives some faces (-x, +x, -y, +y, -z, +z) another material."""
        half = (size[0] / 2, size[1] / 2, size[2] / 2)
        self._add(Shape(Kind.BOX, half, _make_transform(centre, angles), material, self.identifier, faces or {}))

    def ellipsoid(
        self, centre: Vector, radii: Vector, material: Material, angles: Vector = (0.0, 0.0, 0.0), shadow: bool = True
    ) -> None:
        """An ellipsoid (a ball for equal radii)."""
        pose = _make_transform(centre, angles)
        self._add(Shape(Kind.ELLIPSOID, radii, pose, material, self.identifier, casts_shadow=shadow))

    def cylinder(
        self, centre: Vector, radius: float, height: float, material: Material, angles: Vector = (0.0, 0.0, 0.0),
        top: float = 1.0, cap: Material | None = None, shadow: bool = True,
    ) -> None:  # fmt: skip
        """A cylinder about z, or a truncated cone of upper radius `top` times `radius`; `cap` is for the upper cap."""
        faces = {1: cap} if cap is not None else {}
        half = (radius, radius, height / 2)
        pose = _make_transform(centre, angles)
        self._add(Shape(Kind.FRUSTUM, half, pose, material, self.identifier, faces, top, shadow))

    def _add(self, shape: Shape) -> None:
        self.scene.shapes.append(replace(shape, T_world_shape=self.T_world_own @ shape.T_world_shape))


def _make_transform(at: Vector, angles: Vector) -> np.ndarray:
    """Transform [4, 4]: rotation about x, then y, then z in degrees, then translation."""
    (cx, cy, cz), (sx, sy, sz) = np.cos(np.radians(angles)), np.sin(np.radians(angles))
    x = np.array([[1, 0, 0], [0, cx, -sx], [0, sx, cx]])
    y = np.array([[cy, 0, sy], [0, 1, 0], [-sy, 0, cy]])
    z = np.array([[cz, -sz, 0], [sz, cz, 0], [0, 0, 1]])
    T = np.eye(4)
    T[:3, :3], T[:3, 3] = z @ y @ x, at
    return T
