# SPDX-License-Identifier: Apache-2.0
"""The signed Euclidean distance to the nearest obstacle and its gradient, for planners.

The TSDF of `ggslam.volumes.tsdf` measures along the camera's axis and only near surfaces; what it has exactly is where
surfaces are. The field takes its zero crossings as surface points with normals, and what is too thin for its voxels
from the points that were measured in them. Around each it takes a disc for the surface, which ends where it would
stand out over an edge; the field is the distance to the nearest of all discs, in every voxel that was seen. An update
computes the voxels whose nearest disc changed, and its result is the same as that of computing everything anew from the
surface points held, also after an obstacle has gone.

Unknown voxels, those that no frame has seen, have no distance. The field does not tell how far they are either: a
distance in known space is that to the nearest *seen* surface, and a planner that may not enter unknown space must check
`known` along its path, too.
"""

from __future__ import annotations

import ctypes
from dataclasses import dataclass
from typing import Final

import numpy as np

from ggslam.abi.core import FieldStats
from ggslam.errors import ConfigError, InputError
from ggslam.native.loader import load_library
from ggslam.system.settings import setting, settings_class
from ggslam.volumes.tsdf import VOXELS, TsdfMap

_MOST_VOXELS: Final = 2000
"""Largest distance in voxels that the compiled core can count."""


@settings_class(frozen=True)
class FieldSettings:
    """The Euclidean distance field."""

    max_distance: float = setting(2.0, 1e-3, 100, "m")
    """Largest distance computed; farther voxels have this distance and no gradient."""


@dataclass(frozen=True)
class UpdateStats:
    """What an update did.

    Attributes:
        revision: of the TSDF that the field now stands for.
        changed_blocks: blocks of the TSDF that changed since the last update, those that went counted.
        changed_sites: surface points that came, went or moved.
        recomputed_blocks: blocks of the field in which something was computed.
        blocks: blocks of the field.
        computed_voxels: voxels that were.
        stale_blocks: blocks that there was no time for.
        sites_ms, select_ms, transform_ms: time spent finding surface points, finding out what to compute, computing.
    """

    revision: int
    changed_blocks: int
    changed_sites: int
    recomputed_blocks: int
    blocks: int
    computed_voxels: int
    stale_blocks: int
    sites_ms: float
    select_ms: float
    transform_ms: float

    @property
    def milliseconds(self) -> float:
        """Of the whole update."""
        return self.sites_ms + self.select_ms + self.transform_ms


@dataclass(frozen=True)
class FieldValues:
    """Answers of `DistanceField.query`.

    Attributes:
        distance: float32 [N], metres to the nearest surface, negative behind it; NaN where not known.
        gradient: float32 [N, 3], unit vectors in which the distance grows; zero where not known, and where the nearest
            surface is beyond the largest distance.
        known: bool [N], whether the voxel that the point is in was seen.
        stale: bool [N], whether it, or a voxel around that it is interpolated from, is known as it was before the last
            update, which had no time for it.
    """

    distance: np.ndarray
    gradient: np.ndarray
    known: np.ndarray
    stale: np.ndarray


@dataclass(frozen=True)
class SurfaceDiscs:
    """What distances are measured from: discs that together are the surface.

    Attributes:
        points: their middles [S, 3], metres; float32, or float64 if the origin is not the world's.
        normals: float32 [S, 3], unit vectors to the side in front; zero where something is thinner than a voxel.
        radii: float32 [S], metres.
    """

    points: np.ndarray
    normals: np.ndarray
    radii: np.ndarray


class DistanceField:
    """The field of a map; its memory belongs to the compiled core. It is empty until the first `update`.

    Args:
        tsdf: the map, which the field reads at every update.
        settings: how far distances are computed.

    Raises:
        ConfigError: `max_distance` is more than 2000 voxels.
    """

    def __init__(self, tsdf: TsdfMap, settings: FieldSettings | None = None) -> None:
        self.tsdf = tsdf
        self.settings = settings or FieldSettings()
        most = _MOST_VOXELS * tsdf.settings.voxel
        if self.settings.max_distance > most:
            raise ConfigError(
                f"FieldSettings.max_distance: expected at most {most:g} ({_MOST_VOXELS} voxels), found "
                f"{self.settings.max_distance:g}"
            )
        self._library = load_library()
        self._handle: int | None = self._library.ggslam_esdf_create(tsdf.handle, self.settings.max_distance)

    def __del__(self) -> None:
        if getattr(self, "_handle", None) is not None:
            self._library.ggslam_esdf_destroy(self._handle)

    @property
    def handle(self) -> int:
        """Pointer for the core."""
        assert self._handle is not None
        return self._handle

    def __len__(self) -> int:
        """Number of blocks."""
        return int(self._library.ggslam_esdf_size(self._handle))

    @property
    def voxel(self) -> float:
        """Edge of a voxel, metres."""
        return self.tsdf.settings.voxel

    @property
    def origin(self) -> np.ndarray:
        """Where in the world blocks are counted from, float64 [3], metres."""
        return self.tsdf.origin

    @property
    def memory_bytes(self) -> int:
        """Memory held by the field between updates."""
        return int(self._library.ggslam_esdf_bytes(self._handle))

    def update(self, budget_ms: float | None = None, near: np.ndarray | None = None) -> UpdateStats:
        """Brings the field up to date with the map.

        A surface point stays where it is until its disc has moved by 1/16 voxel: the rounding of the map's values would
        move half of them with every frame. So distances are within 1/16 voxel of those of the map's own surface
        points, and exactly those of the points that are held (`recompute`).

        Args:
            budget_ms: milliseconds after which what is not done is left for the next update; finding the surface points
                is always done. None: as long as it takes.
            near: [3], metres: what lies near it is done first, and what has waited.
        """
        if budget_ms is not None and not budget_ms > 0:
            raise InputError(f"budget_ms: expected a positive number, found {budget_ms}")
        place = None if near is None else np.ascontiguousarray(near, np.float64)
        if place is not None and (place.shape != (3,) or not np.isfinite(place).all()):
            raise InputError(f"near: expected 3 finite numbers, found {near}")
        place = None if place is None else place - self.origin
        stats = FieldStats()
        self._library.ggslam_esdf_update(
            self._handle, self.tsdf.context.handle, budget_ms or 0.0, None if place is None else place.ctypes.data,
            ctypes.byref(stats),
        )  # fmt: skip
        return self._outcome(stats)

    def recompute(self) -> UpdateStats:
        """Computes all distances anew from the surface points that the field holds. Updates give the same, bit for bit,
        so this is for checks; `clear` and `update` take the map's surface points as they are."""
        stats = FieldStats()
        self._library.ggslam_esdf_recompute(self._handle, self.tsdf.context.handle, ctypes.byref(stats))
        return self._outcome(stats)

    def _outcome(self, stats: FieldStats) -> UpdateStats:
        return UpdateStats(
            self.tsdf.revision, stats.changed_blocks, stats.changed_sites, stats.recomputed_blocks, stats.blocks,
            stats.computed_voxels, stats.stale_blocks, stats.sites_ms, stats.select_ms, stats.transform_ms,
        )  # fmt: skip

    def clear(self) -> None:
        """Forgets everything; the next update computes the whole field."""
        self._library.ggslam_esdf_clear(self._handle)

    def query(self, points: np.ndarray) -> FieldValues:
        """Distances and gradients at points [N, 3] in metres, interpolated between the voxels around.

        The gradient is that of the interpolated distance over a voxel to each side. A point is known if the voxel that
        it is in is. Where others around it are not, they are extrapolated from that one. Points that are not finite are
        not known.
        """
        where = np.ascontiguousarray(points, np.float64)
        if where.ndim != 2 or where.shape[1] != 3:
            raise InputError(f"expected points [N, 3], found an array of shape {where.shape}")
        where = where - self.origin if self.origin.any() else where
        n = len(where)
        distance, gradient, known = np.empty(n, np.float32), np.empty((n, 3), np.float32), np.empty(n, np.uint8)
        stale = np.empty(n, np.uint8)
        arrays = (a.ctypes.data for a in (where, distance, gradient, known, stale))
        self._library.ggslam_esdf_query(self._handle, self.tsdf.context.handle, n, *arrays)
        return FieldValues(distance, gradient, known.astype(bool), stale.astype(bool))

    def is_free(self, points: np.ndarray, radius: float) -> np.ndarray:
        """Whether a ball of `radius` metres around each of the points [N, 3] touches no seen surface, and its centre is
        known and in front of surfaces: bool [N]. It may contain unknown voxels.

        Raises:
            InputError: a radius of `max_distance` or more, for which the field cannot tell.
        """
        if not 0 <= radius < self.settings.max_distance:
            raise InputError(f"radius: expected 0 to below {self.settings.max_distance:g}, found {radius:g}")
        values = self.query(points)
        return values.known & (values.distance > radius)

    def coordinates(self) -> np.ndarray:
        """Coordinates of all blocks from the origin, int32 [B, 3], in no particular order."""
        at = np.empty((len(self), 3), np.int32)
        self._library.ggslam_esdf_list(self._handle, at.ctypes.data)
        return at

    def read(self, coordinates: np.ndarray) -> np.ndarray:
        """Distances of the voxels of the blocks at coordinates [n, 3], float32 [n, 512], in metres; NaN: unknown."""
        at = np.ascontiguousarray(coordinates, np.int32).reshape(-1, 3)
        distance = np.empty((len(at), VOXELS), np.float32)
        self._library.ggslam_esdf_read(self._handle, len(at), at.ctypes.data, distance.ctypes.data)
        return distance

    def surface(self) -> tuple[np.ndarray, np.ndarray]:
        """The points and normals of `discs`."""
        discs = self.discs()
        return discs.points, discs.normals

    def discs(self) -> SurfaceDiscs:
        """The surface that distances are measured from."""
        n = int(self._library.ggslam_esdf_sites(self._handle, None, None, None))
        points, normals, radii = (np.empty(shape, np.float32) for shape in ((n, 3), (n, 3), n))
        arrays = (a.ctypes.data for a in (points, normals, radii))
        self._library.ggslam_esdf_sites(self._handle, *arrays)
        return SurfaceDiscs(points + self.origin if self.origin.any() else points, normals, radii)
