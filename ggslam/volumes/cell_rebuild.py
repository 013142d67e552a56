# SPDX-License-Identifier: Apache-2.0
"""Cells of a TSDF that are to be fused again from keyframes, after a loop correction moved these: each when it is
needed, so that a correction costs what is around the camera and not what the whole way does."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np

from ggslam.geometry.frustums import Frustums
from ggslam.scene.camera import Camera
from ggslam.scene.origin import moved_pose
from ggslam.scene.poses import inverse
from ggslam.system.tuning import Tuning
from ggslam.volumes.block_arrays import decay_blocks, put_blocks, take_blocks
from ggslam.volumes.posed_view import PosedView
from ggslam.volumes.tsdf import TsdfMap
from ggslam.volumes.volume_cells import CellKey, VolumeCells, as_keys


class CellRebuildTuning(Tuning):
    """How many cells are fused at a time."""

    margin = 1
    """Cells around those that are needed that are fused with them: the camera goes on."""
    side = 6
    """Cells along an edge of the box that is fused at a time when all are."""


@dataclass(frozen=True)
class StoredView:
    """A view that is read when it is needed.

    Attributes:
        camera: of its images.
        T_world_camera: float64 [4, 4].
        reach: its largest depth, metres; infinite if that is not known.
        read: gives the view.
    """

    camera: Camera
    T_world_camera: np.ndarray
    reach: float
    read: Callable[[], PosedView]


class CellRebuild:
    """Which cells are not fused yet.

    Args:
        views: all that there are, in order.
        cells: the grid.
        origin: of the TSDF.
    """

    def __init__(self, views: Sequence[StoredView], cells: VolumeCells, origin: np.ndarray) -> None:
        self._views, self._cells, self._origin = list(views), cells, origin
        self._built: set[CellKey] = set()
        self._seen: dict[CellKey, bool] = {}
        """Whether some view sees a cell, of those that were asked for."""
        self._frustums: list[tuple[np.ndarray, Frustums]] = []
        cameras = {view.camera: view.camera for view in self._views}
        for camera in cameras.values():
            rows = np.array([k for k, view in enumerate(self._views) if view.camera == camera])
            T = inverse(moved_pose(np.stack([self._views[k].T_world_camera for k in rows]), -origin))
            self._frustums.append((rows, Frustums.of(camera, T, [self._reach(self._views[k]) for k in rows])))

    def _reach(self, view: StoredView) -> float:
        return min(view.reach + self._cells.truncation, self._cells.reach)

    def build(self, keys: set[CellKey], tsdf: TsdfMap, decays: int) -> None:
        """Fuses those of the cells that are not yet, and those around them.

        Args:
            keys: of the cells.
            tsdf: to put them into.
            decays: times that its weights have decayed since the views were given.
        """
        missing = np.array(sorted(keys - self._built)).reshape(-1, 3)
        if len(missing):
            margin = CellRebuildTuning.margin
            self._build_box(missing.min(0) - margin, missing.max(0) + margin, tsdf, decays)

    def build_all(self, tsdf: TsdfMap, decays: int, after: Callable[[], None]) -> None:
        """Fuses all cells that are not yet; calls `after` each time that some are."""
        seen: set[CellKey] = set()
        for view in self._views:
            seen |= as_keys(self._cells.in_frustum(view.camera, view.T_world_camera, self._reach(view), self._origin))
        side = CellRebuildTuning.side
        missing = np.array(sorted(seen - self._built)).reshape(-1, 3)
        for box in np.unique(np.floor_divide(missing, side), axis=0):
            self._build_box(side * box, side * box + side - 1, tsdf, decays)
            after()

    def _build_box(self, low: np.ndarray, high: np.ndarray, tsdf: TsdfMap, decays: int) -> None:
        """Fuses the cells from `low` to `high` [3] that are not yet, of the views that see some of them."""
        box = np.stack(np.meshgrid(*(np.arange(a, b + 1) for a, b in zip(low, high, strict=True))), -1).reshape(-1, 3)
        todo = as_keys(box) - self._built
        corners = np.array(sorted(todo)).reshape(-1, 3)
        alone = TsdfMap(tsdf.settings, tsdf.context, self._origin, tsdf.points)
        within = self._cells.block_range(low, high)
        for row in self._views_of(corners):
            view = self._views[row].read()
            alone.integrate(
                view.depth, view.camera, self._views[row].T_world_camera, view.color, view.labels, within=within
            )
        blocks = alone.blocks()
        own = [key in todo for key in map(tuple, self._cells.keys_of(blocks.coordinates).tolist())]
        put_blocks(tsdf, decay_blocks(take_blocks(alone, blocks, np.flatnonzero(own)), tsdf, decays))
        self._built |= todo

    def still_to_fuse(self, keys: set[CellKey]) -> set[CellKey]:
        """Those of the cells that some view sees and that are not fused yet."""
        new = np.array(sorted(keys - self._built - self._seen.keys())).reshape(-1, 3)
        seen = np.zeros(len(new), bool)
        for _, frustums in self._frustums:
            seen |= frustums.touch(new * self._cells.edge, (new + 1) * self._cells.edge).any(0)
        self._seen.update(zip(map(tuple, new.tolist()), seen.tolist(), strict=True))
        return {key for key in keys - self._built if self._seen[key]}

    def _views_of(self, keys: np.ndarray) -> list[int]:
        """Numbers of the views that see some of the cells [n, 3], in order."""
        low, high, found = keys * self._cells.edge, (keys + 1) * self._cells.edge, []
        for rows, frustums in self._frustums:
            found += rows[frustums.touch(low, high).any(1)].tolist()
        return sorted(found)
