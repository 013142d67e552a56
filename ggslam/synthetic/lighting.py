# SPDX-License-Identifier: Apache-2.0
"""Light maps: how much light reaches each patch of each face, computed once for a scene that does not move.

Direct light comes from points spread over each area light, with shadows; ambient light from directions spread over the
hemisphere, darkened by what is near (ambient occlusion). All patches use the same points and directions, so that
shadows are smooth rather than noisy.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np

from ggslam.synthetic.scene import Light, Scene, Shape
from ggslam.synthetic.surfaces import face_sizes, intersect, surface_points

PATCH = 0.07
"""Metres between patches of large faces; small faces have finer ones, down to half of it."""
LARGEST_MAP = 112
"""Patches along a face at most."""
REACH = 0.9
"""Metres within which things darken the ambient light."""
AMBIENT_RAYS = 16
_STRIP = 16
OFFSET = 2e-3
"""Metres by which rays start above the surface."""


@dataclass
class LightMaps:
    """All light maps in one picture.

    Attributes:
        atlas: float32 [h, w, 3], light that falls on each patch, linear.
        corner: int [faces, 2], column and row of each face's first patch; size: its columns and rows.
    """

    atlas: np.ndarray
    corner: np.ndarray
    size: np.ndarray


def bake(scene: Scene) -> LightMaps:
    """Computes the light maps of every face of every shape, in the order of shapes and their faces."""
    sizes: list[tuple[int, int]] = []
    points, normals, owners = [], [], []
    for index, shape in enumerate(scene.shapes):
        R, t = shape.T_world_shape[:3, :3], shape.T_world_shape[:3, 3]
        for face, extent in enumerate(face_sizes(shape)):
            columns, rows = _patches(extent[0]), _patches(extent[1])
            v, u = np.mgrid[:rows, :columns].reshape(2, -1) + 0.5
            own, normal = surface_points(shape, face, u / columns, v / rows)
            sizes.append((columns, rows))
            points.append(own @ R.T + t)
            normals.append(normal @ R.T)
            owners.append(np.full(len(own), index))
    position, normal = np.concatenate(points), np.concatenate(normals)
    position += OFFSET * normal
    seen = np.nonzero(((position > scene.bounds[0]) & (position < scene.bounds[1])).all(1))[0]
    patches = _Patches(position[seen], normal[seen], np.concatenate(owners)[seen])
    light = np.zeros((len(position), 3), np.float32)
    light[seen] = _ambient(scene, patches)
    for source in scene.lights:
        if source.bounds is None:
            light[seen] += _direct(scene.shapes, source, patches)
            continue
        low, high = np.array(source.bounds)
        inside = np.nonzero(((patches.position >= low) & (patches.position <= high)).all(1))[0]
        lit = _Patches(patches.position[inside], patches.normal[inside], patches.owner[inside])
        shapes = [shape if _reaches_into(shape, low, high) else None for shape in scene.shapes]
        light[seen[inside]] += _direct(shapes, source, lit)
    return _pack(light, sizes)


class _Patches:
    """Patches to be lit: positions just above their surface and normals, float64 [n, 3]; number of their shape [n].

    Most shapes matter to few patches. The tests below find these, first by bounding spheres around strips of patches.
    """

    def __init__(self, position: np.ndarray, normal: np.ndarray, owner: np.ndarray) -> None:
        self.position, self.normal, self.owner = position, normal, owner
        self._strip = np.arange(len(position)) // _STRIP
        count = np.bincount(self._strip)
        self._centre = np.stack([np.bincount(self._strip, position[:, k]) / count for k in range(3)], 1)
        self._radius = np.zeros(len(count))
        np.maximum.at(self._radius, self._strip, np.linalg.norm(position - self._centre[self._strip], axis=1))

    def near(self, number: int, shape: Shape, reach: float) -> np.ndarray:
        """Numbers of the patches that look at a shape and may be within `reach` metres of it."""
        apart = np.linalg.norm(self._centre - shape.T_world_shape[:3, 3], axis=1)
        chosen = self._patches_facing(number, shape, apart < reach + shape.radius() + self._radius)
        return chosen[shape.distance(self.position[chosen]) < reach]

    def find_shaded(self, number: int, shape: Shape, light: np.ndarray, spread: float) -> np.ndarray:
        """Numbers of the patches that look at a shape which may hide part of a ball of radius `spread` at `light`."""
        centre, way = shape.T_world_shape[:3, 3], light - self._centre
        length = np.linalg.norm(way, axis=1)
        share = np.clip(((centre - self._centre) * way).sum(1) / length**2, 0, 1)
        apart = np.linalg.norm(self._centre + share[:, None] * way - centre, axis=1)
        # The ways to the ball form a cone: they spread only towards the light.
        farthest = np.minimum(share + (shape.radius() + spread) / length, 1)
        return self._patches_facing(number, shape, apart < shape.radius() + farthest * spread + self._radius)

    def _patches_facing(self, number: int, shape: Shape, strips: np.ndarray) -> np.ndarray:
        """Of the patches in some strips (bool), those with some of the shape above their plane. A convex shape hides
        nothing from itself."""
        chosen = np.nonzero(strips[self._strip])[0]
        chosen = chosen[self.owner[chosen] != number]
        towards = shape.T_world_shape[:3, 3] - self.position[chosen]
        return chosen[np.einsum("nk,nk->n", towards, self.normal[chosen]) > -shape.radius()]


def _patches(side: float) -> int:
    """Patches along a side of `side` metres."""
    return int(np.clip(np.ceil(side / np.clip(side / 8, PATCH / 2, PATCH)), 2, LARGEST_MAP))


def _pack(light: np.ndarray, sizes: list[tuple[int, int]]) -> LightMaps:
    """Puts the maps side by side on shelves of one atlas, smoothing each a little."""
    width = 1024
    order = sorted(range(len(sizes)), key=lambda i: -sizes[i][1])
    corner = np.zeros((len(sizes), 2), np.int64)
    x = y = shelf = 0
    for i in order:
        columns, rows = sizes[i]
        if x + columns > width:
            x, y, shelf = 0, y + shelf, 0
        corner[i] = x, y
        x, shelf = x + columns, max(shelf, rows)
    atlas = np.zeros((y + shelf, width, 3), np.float32)
    start = 0
    for (columns, rows), (left, top) in zip(sizes, corner, strict=True):
        patch = light[start : start + columns * rows].reshape(rows, columns, 3)
        atlas[top : top + rows, left : left + columns] = cv2.GaussianBlur(patch, (3, 3), 0.8)
        start += columns * rows
    return LightMaps(atlas, corner, np.array(sizes))


def _ambient(scene: Scene, patches: _Patches) -> np.ndarray:
    """Ambient light [n, 3] on patches."""
    # Directions spread evenly over the hemisphere with density proportional to the cosine (golden-angle spiral).
    i = np.arange(AMBIENT_RAYS)
    radius, angle = np.sqrt((i + 0.5) / AMBIENT_RAYS), i * np.pi * (3 - np.sqrt(5))
    normal = patches.normal
    tangent = np.cross(normal, np.where(np.abs(normal[:, 2:]) < 0.9, [[0.0, 0.0, 1.0]], [[1.0, 0.0, 0.0]]))
    tangent /= np.linalg.norm(tangent, axis=1, keepdims=True)
    other = np.cross(normal, tangent)
    spokes = np.stack([radius * np.cos(angle), radius * np.sin(angle), np.sqrt(1 - radius**2)])  # [3, rays]
    frames = np.stack([tangent, other, normal], 2)  # [n, 3, 3]
    directions = np.ascontiguousarray((frames @ spokes).transpose(1, 0, 2), np.float32)  # [3, n, rays]
    free = np.full(directions.shape[1:], REACH, np.float32)
    for number, shape in enumerate(scene.shapes):
        if shape.casts_shadow:
            near = patches.near(number, shape, REACH)
            hit = _first_hits(shape, patches.position[near], directions[:, near])
            free[near] = np.minimum(free[near], hit)
    openness = np.clip(free / REACH, 0, 1) ** 0.7
    up = (directions[2] + 1) / 2
    below, above = (openness * (1 - up)).mean(1), (openness * up).mean(1)
    return below[:, None] * np.array(scene.ambient_down) + above[:, None] * np.array(scene.ambient_up)


def _reaches_into(shape: Shape, low: np.ndarray, high: np.ndarray) -> bool:
    """Whether the bounding sphere of a shape meets a box."""
    centre = shape.T_world_shape[:3, 3]
    return bool(np.linalg.norm(centre - np.clip(centre, low, high)) < shape.radius())


def _direct(shapes: Sequence[Shape | None], light: Light, patches: _Patches) -> np.ndarray:
    """Light [n, 3] that patches get from an area light; None stands for shapes that hide nothing of it."""
    to_light = (light.points.T[:, None] - patches.position.T[:, :, None]).astype(np.float32)  # [3, n, points]
    squared = (to_light**2).sum(0)
    length = np.sqrt(squared)
    falling = np.einsum("knp,nk->np", to_light, patches.normal) / length
    strength = np.maximum(falling, 0) / (squared + 0.05)
    if light.normal is not None:
        strength *= np.maximum(-np.einsum("knp,k->np", to_light, np.array(light.normal)) / length, 0)
    lit = strength.max(1) > 1e-4
    visible = np.ones(strength.shape, bool)
    centre = light.points.mean(0)
    spread = float(np.linalg.norm(light.points - centre, axis=1).max())
    for number, shape in enumerate(shapes):
        if shape is not None and shape.casts_shadow:
            chosen = patches.find_shaded(number, shape, centre, spread)
            chosen = chosen[lit[chosen]]
            visible[chosen] &= _first_hits(shape, patches.position[chosen], to_light[:, chosen]) > 1
    return (strength * visible).mean(1)[:, None] * np.array(light.power)


def _first_hits(shape: Shape, origin: np.ndarray, directions: np.ndarray) -> np.ndarray:
    """Ray parameters [n, rays] of the first hits with a shape; world origins [n, 3], directions [3, n, rays]."""
    R, t = shape.T_world_shape[:3, :3].astype(np.float32), shape.T_world_shape[:3, 3]
    o = (origin - t).astype(np.float32) @ R
    d = [R[0, k] * directions[0] + R[1, k] * directions[1] + R[2, k] * directions[2] for k in range(3)]
    return intersect(shape, (o[:, :1], o[:, 1:2], o[:, 2:]), (d[0], d[1], d[2]))
