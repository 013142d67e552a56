# SPDX-License-Identifier: Apache-2.0
"""Geometry of the solids: where rays meet them, and coordinates on their faces."""

from __future__ import annotations

import numpy as np

from ggslam.synthetic.scene import Kind, Shape
from ggslam.system.tuning import Tuning


class SurfaceTuning(Tuning):
    """Where rays begin."""

    near = np.float32(1e-3)
    """Distance along a ray up to which hits are ignored."""


def intersect(shape: Shape, origin: tuple[np.ndarray, ...], direction: tuple[np.ndarray, ...]) -> np.ndarray:
    """First ray parameter t > 0 at which rays enter a solid, infinity where they miss it or start inside it.

    Args:
        shape: the solid.
        origin, direction: x, y and z of the rays in the shape's own axes, float32 arrays of shapes that broadcast.
            Directions need not have unit length; t is measured in their lengths.
    """
    with np.errstate(divide="ignore", invalid="ignore"):
        if shape.kind == Kind.BOX:
            return _intersect_box(np.asarray(shape.half, np.float32), origin, direction)
        if shape.kind == Kind.ELLIPSOID:
            return _intersect_ellipsoid(np.asarray(shape.half, np.float32), origin, direction)
        return _intersect_frustum(shape, origin, direction)


def _intersect_box(half: np.ndarray, origin: tuple[np.ndarray, ...], direction: tuple[np.ndarray, ...]) -> np.ndarray:
    """Slab method."""
    enter, leave = None, None
    for h, o, d in zip(half, origin, direction, strict=True):
        inverse = np.float32(1) / d
        middle = o * inverse
        reach = h * np.abs(inverse)
        low, high = -middle - reach, reach - middle
        enter = low if enter is None else np.maximum(enter, low)
        leave = high if leave is None else np.minimum(leave, high)
    assert enter is not None and leave is not None
    return np.where((enter < leave) & (enter > SurfaceTuning.near), enter, np.float32(np.inf))


def _intersect_ellipsoid(
    radii: np.ndarray, origin: tuple[np.ndarray, ...], direction: tuple[np.ndarray, ...]
) -> np.ndarray:
    o = [a / r for a, r in zip(origin, radii, strict=True)]
    d = [a / r for a, r in zip(direction, radii, strict=True)]
    a = d[0] * d[0] + d[1] * d[1] + d[2] * d[2]
    b = o[0] * d[0] + o[1] * d[1] + o[2] * d[2]
    c = o[0] * o[0] + o[1] * o[1] + o[2] * o[2] - np.float32(1)
    t = (-b - np.sqrt(b * b - a * c)) / a
    return np.where(t > SurfaceTuning.near, t, np.float32(np.inf))  # NaN where the ray misses compares false


def _intersect_frustum(shape: Shape, origin: tuple[np.ndarray, ...], direction: tuple[np.ndarray, ...]) -> np.ndarray:
    """Side x^2 + y^2 = (middle + slope z)^2 between the caps, and the two caps."""
    half, bottom, upper = np.float32(shape.half[2]), np.float32(shape.half[0]), np.float32(shape.half[0] * shape.top)
    middle, slope = (bottom + upper) / 2, (upper - bottom) / (2 * half)
    (ox, oy, oz), (dx, dy, dz) = origin, direction
    radius, change = middle + slope * oz, slope * dz
    a = dx * dx + dy * dy - change * change
    b = ox * dx + oy * dy - radius * change
    c = ox * ox + oy * oy - radius * radius
    t = (-b - np.sqrt(b * b - a * c)) / a
    best = np.where((t > SurfaceTuning.near) & (np.abs(oz + t * dz) <= half), t, np.float32(np.inf))
    for z, r in ((-half, bottom), (half, upper)):
        t = (z - oz) / dz
        x, y = ox + t * dx, oy + t * dy
        best = np.where((t > SurfaceTuning.near) & (t < best) & (x * x + y * y <= r * r), t, best)
    return best


def face_sizes(shape: Shape) -> list[tuple[float, float]]:
    """Width and height in metres of each face, for texture and light map resolution."""
    x, y, z = (2 * h for h in shape.half)
    if shape.kind == Kind.BOX:
        return [(y, z), (y, z), (x, z), (x, z), (x, y), (x, y)]
    if shape.kind == Kind.ELLIPSOID:
        return [(np.pi * (x + y) / 2, np.pi * z / 2)]
    wide = max(1.0, shape.top)
    return [(np.pi * x * wide, z), (x * shape.top, x * shape.top), (x, x)]


def locate(
    kind: Kind, points: np.ndarray, half: np.ndarray, top: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Face, its coordinates and the outward normal at points on the surface of shapes of one kind.

    Args:
        kind: of all the shapes.
        points: float32 [n, 3] in the axes of each point's shape.
        half, top: float32 [n, 3], [n], of each point's shape.

    Returns:
        face int [n]; u, v float32 [n] in [0, 1], v downwards on upright faces; normal float32 [n, 3] of any length.
    """
    q = points / half
    if kind == Kind.BOX:
        return _locate_box(q)
    longitude = np.arctan2(q[:, 1], q[:, 0]) * np.float32(1 / (2 * np.pi)) % np.float32(1)
    if kind == Kind.ELLIPSOID:
        latitude = np.arccos(np.clip(q[:, 2], -1, 1)) * np.float32(1 / np.pi)
        return np.zeros(len(q), np.int64), longitude, latitude, q / half
    upper, lower = q[:, 2] > 0.9995, q[:, 2] < -0.9995
    cap = upper | lower
    rim = np.where(upper, top, np.float32(1))
    u = np.where(cap, (1 + q[:, 0] / rim) / 2, longitude)
    v = np.where(cap, (1 - q[:, 1] / rim) / 2, (1 - q[:, 2]) / 2)
    slope = half[:, 0] * (top - 1) / (2 * half[:, 2])
    side = np.stack([points[:, 0], points[:, 1], -slope * np.hypot(points[:, 0], points[:, 1])], 1)
    normal = np.where(cap[:, None], np.array([0, 0, 1], np.float32) * np.sign(q[:, 2:]), side)
    return np.where(upper, 1, np.where(lower, 2, 0)), u, v, normal


def _locate_box(q: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    axis = np.argmax(np.abs(q), 1)
    sign = np.sign(q[np.arange(len(q)), axis])
    across = np.where(axis == 0, sign * q[:, 1], np.where(axis == 1, -sign * q[:, 0], q[:, 0]))
    down = np.where(axis == 2, q[:, 1], q[:, 2])
    normal = np.zeros_like(q)
    normal[np.arange(len(q)), axis] = sign
    return 2 * axis + (sign > 0), (1 + across) / 2, (1 - down) / 2, normal


def surface_points(shape: Shape, face: int, u: np.ndarray, v: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Points and unit normals, float64 [n, 3] in the shape's axes, at coordinates u, v [n]: the inverse of `locate`."""
    half = np.array(shape.half)
    if shape.kind == Kind.BOX:
        axis, sign = face // 2, 1.0 if face % 2 else -1.0
        q = np.empty((len(u), 3))
        q[:, axis] = sign
        across, down = 2 * u - 1, 1 - 2 * v
        other = (1, 0, 0)[axis]
        q[:, other] = across * (sign, -sign, 1.0)[axis]
        q[:, 1 if axis == 2 else 2] = down
        normal = np.zeros((len(u), 3))
        normal[:, axis] = sign
        return q * half, normal
    angle = 2 * np.pi * u
    if shape.kind == Kind.ELLIPSOID:
        sine = np.sin(np.pi * v)
        q = np.stack([np.cos(angle) * sine, np.sin(angle) * sine, np.cos(np.pi * v)], 1)
        return q * half, _unit(q / half)
    if face == 0:
        z = 1 - 2 * v
        radius = half[0] * (1 + (shape.top - 1) * (1 + z) / 2)
        slope = half[0] * (shape.top - 1) / (2 * half[2])
        points = np.stack([np.cos(angle) * radius, np.sin(angle) * radius, z * half[2]], 1)
        return points, _unit(np.stack([np.cos(angle), np.sin(angle), np.full(len(u), -slope)], 1))
    rim, sign = (half[0] * shape.top, 1.0) if face == 1 else (half[0], -1.0)
    points = np.stack([(2 * u - 1) * rim, (1 - 2 * v) * rim, np.full(len(u), sign * half[2])], 1)
    return points, np.tile([0.0, 0.0, sign], (len(u), 1))


def _unit(v: np.ndarray) -> np.ndarray:
    return v / np.maximum(np.linalg.norm(v, axis=-1, keepdims=True), 1e-12)
