# SPDX-License-Identifier: Apache-2.0
"""Records a visit: what the sensor sees along a recording with known poses goes into the cells of a store.

While the sensor is in a cell that is due, what it sees from near the cell's centre is gathered; it is written when the
sensor leaves the cell. A camera that sees one way at a time so fills a cell with all that it saw from there. When a
cell is refreshed, what the camera did not look at this time stays as it was.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import dataclass, field
from functools import partial

import numpy as np

from ggslam.features.orb import FeatureView
from ggslam.localization.places import PLACES, StoredView, stored_places_to_bytes, stored_views
from ggslam.localization.scan_places import (
    SCAN_PLACES,
    ScanPlace,
    load_scan_places,
    place_of,
    scan_places_to_bytes,
)
from ggslam.localization.scans import LaserScan
from ggslam.localization.surface import NORMAL, packed_normals, surface_normals
from ggslam.loops.places import PlaceIndex
from ggslam.native.loader import NativeContext
from ggslam.scene.camera import Camera
from ggslam.scene.frame import Frame
from ggslam.scene.poses import inverse, separation, transform_points
from ggslam.submaps.cell_keys import CellKey
from ggslam.submaps.cell_points import POINTS
from ggslam.submaps.grid import GridStore
from ggslam.submaps.recorder import SubmapRecorder, load_points
from ggslam.submaps.settings import GridAxes
from ggslam.system.tuning import Tuning
from ggslam.tracking.noise import estimate_noise
from ggslam.tracking.points import extract_points
from ggslam.tracking.settings import DepthNoise, PointSettings


class VisitTuning(Tuning):
    """Recording of visits."""

    stride = 4
    """One pixel in this many, along each axis, of a depth image is kept until a cell is written."""
    behind = 0.05
    """Distance behind a surface within which a point belongs to it, as a share of the depth plus the same in metres."""
    max_views = 60
    """Most places of a cell. The newest are kept."""


@dataclass(frozen=True)
class Sight:
    """What one frame or scan adds to a cell.

    Attributes:
        points, normals: [n, 3], world.
        looked_at: tells of world points [m, 3] whether the sensor looked at them: at whatever is there now, or through
            the place where they were.
        view: how a frame looks.
        place: what a scan saw.
    """

    points: np.ndarray
    normals: np.ndarray
    looked_at: Callable[[np.ndarray], np.ndarray]
    view: StoredView | None = None
    place: ScanPlace | None = None


@dataclass
class _Gathered:
    key: CellKey
    T_world_sensor: np.ndarray
    timestamp: float
    sights: list[Sight] = field(default_factory=list)


class FrameSights:
    """Points, normals and places of RGB-D frames.

    Args:
        camera: of the frames.
        context: threads.
        points: how many points are taken from a frame, and how far away.
    """

    apart_m, apart_deg = 0.1, 5.0
    """A frame that has moved and turned less since the last one adds nothing."""

    def __init__(self, camera: Camera, context: NativeContext, points: PointSettings | None = None) -> None:
        self.camera = camera
        self._context = context
        self._settings = points or PointSettings(count=20000)
        self._noise: DepthNoise | None = None
        self._places = PlaceIndex(camera)

    def of(self, item: Frame, T_world_sensor: np.ndarray) -> Sight:
        """What a frame adds."""
        self._noise = self._noise or estimate_noise(item.depth, self.camera)
        found = extract_points(item.depth, self.camera, self._settings, self._noise or DepthNoise(), self._context)
        place = self._places.describe(FeatureView(item.color, item.depth, T_world_sensor))
        normals = found.normals @ T_world_sensor[:3, :3].T
        small = item.depth[::VisitTuning.stride, ::VisitTuning.stride].copy()
        looked_at = partial(_in_view, small, self.camera, inverse(T_world_sensor))
        points = transform_points(found.points, T_world_sensor)
        return Sight(points, normals, looked_at, StoredView(place, T_world_sensor))


class ScanSights:
    """Points of laser scans, with normals estimated from neighbours, and places.

    Args:
        axes: of the store's grid.
    """

    apart_m, apart_deg = 0.3, 30.0
    camera: Camera | None = None

    def __init__(self, axes: GridAxes = "xyz") -> None:
        self._axes: GridAxes = axes

    def of(self, item: LaserScan, T_world_sensor: np.ndarray) -> Sight:
        """What a scan adds."""
        seen = item.points[np.isfinite(item.points).all(1)].astype(np.float64)
        points = transform_points(seen, T_world_sensor)
        normals = surface_normals(points)
        away = ((points - T_world_sensor[:3, 3]) * normals).sum(1) > 0
        normals[away] *= -1
        place = place_of(seen, T_world_sensor, self._axes)
        return Sight(points, normals, lambda others: np.ones(len(others), bool), place=place)


def _in_view(depth: np.ndarray, camera: Camera, T_camera_world: np.ndarray, points: np.ndarray) -> np.ndarray:
    """Whether world points [n, 3] are in view and not behind the surface there, bool [n]. The depth image holds every
    `VisitTuning.stride`-th pixel."""
    x, y, z = transform_points(points.astype(np.float64), T_camera_world).T
    ahead = np.where(z > 0, z, np.inf)
    column = np.rint((x / ahead * camera.fx + camera.cx) / VisitTuning.stride).astype(np.int64)
    row = np.rint((y / ahead * camera.fy + camera.cy) / VisitTuning.stride).astype(np.int64)
    height, width = depth.shape
    inside = (z > 0) & (column >= 0) & (column < width) & (row >= 0) & (row < height)
    there = depth[np.clip(row, 0, height - 1), np.clip(column, 0, width - 1)]
    return inside & (there > 0) & (z <= there * (1 + VisitTuning.behind) + VisitTuning.behind)


class VisitRecorder:
    """Gathers cell by cell and writes; `close` writes the last one.

    Args:
        store: open for writing, its visit begun.
        sights: of the sensor.
    """

    def __init__(self, store: GridStore, sights: FrameSights | ScanSights) -> None:
        self.written: list[CellKey] = []
        self._store, self._sights = store, sights
        self._recorder = SubmapRecorder(store)
        self._gathered: _Gathered | None = None
        self._last: np.ndarray | None = None

    def add(self, item: Frame | LaserScan, T_world_sensor: np.ndarray, timestamp: float) -> None:
        """The next frame or scan; `timestamp` in seconds on the clock of all visits."""
        key = self._recorder.cell_to_record(T_world_sensor[:3, 3], timestamp)
        if self._gathered is not None and key != self._gathered.key:
            self._write()
        if key is None:
            return
        if self._gathered is None:
            self._gathered, self._last = _Gathered(key, T_world_sensor, timestamp), None
        if self._last is not None:
            moved, turned = separation(self._last, T_world_sensor)
            if moved < self._sights.apart_m and turned < self._sights.apart_deg:
                return
        self._last = T_world_sensor
        self._gathered.T_world_sensor, self._gathered.timestamp = T_world_sensor, timestamp
        self._gathered.sights.append(self._sights.of(item, T_world_sensor))  # type: ignore[arg-type]

    def close(self) -> None:
        """Writes what was gathered last."""
        if self._gathered is not None:
            self._write()

    def _write(self) -> None:
        gathered, self._gathered = self._gathered, None
        assert gathered is not None
        points = np.concatenate([sight.points for sight in gathered.sights])
        normals = packed_normals(np.concatenate([sight.normals for sight in gathered.sights]))
        left, left_normals = self._not_looked_at(gathered)
        views = [sight.view for sight in gathered.sights if sight.view is not None]
        camera = self._sights.camera
        parts: dict[str, bytes] = {}
        counts: dict[str, int] = {}
        if views and camera is not None:
            views = [*self._earlier_views(gathered.key, camera), *views][-VisitTuning.max_views:]
            parts, counts = {PLACES: stored_places_to_bytes(views, camera)}, {PLACES: len(views)}
        places = [sight.place for sight in gathered.sights if sight.place is not None]
        if places:
            earlier = load_scan_places(self._store, gathered.key) if self._has(gathered.key, SCAN_PLACES) else []
            places = [*earlier, *places][-VisitTuning.max_views:]
            parts[SCAN_PLACES], counts[SCAN_PLACES] = scan_places_to_bytes(places), len(places)
        # The cell's time is that of the last sight: T counts from then on.
        key = self._recorder.record(
            gathered.T_world_sensor, np.concatenate([points, left]), gathered.timestamp,
            {NORMAL: np.concatenate([normals, left_normals])}, parts, counts,
        )  # fmt: skip
        if key is not None:
            self.written.append(key)

    def _not_looked_at(self, gathered: _Gathered) -> tuple[np.ndarray, np.ndarray]:
        """Points and packed normals of the cell as it is that no sight of this visit looked at."""
        arrays = {}
        if self._has(gathered.key, POINTS):
            arrays = load_points(self._store, gathered.key)
        if NORMAL not in arrays:  # of another kind, or nothing
            return np.zeros((0, 3)), np.zeros((0, 3), np.int8)
        left = np.ones(len(arrays["points"]), bool)
        for sight in gathered.sights:
            left &= ~sight.looked_at(arrays["points"])
        return arrays["points"][left], arrays[NORMAL][left]

    def _earlier_views(self, key: CellKey, camera: Camera) -> list[StoredView]:
        return stored_views(self._store, key, camera) if self._has(key, PLACES) else []

    def _has(self, key: CellKey, part: str) -> bool:
        return key in self._store and part in self._store.cell(key).parts


def record_visit(
    store: GridStore,
    items: Iterable[Frame | LaserScan],
    poses: np.ndarray,
    sights: FrameSights | ScanSights,
    visit: str,
    at: float | None = None,
) -> list[CellKey]:
    """Records a visit.

    Args:
        store: open for writing.
        items: frames or scans in order; those without a pose are passed over.
        poses: T_world_sensor of each by `index`, float64 [n, 4, 4], NaN where unknown.
        sights: of the sensor.
        visit: its name.
        at: time of the first item in seconds, if the recording's own clock is not that of the other visits.

    Returns:
        The cells that were written.
    """
    store.begin_visit(visit)
    recorder = VisitRecorder(store, sights)
    shift: float | None = None
    for item in items:
        if shift is None:
            shift = 0.0 if at is None else at - item.timestamp
        T = poses[item.index]
        if np.isfinite(T).all():
            recorder.add(item, T, item.timestamp + shift)
    recorder.close()
    return recorder.written
