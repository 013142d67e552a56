# SPDX-License-Identifier: Apache-2.0
"""Light maps: how much light reaches each patch of each face, computed once for a scene that does not move.

Direct light comes from points spread over each area light, with shadows; ambient light from directions spread over the
hemisphere, darkened by what is near (ambient occlusion). All patches use the same points and directions, so that shadows
are smooth rather than noisy.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np

from ggslam.sequences.synthetic.scene import Light, Scene, Shape
from ggslam.sequences.synthetic.surfaces import face_sizes, intersect, surface_points

PATCH = 0.04
"""Metres between patches."""
LARGEST_MAP = 112
"""Patches along a face at most."""
REACH = 0.9
"""Metres within which things darken the ambient light."""
AMBIENT_RAYS = 20
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
    sizes, points, normals, owners = [], [], [], []
    for index, shape in enumerate(scene.shapes):
        R, t = shape.T_world_shape[:3, :3], shape.T_world_shape[:3, 3]
        for face, extent in enumerate(face_sizes(shape)):
            columns, rows = (int(np.clip(np.ceil(side / PATCH), 2, LARGEST_MAP)) for side in extent)
            v, u = np.mgrid[:rows, :columns].reshape(2, -1) + 0.5
            own, normal = surface_points(shape, face, u / columns, v / rows)
            sizes.append((columns, rows))
            points.append(own @ R.T + t)
            normals.append(normal @ R.T)
            owners.append(np.full(len(own), index))
    position, normal = np.concatenate(points), np.concatenate(normals)
    light = _ambient(scene, position, normal)
    for source in scene.lights:
        light += _direct(scene, source, position, normal)
    return _pack(light.astype(np.float32), sizes)


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


def _ambient(scene: Scene, position: np.ndarray, normal: np.ndarray) -> np.ndarray:
    """Ambient light [n, 3] on patches."""
    # Directions spread evenly over the hemisphere with density proportional to the cosine (golden-angle spiral).
    i = np.arange(AMBIENT_RAYS)
    radius, angle = np.sqrt((i + 0.5) / AMBIENT_RAYS), i * np.pi * (3 - np.sqrt(5))
    tangent = np.cross(normal, np.where(np.abs(normal[:, 2:]) < 0.9, [[0.0, 0.0, 1.0]], [[1.0, 0.0, 0.0]]))
    tangent /= np.linalg.norm(tangent, axis=1, keepdims=True)
    other = np.cross(normal, tangent)
    origin = position + OFFSET * normal
    directions = np.stack(
        [r * (np.cos(a) * tangent + np.sin(a) * other) + np.sqrt(1 - r * r) * normal for r, a in zip(radius, angle, strict=True)],
        1,
    )  # [n, rays, 3]
    free = np.full(directions.shape[:2], REACH, np.float32)
    for shape in scene.shapes:
        near = np.nonzero(shape.distance(origin) < REACH)[0]
        if shape.casts_shadow and len(near):
            hit = _rays(shape, origin[near, None], directions[near])
            free[near] = np.minimum(free[near], hit)
    openness = np.clip(free / REACH, 0, 1) ** 0.7
    up = ((directions[..., 2] + 1) / 2)[..., None]
    colour = np.array(scene.ambient_down) * (1 - up) + np.array(scene.ambient_up) * up
    return (colour * openness[..., None]).mean(1)


def _direct(scene: Scene, light: Light, position: np.ndarray, normal: np.ndarray) -> np.ndarray:
    """Light [n, 3] that patches get from an area light."""
    origin = position + OFFSET * normal
    to_light = light.points[None] - origin[:, None]  # [n, points, 3]
    squared = (to_light**2).sum(-1)
    length = np.sqrt(squared)
    strength = np.maximum(np.einsum("npk,nk->np", to_light, normal) / length, 0) / (squared + 0.05)
    if light.normal is not None:
        strength *= np.maximum(-(to_light @ np.array(light.normal)) / length, 0)
    lit = np.nonzero(strength.max(1) > 1e-4)[0]
    visible = np.ones(strength.shape, bool)
    centre = light.points.mean(0)
    spread = np.linalg.norm(light.points - centre, axis=1).max()
    for shape in scene.shapes:
        if not shape.casts_shadow:
            continue
        chosen = lit[_may_shade(shape, origin[lit], centre, spread)]
        if len(chosen):
            visible[chosen] &= _rays(shape, origin[chosen, None], to_light[chosen]) > 1
    return (strength * visible).mean(1)[:, None] * np.array(light.power)


def _may_shade(shape: Shape, origin: np.ndarray, centre: np.ndarray, spread: float) -> np.ndarray:
    """Whether a shape's bounding sphere touches the way from points [n, 3] to a light of radius `spread`."""
    middle, radius = shape.T_world_shape[:3, 3], float(np.linalg.norm(shape.bounds())) + spread
    way = centre - origin
    share = np.clip(((middle - origin) * way).sum(1) / np.maximum((way**2).sum(1), 1e-9), 0, 1)
    return ((origin + share[:, None] * way - middle) ** 2).sum(1) < radius**2


def _rays(shape: Shape, origin: np.ndarray, direction: np.ndarray) -> np.ndarray:
    """Ray parameters [...] of the first hits with a shape; rays in world axes, [..., 3]."""
    R, t = shape.T_world_shape[:3, :3], shape.T_world_shape[:3, 3]
    o, d = ((origin - t) @ R).astype(np.float32), (direction @ R).astype(np.float32)
    return intersect(shape, (o[..., 0], o[..., 1], o[..., 2]), (d[..., 0], d[..., 1], d[..., 2]))
