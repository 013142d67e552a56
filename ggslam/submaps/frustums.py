# SPDX-License-Identifier: Apache-2.0
"""Which boxes cameras may see: the test that decides what must be in memory before a view is rendered."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from ggslam.scene.camera import Camera

_AT_ONCE = 1 << 20
"""Pairs of a camera and a box that are tested at a time."""


@dataclass(frozen=True)
class Frustums:
    """The visible spaces of K cameras: a point x is in one if normals @ x + offsets >= 0 for all six planes.

    Attributes:
        normals: float64 [K, 6, 3], unit, inwards.
        offsets: float64 [K, 6], metres.
    """

    normals: np.ndarray
    offsets: np.ndarray

    @staticmethod
    def of(camera: Camera, T_camera_world: np.ndarray, reach: Sequence[float] | np.ndarray) -> Frustums:
        """The frustums between the camera and depth `reach` [K] (metres) of cameras at `T_camera_world` [K, 4, 4]."""
        T, reach = np.asarray(T_camera_world, np.float64).reshape(-1, 4, 4), np.asarray(reach, np.float64)
        left, right = (-0.5 - camera.cx) / camera.fx, (camera.width - 0.5 - camera.cx) / camera.fx
        top, bottom = (-0.5 - camera.cy) / camera.fy, (camera.height - 0.5 - camera.cy) / camera.fy
        own = np.array([[1, 0, -left], [-1, 0, right], [0, 1, -top], [0, -1, bottom], [0, 0, 1], [0, 0, -1]], float)
        own /= np.linalg.norm(own, axis=1, keepdims=True)
        offsets = np.zeros((len(T), 6))
        offsets[:, 5] = reach
        return Frustums(own @ T[:, :3, :3], offsets + T[:, :3, 3] @ own.T)

    def touch(self, low: np.ndarray, high: np.ndarray) -> np.ndarray:
        """Whether boxes with corners low, high [M, 3] reach into each space, bool [K, M].

        A box that is outside of no single plane counts: a few that only come near are among them, none is missed.
        """
        middle, half = (low + high) / 2, (high - low) / 2
        seen = np.ones((len(self.normals), len(low)), bool)
        step = max(1, _AT_ONCE // max(1, len(low)))
        for begin in range(0, len(seen), step):
            part = slice(begin, begin + step)
            for plane in range(6):
                normals, offsets = self.normals[part, plane], self.offsets[part, plane, None]
                seen[part] &= normals @ middle.T + offsets + np.abs(normals) @ half.T >= 0
        return seen
