# SPDX-License-Identifier: Apache-2.0
"""Tests which boxes cameras may see. What they see must be in memory before a view is rendered."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise

import numpy as np

from ggslam.scene.camera import Camera
from ggslam.system.tuning import Tuning


class FrustumTuning(Tuning):
    """Test of boxes against views."""

    pairs_at_once = 1 << 18
    """Pairs of a camera and a box tested in one batch."""
    tile_pairs_at_once = 1 << 13
    """Pairs of a tile and a box tested in one batch."""


@dataclass(frozen=True)
class Frustums:
    """The visible spaces of K cameras: a point x is in one if normals @ x + offsets >= 0 for all six planes.

    Attributes:
        normals: float64 [K, 6, 3], unit, inwards.
        offsets: float64 [K, 6], metres.
        tiles: of each camera, [K, tiles, 6, 3] and [K, tiles, 6]: the same for parts of its image, each as deep as it
            sees there; None: each camera sees as deep everywhere.
    """

    normals: np.ndarray
    offsets: np.ndarray
    tiles: tuple[np.ndarray, np.ndarray] | None = None

    @staticmethod
    def of(camera: Camera, T_camera_world: np.ndarray, reach: Sequence[float] | np.ndarray) -> Frustums:
        """The frustums between the camera and depth `reach` (metres) of cameras at `T_camera_world` [K, 4, 4].

        Args:
            reach: [K], or [K, rows, columns]: of equal parts of the image; what lies deeper there is hidden.
        """
        T, reach = np.asarray(T_camera_world, np.float64).reshape(-1, 4, 4), np.asarray(reach, np.float64)
        whole = _planes(camera, T, reach.reshape(len(T), -1).max(1, keepdims=True), 1, 1)
        tiles = _planes(camera, T, reach.reshape(len(T), -1), *reach.shape[1:]) if reach.ndim == 3 else None
        return Frustums(whole[0][:, 0], whole[1][:, 0], tiles)

    def touch(self, low: np.ndarray, high: np.ndarray) -> np.ndarray:
        """Whether boxes with corners low, high [M, 3] reach into each space, bool [K, M].

        A box that is outside of no single plane counts: a few that only come near are among them, none is missed.
        """
        middle, half = (low + high) / 2, (high - low) / 2
        seen = np.ones((len(self.normals), len(low)), bool)
        step = max(1, FrustumTuning.pairs_at_once // max(1, len(low)))
        for begin in range(0, len(seen), step):
            part = slice(begin, begin + step)
            for plane in range(6):
                normals, offsets = self.normals[part, plane], self.offsets[part, plane, None]
                seen[part] &= normals @ middle.T + offsets + np.abs(normals) @ half.T >= 0
        if self.tiles is not None:
            self._look_closer(self.tiles, middle, half, seen)
        return seen

    @staticmethod
    def _look_closer(
        tiles: tuple[np.ndarray, np.ndarray], middle: np.ndarray, half: np.ndarray, seen: np.ndarray
    ) -> None:
        """Of the boxes that whole views reach those stay in `seen` that one of their tiles does."""
        cameras, boxes = np.nonzero(seen)
        step = max(1, FrustumTuning.tile_pairs_at_once // tiles[0].shape[1])
        for begin in range(0, len(cameras), step):
            k, m = cameras[begin : begin + step], boxes[begin : begin + step]
            normals = tiles[0][k]
            inside = np.einsum("ptqx,px->ptq", normals, middle[m]) + tiles[1][k]
            inside += np.einsum("ptqx,px->ptq", np.abs(normals), half[m])
            seen[k, m] = (inside >= 0).all(2).any(1)


def _planes(camera: Camera, T: np.ndarray, reach: np.ndarray, rows: int, columns: int) -> tuple[np.ndarray, np.ndarray]:
    """Planes [K, rows * columns, 6, 3] and offsets [K, rows * columns, 6] of equal parts of images at `T` [K, 4, 4]
    with `reach` [K, rows * columns]."""
    x = (np.linspace(0, camera.width, columns + 1) - 0.5 - camera.cx) / camera.fx
    y = (np.linspace(0, camera.height, rows + 1) - 0.5 - camera.cy) / camera.fy
    own = np.array([
        [[1, 0, -left], [-1, 0, right], [0, 1, -top], [0, -1, bottom], [0, 0, 1], [0, 0, -1]]
        for top, bottom in pairwise(y) for left, right in pairwise(x)
    ])  # fmt: skip
    own /= np.linalg.norm(own, axis=2, keepdims=True)
    offsets = np.einsum("tqx,kx->ktq", own, T[:, :3, 3])
    offsets[..., 5] += reach
    return np.einsum("tqx,kxy->ktqy", own, T[:, :3, :3]), offsets


def depth_reach(depth: np.ndarray, rows: int, columns: int, unmeasured: float = 0.1) -> np.ndarray:
    """How deep each of rows x columns equal parts of a depth image [H, W] (metres, 0: none) sees, float64
    [rows, columns].

    Where more than a share `unmeasured` of a part has no depth, it is taken to be as deep as the deepest part.
    """
    height, width = depth.shape
    deepest = np.zeros((rows, columns))
    for row, column in np.ndindex(rows, columns):
        top, bottom = row * height // rows, -(-(row + 1) * height // rows)
        left, right = column * width // columns, -(-(column + 1) * width // columns)
        part = depth[top:bottom, left:right]
        known = (part > 0).mean() >= 1 - unmeasured
        deepest[row, column] = part.max() if known else np.inf
    return np.minimum(deepest, float(depth.max(initial=0.0)))
