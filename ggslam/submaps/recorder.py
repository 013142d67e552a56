# SPDX-License-Identifier: Apache-2.0
"""Fills a grid store: cell by cell along a recording, or from a whole cloud that was made elsewhere."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from ggslam.submaps.cell_keys import CellKey, partition
from ggslam.submaps.cell_points import (
    POINTS,
    CellArrays,
    changed_share,
    decode_points,
    encode_points,
    select,
    thin,
)
from ggslam.submaps.cell_records import CellWrite
from ggslam.submaps.grid import GridStore, check_same_grid
from ggslam.submaps.settings import SubmapSettings
from ggslam.system.tuning import Tuning


class RecorderTuning(Tuning):
    """Writing of whole clouds."""

    cells_at_once = 64
    """Cells of a whole cloud that are written together."""


class SubmapRecorder:
    """Records the surroundings of the sensor into the cell it is in.

    A cell's sub-map is what the sensor saw from near the cell's centre, up to the sensor's range: it reaches beyond the
    cell, and the sub-maps of neighbours overlap.

    Args:
        store: open for writing.
        settings: None: the store's. They decide R, T, range and thinning.

    Raises:
        ConfigError: `settings` have another grid than the store.
    """

    def __init__(self, store: GridStore, settings: SubmapSettings | None = None) -> None:
        self.store = store
        self.settings = settings or store.settings
        check_same_grid(store.path, store.settings, self.settings)

    def cell_to_record(self, position: np.ndarray, timestamp: float) -> CellKey | None:
        """The cell that `record` would write with the sensor at a position [3] (metres, world), or None.

        It is the one the sensor is in, if its centre is within R and it was not recorded in the last T seconds.
        """
        key = self.store.key_of(position)
        distance = self.store.grid.distances(np.array([key]), np.asarray(position, np.float64))[0]
        near = distance <= self.settings.radius
        return key if near and self.store.due(key, timestamp, self.settings.refresh) else None

    def record(
        self,
        T_world_sensor: np.ndarray,
        points_world: np.ndarray,
        timestamp: float,
        attributes: Mapping[str, np.ndarray] | None = None,
        parts: Mapping[str, bytes] | None = None,
        counts: Mapping[str, int] | None = None,
    ) -> CellKey | None:
        """Writes the sub-map of the sensor's cell if `cell_to_record` says so; returns the cell, or None.

        Args:
            T_world_sensor: pose of the sensor, float64 [4, 4].
            points_world: points around it, [N, 3] metres, world; those that are not finite are left out.
            timestamp: seconds, on one clock for all visits (Unix time).
            attributes: by name, [N] or [N, k].
            parts: further parts of the cell by file name, and `counts` of what is in them.
        """
        position = np.asarray(T_world_sensor, np.float64)[:3, 3]
        key = self.cell_to_record(position, timestamp)
        if key is None:
            return None
        arrays = {"points": points_world, **(attributes or {})}
        within = np.linalg.norm(points_world - position, axis=1) <= self.settings.sensor_range  # NaN is not
        arrays = thin(select(arrays, within), self.settings.voxel, self.settings.ratio)
        changed = self._changed_share(key, arrays["points"], position)
        self.store.put(
            key,
            {POINTS: encode_points(arrays), **(parts or {})},
            timestamp,
            {POINTS: len(arrays["points"]), **(counts or {})},
            changed,
        )
        return key

    def _changed_share(self, key: CellKey, points: np.ndarray, position: np.ndarray) -> float | None:
        """Share that differs from the last recording, where both sensors, within R of the centre, could see."""
        if key not in self.store or POINTS not in self.store.cell(key).parts:
            return None
        centre = np.where(self.store.grid.spans, self.store.centre_of(key), position)
        reach = max(self.settings.sensor_range - self.settings.radius, 0.0)
        old = load_points(self.store, key)["points"]
        return changed_share(old, points, self.settings.change_distance, centre, reach)


def load_points(store: GridStore, key: CellKey) -> dict[str, np.ndarray]:
    """Points and attributes of a cell.

    Raises:
        KeyError: there is no such cell, or it has no points.
        FormatError: the file is damaged; names it and the reason.
    """
    return decode_points(store.get(key, POINTS), f"{store.path}: cell {key}: {POINTS}")


def store_cloud(
    store: GridStore,
    points: np.ndarray,
    attributes: Mapping[str, np.ndarray] | None = None,
    recorded_at: float = 0.0,
) -> list[CellKey]:
    """Cuts a whole cloud into cells, each point into the one it lies in, and writes them, thinned as the store says.

    Args:
        store: open for writing; cells that are there get the new points.
        points: [N, 3] metres, world; those that are not finite are left out.
        attributes: by name, [N] or [N, k].
        recorded_at: seconds, on the clock of the recordings.

    Returns:
        The cells written.
    """
    arrays: CellArrays = {"points": points, **(attributes or {})}
    finite = np.isfinite(points).all(1)
    if not finite.all():
        arrays = select(arrays, finite)
    keys: list[CellKey] = []
    waiting: list[CellWrite] = []
    for key, indices in partition(arrays["points"], store.grid):
        cell = thin(select(arrays, indices), store.settings.voxel, store.settings.ratio)
        changed = None
        if key in store and POINTS in store.cell(key).parts:
            changed = changed_share(load_points(store, key)["points"], cell["points"], store.settings.change_distance)
        waiting.append(
            CellWrite(key, {POINTS: encode_points(cell)}, recorded_at, {POINTS: len(cell["points"])}, changed)
        )
        keys.append(key)
        if len(waiting) == RecorderTuning.cells_at_once:
            store.put_cells(waiting)
            waiting = []
    store.put_cells(waiting)
    return keys
