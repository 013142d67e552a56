# SPDX-License-Identifier: Apache-2.0
"""Light maps: how much light reaches each patch of each face, computed once for a scene that does not move.

Direct light comes from points spread over each area light, with shadows; ambient light from directions spread over the
hemisphere, darkened by what is near (ambient occlusion). All patches use the same points and directions, so that
shadows are smooth rather than noisy.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import cv2
import numpy as np

from ggslam.synthetic.scene import Light, Scene, Shape
from ggslam.synthetic.surfaces import face_sizes, intersect, surface_points
from ggslam.system.tuning import Tuning


class LightingTuning(Tuning):
    """How finely light is computed."""

    patch_m = 0.07
    """Side of the patches of large faces, in metres; small faces have finer ones, down to half of it."""
    max_patches = 112
    """Most patches along a face."""
    reach_m = 0.9
    """Distance within which shapes darken the ambient light, in metres."""
    ambient_rays = 16
    """Rays for the ambient light of a patch."""
    strip = 16
    """Patches that are looked at together."""
    offset_m = 2e-3
    """Height above the surface at which rays start, in metres."""
    margin_m = 0.01
    """Distance from which a shape is out of a ray's way, in metres: far more than rounding."""


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
    return _bake(scene, 0)


def bake_further(scene: Scene, maps: LightMaps, further: Sequence[Shape]) -> LightMaps:
    """The light maps of a scene and, after them, those of further shapes in it."""
    return _join(maps, _bake(replace(scene, shapes=[*scene.shapes, *further]), len(scene.shapes)))


def _bake(scene: Scene, first: int) -> LightMaps:
    """Of every shape from a number on; those before it only cast shadows."""
    sizes: list[tuple[int, int]] = []
    points, normals, owners = [], [], []
    for index, shape in enumerate(scene.shapes[first:], first):
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
    position += LightingTuning.offset_m * normal
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
        shapes = [shape if _reaches_into(shape, low, high) else None for shape in scene.shapes]
        light[seen[inside]] += _direct(shapes, source, patches.of(inside))
    return _pack(light, sizes)


def _join(first: LightMaps, second: LightMaps) -> LightMaps:
    """Both, the second one's faces after the first one's, which stay where they are in the atlas."""
    corner = second.corner + np.array([0, len(first.atlas)])
    atlas, size = np.concatenate([first.atlas, second.atlas]), np.concatenate([first.size, second.size])
    return LightMaps(atlas, np.concatenate([first.corner, corner]), size)


class _Patches:
    """Patches to be lit: positions just above their surface and normals, float64 [n, 3]; number of their shape [n].

    Most shapes matter to few patches. The tests below find these, first by bounding spheres around strips of patches,
    then by the boxes around shapes.
    """

    def __init__(self, position: np.ndarray, normal: np.ndarray, owner: np.ndarray) -> None:
        self.position, self.normal, self.owner = position, normal, owner
        self._height = _dot(position, normal)
        strip = np.arange(len(position)) // LightingTuning.strip
        count = np.bincount(strip)
        self._centre, self._normal = (
            np.stack([np.bincount(strip, of[:, k]) / count for k in range(3)], 1) for of in (position, normal)
        )
        self._radius, self._bend = np.zeros(len(count)), np.zeros(len(count))
        np.maximum.at(self._radius, strip, _length(position - self._centre[strip]))
        np.maximum.at(self._bend, strip, _length(normal - self._normal[strip]))

    def of(self, rows: np.ndarray) -> _Patches:
        """Some of them."""
        return _Patches(self.position[rows], self.normal[rows], self.owner[rows])

    def near(self, number: int, shape: Shape, reach: float) -> np.ndarray:
        """Numbers of the patches that look at a shape and may be within `reach` metres of it."""
        apart = _length(self._centre - shape.T_world_shape[:3, 3])
        chosen = self._in_view_of(number, shape, np.nonzero(apart < reach + shape.radius() + self._radius)[0])
        return chosen[shape.distance(self.position[chosen]) < reach]

    def shadow_candidates(self, number: int, shape: Shape, light: np.ndarray) -> np.ndarray:
        """Numbers of the patches that look at a shape which may hide some of the points [n, 3] of a light."""
        middle = light.mean(0)
        spread = float(_length(light - middle).max())
        centre, way = shape.T_world_shape[:3, 3], middle - self._centre
        length = _length(way)
        share = np.clip(_dot(centre - self._centre, way) / length**2, 0, 1)
        apart = _length(self._centre + share[:, None] * way - centre)
        # The ways to a ball around the light form a cone: they spread only towards the light.
        farthest = np.minimum(share + (shape.radius() + spread) / length, 1)
        near = np.nonzero(apart < shape.radius() + farthest * spread + self._radius)[0]
        near = near[~_beside(shape, light, self._centre[near], self._radius[near, None])]
        chosen = self._in_view_of(number, shape, near)
        return chosen[~_beside(shape, light, self.position[chosen])]

    def _in_view_of(self, number: int, shape: Shape, strips: np.ndarray) -> np.ndarray:
        """Of the patches in some strips, those with some of the shape above their plane. A convex shape hides nothing
        from itself."""
        R, centre, bounds = shape.T_world_shape[:3, :3], shape.T_world_shape[:3, 3], shape.bounds()
        middle, normal = self._centre[strips], self._normal[strips]
        slack = self._radius[strips] + self._bend[strips] * (_length(centre - middle) + shape.radius())
        above = normal @ centre - _dot(middle, normal) + np.abs(normal @ R) @ bounds + slack
        chosen = (
            strips[above > -LightingTuning.margin_m, None] * LightingTuning.strip + np.arange(LightingTuning.strip)
        ).ravel()
        chosen = chosen[: np.searchsorted(chosen, len(self.position))]
        chosen = chosen[self.owner[chosen] != number]
        normal = self.normal[chosen]
        return chosen[normal @ centre - self._height[chosen] + np.abs(normal @ R) @ bounds > -LightingTuning.margin_m]


def _beside(shape: Shape, light: np.ndarray, points: np.ndarray, radius: np.ndarray | float = 0.0) -> np.ndarray:
    """Whether points [n, 3], or balls there, and a light are on one side of a shape, as of a wall: it hides nothing."""
    R, centre, reach = shape.T_world_shape[:3, :3], shape.T_world_shape[:3, 3], shape.bounds() + LightingTuning.margin_m
    own, lamp = (points - centre) @ R, (light - centre) @ R
    apart = (np.minimum(own - radius, lamp.min(0)) > reach) | (np.maximum(own + radius, lamp.max(0)) < -reach)
    return apart[:, 0] | apart[:, 1] | apart[:, 2]


def _dot(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    return np.einsum("nk,nk->n", a, b)


def _length(a: np.ndarray) -> np.ndarray:
    return np.sqrt(_dot(a, a))


def _patches(side: float) -> int:
    """Patches along a side of `side` metres."""
    return int(
        np.clip(
            np.ceil(side / np.clip(side / 8, LightingTuning.patch_m / 2, LightingTuning.patch_m)),
            2,
            LightingTuning.max_patches,
        )
    )


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
    i = np.arange(LightingTuning.ambient_rays)
    radius, angle = np.sqrt((i + 0.5) / LightingTuning.ambient_rays), i * np.pi * (3 - np.sqrt(5))
    normal = patches.normal
    tangent = np.cross(normal, np.where(np.abs(normal[:, 2:]) < 0.9, [[0.0, 0.0, 1.0]], [[1.0, 0.0, 0.0]]))
    tangent /= np.linalg.norm(tangent, axis=1, keepdims=True)
    other = np.cross(normal, tangent)
    spokes = np.stack([radius * np.cos(angle), radius * np.sin(angle), np.sqrt(1 - radius**2)])  # [3, rays]
    frames = np.stack([tangent, other, normal], 2)  # [n, 3, 3]
    directions = np.ascontiguousarray((frames @ spokes).transpose(1, 0, 2), np.float32)  # [3, n, rays]
    free = np.full(directions.shape[1:], LightingTuning.reach_m, np.float32)
    for number, shape in enumerate(scene.shapes):
        if shape.casts_shadow:
            near = patches.near(number, shape, LightingTuning.reach_m)
            hit = _first_hits(shape, patches.position[near], directions[:, near])
            free[near] = np.minimum(free[near], hit)
    openness = np.clip(free / LightingTuning.reach_m, 0, 1) ** 0.7
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
    rows = np.nonzero(strength.max(1) > 1e-4)[0]
    visible, lit = np.ones(strength.shape, bool), patches.of(rows)
    for number, shape in enumerate(shapes):
        if shape is not None and shape.casts_shadow:
            chosen = rows[lit.shadow_candidates(number, shape, light.points)]
            visible[chosen] &= _first_hits(shape, patches.position[chosen], to_light[:, chosen]) > 1
    return (strength * visible).mean(1)[:, None] * np.array(light.power)


def _first_hits(shape: Shape, origin: np.ndarray, directions: np.ndarray) -> np.ndarray:
    """Ray parameters [n, rays] of the first hits with a shape; world origins [n, 3], directions [3, n, rays]."""
    R, t = shape.T_world_shape[:3, :3].astype(np.float32), shape.T_world_shape[:3, 3]
    o = (origin - t).astype(np.float32) @ R
    d = [R[0, k] * directions[0] + R[1, k] * directions[1] + R[2, k] * directions[2] for k in range(3)]
    return intersect(shape, (o[:, :1], o[:, 1:2], o[:, 2:]), (d[0], d[1], d[2]))
