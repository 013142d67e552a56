# SPDX-License-Identifier: Apache-2.0
"""Occupancy of space on OctoMap's key grid, updated at the sensor's rate.

The points of a scan are quantised on the map's own grid; one ray runs to the centre of each occupied voxel (voxel
traversal of Amanatides and Woo, 1987, in OctoMap's arithmetic). As in OctoMap's insertPointCloud a voxel is updated
once per scan: a hit where a point lies in it, else a miss where a ray passes. Rays set bits in blocks of 8^3 voxels,
and one pass over the blocks applies them. What has one value throughout is a single leaf of an octree.
"""

from __future__ import annotations

import ctypes
import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import Final, Literal

import numpy as np

from ggslam.abi import core as volumes
from ggslam.abi.core import DepthImage, InsertResult, InsertSettings
from ggslam.errors import ConfigError, InputError
from ggslam.native.loader import NativeContext, load_library
from ggslam.scene.camera import Camera
from ggslam.scene.origin import local_origin, moved_pose
from ggslam.volumes.occupancy_arrays import LEAF, contiguous_points, output_bytes
from ggslam.volumes.occupancy_settings import OccupancySettings, log_odds
from ggslam.volumes.quantization import KEY_OFFSET, check_resolution

UNKNOWN: Final = -1
"""Value of a place that was not seen; the compiled core gives it."""
FREE: Final = 0
"""Value of a free place."""
OCCUPIED: Final = 1
"""Value of an occupied place."""
_WHICH = {"all": 0, "occupied": 1, "free": 2}


@dataclass(frozen=True)
class ScanCounts:
    """What one insertion did.

    Attributes:
        rays: rays walked.
        free: voxels passed and not hit.
        occupied: voxels hit.
    """

    rays: int
    free: int
    occupied: int


@dataclass(frozen=True)
class OccupancySummary:
    """Size of a map.

    Attributes:
        occupied, free: voxels of the finest level.
        blocks: blocks of 8^3 voxels that are stored voxel by voxel.
        nodes: inner nodes above them.
        memory_bytes: taken by blocks and nodes.
        known_box, occupied_box: float64 [2, 3], lower and upper corner around all known and all occupied voxels in
            metres; None where there are none.
    """

    occupied: int
    free: int
    blocks: int
    nodes: int
    memory_bytes: int
    known_box: np.ndarray | None
    occupied_box: np.ndarray | None


@dataclass(frozen=True)
class OccupancyLeaves:
    """Leaves of the map, pruned as OctoMap's: eight equal neighbours are one.

    Attributes:
        centers: float32 [N, 3], metres; float64 if the map's origin is not the world's.
        sizes: float32 [N], edges in metres.
        log_odds: float32 [N].
    """

    centers: np.ndarray
    sizes: np.ndarray
    log_odds: np.ndarray


class OccupancyMap:
    """Log-odds of occupancy, unknown where no ray passed. One caller at a time.

    Args:
        resolution: edge of a voxel, metres. The grid spans 65536 voxels along each axis, around the map's origin.
        settings: how a scan changes the map.
        context: threads to work on; None: a context of its own.
        origin: of the grid in the world, [3] metres; None: the world's, unless the first scan is far from that
            (`scene.origin`).

    Raises:
        ConfigError: impossible resolution.
    """

    def __init__(
        self, resolution: float, settings: OccupancySettings | None = None, context: NativeContext | None = None,
        origin: np.ndarray | None = None,
    ) -> None:  # fmt: skip
        check_resolution(resolution)
        self._handle: int | None = None
        self.origin = np.zeros(3) if origin is None else np.array(origin, np.float64)
        self._has_origin = origin is not None
        self.resolution = float(resolution)
        self.settings = settings or OccupancySettings()
        self.context = context or NativeContext()
        self._library = load_library()
        self._handle = self._library.ggslam_occupancy_create(self.resolution)

    def __del__(self) -> None:
        if getattr(self, "_handle", None) is not None:
            self._library.ggslam_occupancy_destroy(self._handle)

    @property
    def handle(self) -> int:
        """Pointer for the core."""
        assert self._handle is not None
        return self._handle

    def insert(self, points: np.ndarray, origin: np.ndarray, max_range: float | None = None) -> ScanCounts:
        """Inserts one scan.

        Args:
            points: [N, 3] in the world, metres. Those not finite or outside the grid are left out.
            origin: [3], where the sensor stands in the world.
            max_range: metres; rays to farther points end there, without a hit.

        Raises:
            InputError: points of another shape.
            ConfigError: the origin lies outside the grid.
        """
        self._place(origin)
        points = self._local(points)
        core = self._library.ggslam_occupancy_insert
        return self._insert(
            lambda settings, result: core(
                self.context.handle, self.handle, points.ctypes.data, len(points), settings, result
            ),
            origin,
            max_range,
        )

    def insert_depth(
        self,
        depth: np.ndarray,
        camera: Camera,
        T_world_camera: np.ndarray,
        max_range: float | None = None,
        min_depth: float = 0.1,
        max_depth: float = 1000.0,
        free_depth: float | None = None,
    ) -> ScanCounts:
        """Inserts one depth image.

        Args:
            depth: [H, W], metres along the optical axis; 0: none; +inf: the sensor found nothing (REP 117).
            T_world_camera: float64 [4, 4].
            max_range: metres from the camera; rays to farther points end there, without a hit.
            min_depth, max_depth: pixels outside are left out, metres: they free nothing, either. Where all that is
                measured is to free space, `max_range` is the limit.
            free_depth: pixels of +inf free space up to this depth along the optical axis; None: up to `max_range`, and
                nothing if that is None, too.

        Raises:
            InputError: the image is not of the camera's size.
            ConfigError: the camera stands outside the grid.
        """
        depth = np.ascontiguousarray(depth, np.float32)
        if depth.shape != (camera.height, camera.width):
            raise InputError(f"depth: expected shape {[camera.height, camera.width]}, found {list(depth.shape)}")
        self._place(np.asarray(T_world_camera, np.float64)[:3, 3])
        T = moved_pose(T_world_camera, -self.origin)
        image = DepthImage(
            depth.ctypes.data, camera.width, camera.height, camera.fx, camera.fy, camera.cx, camera.cy,
            max(min_depth, 1e-6), max_depth, _free_depth(max_range, free_depth),
            (ctypes.c_float * 12)(*T[:3].ravel()),
        )  # fmt: skip
        core = self._library.ggslam_occupancy_insert_depth
        return self._insert(
            lambda settings, result: core(self.context.handle, self.handle, ctypes.byref(image), settings, result),
            np.asarray(T_world_camera, np.float64)[:3, 3],
            max_range,
        )

    def states(self, points: np.ndarray) -> np.ndarray:
        """Whether points [N, 3] are `UNKNOWN`, `FREE` or `OCCUPIED`, int8 [N]. Outside the grid all is unknown."""
        points = self._local(points)
        states = np.empty(len(points), np.int8)
        self._look_up(points, states.ctypes.data, None)
        return states

    def log_odds(self, points: np.ndarray) -> np.ndarray:
        """Log-odds at points [N, 3], float32 [N]; not a number where unknown."""
        points = self._local(points)
        values = np.empty(len(points), np.float32)
        self._look_up(points, None, values.ctypes.data)
        return values

    def leaves(self, which: Literal["all", "occupied", "free"] = "all") -> OccupancyLeaves:
        """The map's leaves, or the occupied or free ones alone."""
        size = self._library.ggslam_occupancy_leaves(self.handle, self.settings.threshold, _WHICH[which])
        rows = np.frombuffer(output_bytes(self.handle, size), LEAF)
        centers = rows["centre"] + self.origin if self.origin.any() else rows["centre"].copy()
        return OccupancyLeaves(centers, rows["size"].copy(), rows["log_odds"].copy())

    def occupied_centers(self) -> tuple[np.ndarray, np.ndarray]:
        """Centres (see `OccupancyLeaves`) [N, 3] and edges float32 [N] of the occupied leaves, metres."""
        leaves = self.leaves("occupied")
        return leaves.centers, leaves.sizes

    def summary(self) -> OccupancySummary:
        """Counts, memory and extent."""
        found = volumes.OccupancySummary()
        self._library.ggslam_occupancy_summary(self.handle, self.settings.threshold, ctypes.byref(found))
        return OccupancySummary(
            int(found.occupied), int(found.free), int(found.blocks), int(found.nodes), int(found.bytes),
            self._box(found.known_low, found.known_high), self._box(found.occupied_low, found.occupied_high),
        )  # fmt: skip

    def native_settings(self, origin: np.ndarray, max_range: float | None) -> InsertSettings:
        """The settings of one insertion, for the core.

        Raises:
            ConfigError: a range that is not positive.
        """
        if max_range is not None and not max_range > 0:
            raise ConfigError(f"max_range: expected a positive number of metres, found {max_range}")
        s = self.settings
        limits = (s.probability_hit, s.probability_miss, s.probability_minimum, s.probability_maximum)
        where = (ctypes.c_float * 3)(*(np.asarray(origin, np.float64).reshape(3) - self.origin).astype(np.float32))
        return InsertSettings(
            -1.0 if max_range is None else max_range, where, *map(log_odds, limits), int(s.quantize), int(s.last_voxel),
            s.most_hits,
        )  # fmt: skip

    def _insert(
        self, insert: Callable[[object, object], int], origin: np.ndarray, max_range: float | None
    ) -> ScanCounts:
        settings, result = self.native_settings(origin, max_range), InsertResult()
        if not insert(ctypes.byref(settings), ctypes.byref(result)):
            raise self.origin_error(origin)
        return ScanCounts(int(result.rays), int(result.free), int(result.occupied))

    def origin_error(self, origin: np.ndarray) -> ConfigError:
        """The error of a sensor outside the grid."""
        reach = self.resolution * KEY_OFFSET
        place = f"({', '.join(f'{v:g}' for v in self.origin)})" if self.origin.any() else "the world's origin"
        return ConfigError(f"origin: expected within {reach:g} m of {place}, found {np.asarray(origin)}")

    def _place(self, position: np.ndarray) -> None:
        """The first scan's sensor, at [3], decides the origin."""
        position = np.asarray(position, np.float64).reshape(-1)
        if not self._has_origin and np.isfinite(position).all():
            self.origin, self._has_origin = local_origin(position), True

    def _local(self, points: np.ndarray) -> np.ndarray:
        """World points [N, 3] as the core takes them."""
        return contiguous_points(np.asarray(points, np.float64) - self.origin if self.origin.any() else points)

    def _look_up(self, points: np.ndarray, states: int | None, values: int | None) -> None:
        self._library.ggslam_occupancy_look_up(
            self.context.handle, self.handle, points.ctypes.data, len(points), self.settings.threshold, states, values
        )

    def _box(self, low: ctypes.Array, high: ctypes.Array) -> np.ndarray | None:
        if low[0] > high[0]:
            return None
        box = (np.array([low[:], [h + 1 for h in high]], np.float64) - KEY_OFFSET) * self.resolution
        return box + self.origin


def _free_depth(max_range: float | None, free_depth: float | None) -> float:
    """Depth that pixels of +inf free space up to; 0: they are left out.

    Raises:
        ConfigError: one that is not positive.
    """
    if free_depth is None:
        return 0.0 if max_range is None else max_range
    if not 0 < free_depth < math.inf:
        raise ConfigError(f"free_depth: expected a positive number of metres, found {free_depth}")
    return free_depth
