# SPDX-License-Identifier: Apache-2.0
"""Visits to a small scene made of Gaussians by hand: a floor with boxes on it, seen by cameras around it."""

from __future__ import annotations

from dataclasses import dataclass, field
from itertools import product

import numpy as np
import torch

from ggslam.changes.change import Detection
from ggslam.changes.detection import ChangeDetector
from ggslam.changes.settings import ChangeSettings
from ggslam.changes.sightings import Visit
from ggslam.native.loader import NativeContext
from ggslam.scene.camera import Camera
from ggslam.scene.gaussian_map import GaussianMap
from ggslam.scene.poses import se3_exp

CAMERA = Camera(160, 120, 130.0, 130.0, 79.5, 59.5)
FLOOR = 1


@dataclass(frozen=True)
class Box:
    """A box with the floor's z = 0 under it; each face has another colour."""

    id: int
    at: tuple[float, float]
    size: tuple[float, float, float] = (0.16, 0.1, 0.12)
    turn: float = 0.0
    hue: float = 0.0
    cut: int = 0
    """Id of its half with x > 0; 0: it is whole."""
    plain: bool = False
    """Whether it is of one colour."""

    def surface(self, spacing: float = 0.008) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
        """Points, normals, colours and ids."""
        half, parts = np.array(self.size) / 2, []
        for axis, sign in product(range(3), (-1, 1)):
            if axis == 2 and sign < 0:
                continue
            u, v = [k for k in range(3) if k != axis]
            grid = np.meshgrid(*(np.arange(-half[k], half[k] + 1e-6, spacing) for k in (u, v)))
            points = np.zeros((grid[0].size, 3))
            points[:, u], points[:, v], points[:, axis] = grid[0].ravel(), grid[1].ravel(), sign * half[axis]
            normals = np.zeros_like(points)
            normals[:, axis] = sign
            shade = 0.5 + 0.45 * np.sin(self.hue + np.array([0.0, 2.1, 4.2]) + 1.3 * (2 * axis + (sign > 0)))
            colors = np.tile(shade, (len(points), 1)) * (0.8 + 0.2 * np.sign(points[:, [u]] * points[:, [v]]))
            if self.plain:
                colors[:] = 0.6
            parts.append((points, normals, colors))
        points, normals, colors = (np.concatenate(values) for values in zip(*parts, strict=True))
        ids = np.where(points[:, 0] > 0, self.cut or self.id, self.id)
        T = self.pose()
        return points @ T[:3, :3].T + T[:3, 3], normals @ T[:3, :3].T, colors, ids

    def pose(self) -> np.ndarray:
        """T_world_box."""
        T = se3_exp(np.array([0, 0, 0, 0, 0, np.radians(self.turn)]))
        T[:3, 3] = (*self.at, self.size[2] / 2)
        return T


def looking_at(eye: tuple[float, float, float], target: tuple[float, float, float]) -> np.ndarray:
    """T_world_camera."""
    forward = np.array(target) - eye
    forward /= np.linalg.norm(forward)
    right = np.cross(forward, (0, 0, 1))
    right /= np.linalg.norm(right)
    T = np.eye(4)
    T[:3, :3], T[:3, 3] = np.stack([right, np.cross(forward, right), forward], 1), eye
    return T


@dataclass(frozen=True)
class SmallVisit:
    """What stands there, and from where it is looked at: degrees around the middle."""

    boxes: list[Box]
    around: tuple[float, ...] = (0, 50, 100, 150, 200, 250, 300)
    target: tuple[float, float, float] = (0.0, 0.0, 0.05)
    distance: float = 0.8
    floor_ids: dict[int, int] = field(default_factory=dict)

    def build(self) -> Visit:
        """As the detector takes it."""
        x, y = np.meshgrid(np.arange(-0.7, 0.7, 0.014), np.arange(-0.7, 0.7, 0.014))
        floor = np.stack([x.ravel(), y.ravel(), np.zeros(x.size)], 1)
        tiles = (np.floor(floor[:, 0] / 0.1) + np.floor(floor[:, 1] / 0.1)) % 2
        parts = [(floor, np.tile([0.0, 0, 1], (len(floor), 1)), np.outer(0.35 + 0.3 * tiles, [1, 0.9, 0.7]),
                  np.full(len(floor), FLOOR))]  # fmt: skip
        parts += [box.surface() for box in self.boxes]
        points, normals, colors, ids = (np.concatenate(values) for values in zip(*parts, strict=True))
        gaussians = GaussianMap(0)
        scale = np.where(ids == FLOOR, 0.008, 0.005)
        gaussians.insert(
            torch.from_numpy(points).float(), torch.tensor([[1.0, 0, 0, 0]]).repeat(len(points), 1),
            torch.from_numpy(np.log(np.tile(scale[:, None], (1, 3)))).float(), torch.full((len(points),), 3.0),
            torch.from_numpy(colors).float(), object_id=torch.from_numpy(ids.astype(np.int32)),
        )  # fmt: skip
        eyes = [
            (self.distance * np.cos(np.radians(a)), self.distance * np.sin(np.radians(a)), 0.5) for a in self.around
        ]
        poses = np.stack([looking_at((x + self.target[0], y + self.target[1], z), self.target) for x, y, z in eyes])
        return Visit(gaussians, [CAMERA] * len(poses), poses, points, normals, True)


def detect(old: SmallVisit, new: SmallVisit, ids: bool | None = None) -> tuple[Detection, ChangeDetector]:
    """What the detector finds."""
    detector = ChangeDetector(old.build(), new.build(), ChangeSettings(), NativeContext(2), ids)
    return detector.detect(), detector
