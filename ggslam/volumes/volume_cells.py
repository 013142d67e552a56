# SPDX-License-Identifier: Apache-2.0
"""Cells of volumes: cubes of whole blocks of a TSDF, which go to disk and come back together."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.ndimage import binary_dilation

from ggslam.geometry.frustums import Frustums
from ggslam.scene.camera import Camera
from ggslam.scene.origin import moved_pose
from ggslam.scene.poses import inverse
from ggslam.system.tuning import Tuning
from ggslam.volumes.posed_view import PosedView
from ggslam.volumes.settings import TsdfSettings
from ggslam.volumes.tsdf import SIDE

CellKey = tuple[int, int, int]


class VolumeCellTuning(Tuning):
    """Size of cells."""

    edge_m = 1.0
    """Edge in metres, rounded to whole blocks."""


@dataclass(frozen=True)
class VolumeCells:
    """A grid of cells.

    Attributes:
        blocks: along an edge of a cell.
        block: edge of a block in metres.
        reach: metres beyond which a view changes nothing.
        truncation: metres.
    """

    blocks: int
    block: float
    reach: float
    truncation: float

    @staticmethod
    def of(settings: TsdfSettings) -> VolumeCells:
        """The cells of a TSDF."""
        block = SIDE * settings.voxel
        blocks = max(1, round(VolumeCellTuning.edge_m / block))
        return VolumeCells(blocks, block, settings.most_depth + settings.truncation, settings.truncation)

    @property
    def edge(self) -> float:
        """Of a cell, metres."""
        return self.blocks * self.block

    def keys_of(self, coordinates: np.ndarray) -> np.ndarray:
        """Cells [n, 3] that blocks at coordinates [n, 3] belong to."""
        return np.floor_divide(coordinates, self.blocks)

    def block_range(self, low: np.ndarray, high: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Least and greatest coordinates [3] of the blocks of the cells from `low` to `high` [3]."""
        return low * self.blocks, (high + 1) * self.blocks - 1

    def in_view(self, view: PosedView, origin: np.ndarray) -> np.ndarray:
        """The cells that fusing a view may look at or change, int64 [n, 3]; a few more, never less.

        Args:
            view: to be fused.
            origin: that the TSDF counts its blocks from, [3] metres.
        """
        deepest = float(np.max(view.depth, initial=0.0, where=view.depth > 0))
        return self.in_frustum(view.camera, view.T_world_camera, min(deepest + self.truncation, self.reach), origin)

    def in_frustum(self, camera: Camera, T_world_camera: np.ndarray, reach: float, origin: np.ndarray) -> np.ndarray:
        """The cells [n, 3] that a camera sees to a depth of `reach` metres."""
        T = moved_pose(T_world_camera, -origin)
        u, v = np.array([-0.5, camera.width - 0.5]), np.array([-0.5, camera.height - 0.5])
        x, y = np.meshgrid((u - camera.cx) / camera.fx, (v - camera.cy) / camera.fy)
        corners = reach * np.stack([x.ravel(), y.ravel(), np.ones(4)], 1) @ T[:3, :3].T + T[:3, 3]
        ends = np.concatenate([corners, T[None, :3, 3]])
        low, high = (np.floor(end / self.edge).astype(np.int64) for end in (ends.min(0), ends.max(0)))
        keys = np.stack(np.meshgrid(*(np.arange(a, b + 1) for a, b in zip(low, high, strict=True)), indexing="ij"), -1)
        keys = keys.reshape(-1, 3)
        touched = Frustums.of(camera, inverse(T)[None], [reach]).touch(keys * self.edge, (keys + 1) * self.edge)[0]
        return keys[touched]


def as_keys(cells: np.ndarray) -> set[CellKey]:
    """Rows [n, 3] as keys."""
    return {(x, y, z) for x, y, z in cells.tolist()}


def with_neighbours(keys: set[CellKey], around: int) -> set[CellKey]:
    """The cells, and those that are at most so many steps away along each axis."""
    if not around or not keys:
        return keys
    at = np.array(list(keys))
    low = at.min(0) - around
    found = np.zeros(at.max(0) - low + around + 1, bool)
    found[tuple((at - low).T)] = True
    return as_keys(np.argwhere(binary_dilation(found, np.ones((2 * around + 1,) * 3))) + low)
