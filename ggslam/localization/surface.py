# SPDX-License-Identifier: Apache-2.0
"""The target for locating frames or scans in a stored map: the cells around the sensor, or all of them.

A cell's points become flat Gaussians along its surface. Their normals are those stored with the points (attribute
`NORMAL`), else estimated from neighbours; then it is not known which side of a surface the sensor sees. A cell is
gathered in voxels when it is read, ahead of the motion in the background; what is left to do when the sensor enters a
cell is to compose the cells around it.

Targets are in single precision, relative to an origin near the sensor (`scene.origin`): where that is in the world is
told by the target, and poses are world poses everywhere else.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, replace
from types import TracebackType
from typing import Final, Protocol

import numpy as np
from scipy.spatial import cKDTree

from ggslam.errors import FormatError
from ggslam.geometry.normals import estimate_normals
from ggslam.localization.coverage import Coverage, Everywhere, coverage_of, reach_of
from ggslam.native.loader import NativeContext
from ggslam.scene.origin import is_far, local_origin
from ggslam.submaps.cell_keys import CellKey
from ggslam.submaps.cell_points import POINTS
from ggslam.submaps.cells_around import CellsAround, MapStatus
from ggslam.submaps.grid import GridStore
from ggslam.submaps.recorder import load_points
from ggslam.submaps.settings import SubmapSettings
from ggslam.system.tuning import Tuning
from ggslam.tracking.gicp import GicpTarget
from ggslam.tracking.settings import TargetSettings
from ggslam.tracking.surface import SurfaceTuning, quaternions_from_normals
from ggslam.tracking.target_parts import TargetPart, composed_target

NORMAL = "normal"
"""Attribute of a cell's points: unit normals times 127, int8 [N, 3], towards the side that was seen."""

SCAN_TARGET = TargetSettings(voxel=0.15, neighbour_weight=0.0)
"""For scans. The map's normals are known and its points lie on surfaces, so that the scatter of neighbouring voxels
adds nothing to a voxel's shape; without it a cell's voxels are finished when it is read, but for those that it shares
with others."""


class StoredSurfaceTuning(Tuning):
    """Surfaces of a stored map."""

    sampled_cells = 12
    """Cells from which the spacing of the points is measured."""
    sampled_points = 2000
    """Most points of each of these cells."""
    neighbours = 10
    """Points that a normal is estimated from."""
    opacity_logit = 3.0
    """Opacity of the points, as a logit."""


_ANYWHERE = np.array([0.36, 0.48, 0.8], np.float32)
"""Normals whose side is not known have a positive part in this direction: neighbours mostly agree, in all cells."""
_RANK_BITS: Final = 21
"""Bits of a cell's coordinate in its rank of 63 bits."""


def packed_normals(normals: np.ndarray) -> np.ndarray:
    """Unit normals [n, 3] as the attribute `NORMAL`."""
    return np.rint(np.asarray(normals) * 127).astype(np.int8)


def load_surface(
    store: GridStore, key: CellKey, origin: np.ndarray | None = None
) -> tuple[np.ndarray, np.ndarray, bool]:
    """Points, relative to an origin [3] (None: the world's), and unit normals of a cell, float32 [n, 3]; and whether
    the normals point to the side that was seen.

    Raises:
        KeyError: there is no such cell, or it has no points.
        FormatError: the file is damaged.
    """
    arrays = load_points(store, key)
    placed = arrays["points"] if origin is None or not origin.any() else arrays["points"].astype(np.float64) - origin
    points = np.ascontiguousarray(placed, np.float32)
    if NORMAL not in arrays:
        normals = surface_normals(points)
        return points, np.where(normals @ _ANYWHERE < 0, -1, 1).astype(np.float32)[:, None] * normals, False
    stored = arrays[NORMAL].astype(np.float32)
    if stored.shape != points.shape:
        raise FormatError(f"{store.path}: cell {key}: '{NORMAL}' is {list(stored.shape)}, expected [n, 3]")
    normals = stored / np.maximum(np.linalg.norm(stored, axis=1, keepdims=True), 1e-6)
    normals[~stored.any(1)] = [0, 0, 1]
    return points, normals, True


@dataclass(frozen=True)
class SurfaceCell:
    """A cell of the map as part of targets; `has_sides`: see `Surface`; `reach`: see `reach_of`."""

    part: TargetPart
    has_sides: bool
    reach: float


class SurfaceLoader:
    """Reads cells as parts of targets of some settings, in any thread; `origin` [3]: of the targets, in the world."""

    def __init__(self, settings: TargetSettings, context: NativeContext, origin: np.ndarray | None = None) -> None:
        self.settings, self.context = settings, context
        self.origin = np.zeros(3) if origin is None else origin

    def __call__(self, store: GridStore, key: CellKey) -> SurfaceCell:
        """Raises what `load_surface` raises."""
        points, normals, has_sides = load_surface(store, key, self.origin)
        turn = np.ascontiguousarray(quaternions_from_normals(normals), np.float32)
        flat = np.log(self.settings.voxel * np.array([1, 1, SurfaceTuning.flatness])).astype(np.float32)
        log_scales = np.tile(flat, (len(points), 1))
        opacity_logits = np.full(len(points), StoredSurfaceTuning.opacity_logit, np.float32)
        rank = _rank(key)
        part = TargetPart(points, turn, log_scales, opacity_logits, self.settings, self.context, rank)
        return SurfaceCell(part, has_sides, reach_of(points + self.origin, key, store.grid))


def _rank(key: CellKey) -> int:
    """A number that no two cells within 2^21 cells share."""
    mask = (1 << _RANK_BITS) - 1
    half = 1 << (_RANK_BITS - 1)  # neighbours about zero are in order, too
    return sum(((coordinate + half) & mask) << (_RANK_BITS * axis) for axis, coordinate in enumerate(key))


def point_spacing(store: GridStore) -> float:
    """Metres from a point of the map to the next one, as three of four points have it at most; 0 without points. A few
    cells are looked at."""
    keys = [key for key in store.cells() if POINTS in store.cell(key).parts]
    apart = []
    cells = np.linspace(0, len(keys) - 1, StoredSurfaceTuning.sampled_cells).round().astype(int)
    for number in np.unique(cells).tolist() if keys else []:
        try:
            points = load_points(store, keys[number])["points"]
        except (FormatError, KeyError):  # who needs the cell says so
            continue
        if len(points) > 1:
            few = points[:: max(1, len(points) // StoredSurfaceTuning.sampled_points)]
            apart.append(cKDTree(points).query(few, 2)[0][:, 1])
    return float(np.percentile(np.concatenate(apart), 75)) if apart else 0.0


def surface_normals(points: np.ndarray) -> np.ndarray:
    """Unit normals float32 [n, 3] of points [n, 3] from each one's nearest neighbours, of either sign."""
    if min(StoredSurfaceTuning.neighbours, len(points)) < 3:
        return np.tile(np.array([0, 0, 1], np.float32), (len(points), 1))
    return estimate_normals(points, neighbours=StoredSurfaceTuning.neighbours).astype(np.float32)


class Surface(Protocol):
    """Gives the target to align to, wherever the sensor is."""

    @property
    def target(self) -> GicpTarget | None:
        """None where the map has nothing."""

    @property
    def points(self) -> int:
        """Points of the cells that the target is composed of."""

    @property
    def has_sides(self) -> bool:
        """Whether normals point to the side that the sensor sees; else their signs mean nothing."""

    @property
    def damage(self) -> Iterable[str]:
        """What is wrong with cells that were left out."""

    def move_to(self, position: np.ndarray, velocity: np.ndarray | None = None) -> bool:
        """Makes the target that of a place [3] in the world; whether it is another one than before."""

    def covers(self, points: np.ndarray) -> np.ndarray:
        """Whether the target can contain world points [n, 3]: those that lie elsewhere say nothing about a pose."""

    def close(self) -> None:
        """Nothing is asked of it any more."""


class PartialSurface:
    """The surface within R' of the sensor, composed anew when the sensor enters a cell.

    Args:
        store: the map; it must stay open.
        settings: of the target.
        context: threads to work on.
        submaps: None: the store's.
    """

    def __init__(
        self, store: GridStore, settings: TargetSettings, context: NativeContext, submaps: SubmapSettings | None = None
    ) -> None:
        self._store, self._submaps = store, submaps
        self._settings, self._context = settings, context
        self.map = self._cells_around(np.zeros(3))
        self.target: GicpTarget | None = None
        self.has_sides = True
        self.points = 0
        self._coverage: Coverage = Everywhere()
        self._reach: tuple[float, float] | None = None
        self.damage: set[str] = set()
        """What is wrong with cells that were within R' and cannot be read."""

    def move_to(self, position: np.ndarray, velocity: np.ndarray | None = None) -> bool:
        """See `Surface`."""
        before = self.target
        if is_far(position, self._origin):  # every kilometre at most
            self.map.close()
            self.map = self._cells_around(local_origin(position))
            self.target = None
            if self._reach is not None:
                self.map.set_reach(*self._reach)
        status = self.map.update(position, velocity)
        if status is MapStatus.UNCHANGED:
            return False
        self.damage.update(self.map.damaged.values())
        cells = self.map.cells.values()
        self.points = sum(cell.part.count for cell in cells)
        self.has_sides = all(cell.has_sides for cell in cells)
        reaches = {key: cell.reach for key, cell in self.map.cells.items()}
        submaps = replace(self.map.settings, partial_radius=self.map.radius)
        self._coverage = coverage_of(reaches, submaps, np.asarray(position, np.float64))
        parts, like = [cell.part for cell in cells], self.target
        self.target = None
        if self.points:
            self.target = composed_target(parts, self._settings, self._context, like, self._origin)
        return self.target is not None or before is not None

    def set_reach(self, radius: float, step: float) -> None:
        """Changes R' and the distance between two maps, see `CellsAround.set_reach`."""
        self._reach = radius, step
        self.map.set_reach(radius, step)

    def _cells_around(self, origin: np.ndarray) -> CellsAround[SurfaceCell]:
        """Cells as parts of targets with this origin."""
        self._origin = origin
        loader = SurfaceLoader(self._settings, self._context, origin)
        return CellsAround(self._store, loader, POINTS, lambda cell: cell.part.nbytes, self._submaps)

    def covers(self, points: np.ndarray) -> np.ndarray:
        """See `Surface`."""
        return self._coverage.covers(points)

    def close(self) -> None:
        """Ends loading ahead."""
        self.map.close()

    def __enter__(self) -> PartialSurface:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()


class FullSurface:
    """The surface of the whole map, read once. Memory and reading time go with the map; its origin is near the first
    place that is asked for."""

    def __init__(self, store: GridStore, settings: TargetSettings, context: NativeContext) -> None:
        self.target: GicpTarget | None = None
        self.points = 0
        self.has_sides = True
        self.damage: list[str] = []
        self._store, self._settings, self._context = store, settings, context
        self._read = False
        self._coverage: Coverage = Everywhere()

    def move_to(self, position: np.ndarray, velocity: np.ndarray | None = None) -> bool:
        """See `Surface`; the first call reads the map."""
        if self._read:
            return False
        self._read = True
        loader = SurfaceLoader(self._settings, self._context, local_origin(position))
        held = {key: cell for key in self._store.cells() if (cell := self._cell(loader, key)) is not None}
        cells = held.values()
        self.points = sum(cell.part.count for cell in cells)
        self._coverage = coverage_of({key: cell.reach for key, cell in held.items()}, self._store.settings)
        if not self.points:
            return False
        self.has_sides = all(cell.has_sides for cell in cells)
        parts = [cell.part for cell in cells]
        self.target = composed_target(parts, self._settings, self._context, origin=loader.origin)
        return True

    def covers(self, points: np.ndarray) -> np.ndarray:
        """See `Surface`."""
        return self._coverage.covers(points)

    def close(self) -> None:
        """Nothing to end."""

    def _cell(self, loader: SurfaceLoader, key: CellKey) -> SurfaceCell | None:
        try:
            return loader(self._store, key)
        except FormatError as error:
            self.damage.append(str(error))
        except KeyError:  # a cell without points
            pass
        return None
