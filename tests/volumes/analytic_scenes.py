# SPDX-License-Identifier: Apache-2.0
"""Scenes with exact distances, and exact depth images of them."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field

import numpy as np

from ggslam.scene.camera import Camera


class Scene:
    """A set of solid points, known by its signed Euclidean distance."""

    def distance(self, points: np.ndarray) -> np.ndarray:
        """Metres from the surface [...], of points [..., 3]; negative inside the solid."""
        raise NotImplementedError

    def gradient(self, points: np.ndarray, step: float = 1e-5) -> np.ndarray:
        """Of the distance, [..., 3], by central differences."""
        axes = step * np.eye(3)
        parts = [self.distance(points + axis) - self.distance(points - axis) for axis in axes]
        return np.stack(parts, -1) / (2 * step)

    def ray_lengths(self, origin: np.ndarray, directions: np.ndarray) -> np.ndarray:
        """Where rays [n, 3] first meet the surface, in units of their directions; infinite where they do not."""
        raise NotImplementedError


@dataclass(frozen=True)
class Sphere(Scene):
    centre: tuple[float, float, float] = (0.0, 0.0, 0.0)
    radius: float = 0.5

    def distance(self, points: np.ndarray) -> np.ndarray:
        return np.linalg.norm(points - np.array(self.centre), axis=-1) - self.radius

    def ray_lengths(self, origin: np.ndarray, directions: np.ndarray) -> np.ndarray:
        o = origin - np.array(self.centre)
        a, b, c = (directions**2).sum(1), directions @ o, o @ o - self.radius**2
        root = np.sqrt(np.maximum(b * b - a * c, 0))
        lengths = (-b - root) / a
        return np.where((b * b >= a * c) & (lengths > 0), lengths, np.inf)


@dataclass(frozen=True)
class Plane(Scene):
    """The half space normal . x <= offset is solid."""

    normal: tuple[float, float, float] = (0.0, 0.0, -1.0)
    offset: float = -2.0

    def distance(self, points: np.ndarray) -> np.ndarray:
        return points @ np.array(self.normal) - self.offset

    def ray_lengths(self, origin: np.ndarray, directions: np.ndarray) -> np.ndarray:
        along = directions @ np.array(self.normal)
        with np.errstate(divide="ignore", invalid="ignore"):
            lengths = (self.offset - origin @ np.array(self.normal)) / along
        return np.where((along < 0) & (lengths > 0), lengths, np.inf)


@dataclass(frozen=True)
class Box(Scene):
    """A solid box; `inside_out`: a room with solid walls around it."""

    low: tuple[float, float, float] = (-1.0, -1.0, -1.0)
    high: tuple[float, float, float] = (1.0, 1.0, 1.0)
    inside_out: bool = False

    def distance(self, points: np.ndarray) -> np.ndarray:
        beyond = np.maximum(np.array(self.low) - points, points - np.array(self.high))
        outside = np.linalg.norm(np.maximum(beyond, 0), axis=-1)
        d = outside + np.minimum(beyond.max(-1), 0)
        return -d if self.inside_out else d

    def ray_lengths(self, origin: np.ndarray, directions: np.ndarray) -> np.ndarray:
        with np.errstate(divide="ignore", invalid="ignore"):
            a, b = (np.array(self.low) - origin) / directions, (np.array(self.high) - origin) / directions
        enter, leave = np.minimum(a, b).max(1), np.maximum(a, b).min(1)
        if self.inside_out:
            return leave
        return np.where((enter <= leave) & (enter > 0), enter, np.inf)


@dataclass(frozen=True)
class Union(Scene):
    """Several scenes at once. Its distance is exact outside the solid, and inside where its parts do not overlap."""

    parts: tuple[Scene, ...] = field(default_factory=tuple)

    def distance(self, points: np.ndarray) -> np.ndarray:
        return np.min([part.distance(points) for part in self.parts], axis=0)

    def ray_lengths(self, origin: np.ndarray, directions: np.ndarray) -> np.ndarray:
        return np.min([part.ray_lengths(origin, directions) for part in self.parts], axis=0)


def small_camera(width: int = 160, height: int = 120) -> Camera:
    """About 67 degrees wide."""
    return Camera(width, height, 0.75 * width, 0.75 * width, (width - 1) / 2, (height - 1) / 2)


def looking_at(position: np.ndarray, target: np.ndarray) -> np.ndarray:
    """T_world_camera [4, 4] of a camera at `position` that looks at `target`, with the world's y downwards."""
    z = np.asarray(target, float) - position
    z /= np.linalg.norm(z)
    x = np.cross([0.0, 1.0, 0.0], z)
    x /= np.linalg.norm(x)
    T = np.eye(4)
    T[:3, :3], T[:3, 3] = np.stack([x, np.cross(z, x), z], 1), position
    return T


def render_depth(scene: Scene, camera: Camera, T_world_camera: np.ndarray) -> np.ndarray:
    """Exact depth at the pixel centres, float32 [H, W]; 0 where there is nothing."""
    directions = camera.rays().reshape(-1, 3).astype(float) @ T_world_camera[:3, :3].T
    lengths = scene.ray_lengths(T_world_camera[:3, 3], directions)
    return np.where(np.isfinite(lengths), lengths, 0).astype(np.float32).reshape(camera.height, camera.width)


def paint(scene: Scene, camera: Camera, T: np.ndarray, color_of: Callable[[np.ndarray], np.ndarray]) -> np.ndarray:
    """Image of `color_of` (points [n, 3] -> uint8 [n, 3]) at the surface; 0 where there is nothing."""
    depth = render_depth(scene, camera, T)
    points = camera.back_project(depth).reshape(-1, 3) @ T[:3, :3].T + T[:3, 3]
    color = np.where((depth > 0).reshape(-1, 1), color_of(points), 0)
    return color.astype(np.uint8).reshape(camera.height, camera.width, 3)
