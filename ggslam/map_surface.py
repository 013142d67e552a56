# SPDX-License-Identifier: Apache-2.0
"""What a frame or scan is aligned to when it is located in a stored map: the cells around the sensor, or all of them.

A cell's points become flat Gaussians along its surface. Their normals are those stored with the points (attribute
`NORMAL`), else estimated from neighbours and turned towards the sensor: what it sees faces it, and what does not face
it, it does not see.
"""

from __future__ import annotations

from collections.abc import Iterable
from types import TracebackType
from typing import Protocol

import numpy as np
from scipy.spatial import cKDTree

from ggslam.errors import FormatError
from ggslam.native.loader import NativeContext
from ggslam.submaps.cell_keys import CellKey
from ggslam.submaps.cell_points import CellArrays
from ggslam.submaps.grid import GridStore
from ggslam.submaps.partial_map import MapStatus, PartialMap
from ggslam.submaps.recorder import load_points
from ggslam.submaps.settings import SubmapSettings
from ggslam.tracking.gicp import GicpTarget
from ggslam.tracking.settings import TargetSettings
from ggslam.tracking.surface import FLATNESS, quaternions_from_normals

NORMAL = "normal"
"""Attribute of a cell's points: unit normals times 127, int8 [N, 3], towards the side that was seen."""

SCAN_TARGET = TargetSettings(voxel=0.15, neighbour_weight=0.0)
"""For scans. The map's normals are known and its points lie on surfaces, so that the scatter of neighbouring voxels
adds nothing to a voxel's shape; without it the target takes half the time to make."""
_NEIGHBOURS = 10
_OPACITY_LOGIT = 3.0
_MOST_LEFT = 0.5
"""Points of cells that the sensor has left, as a share of the partial map's, that may stay in the target."""
_SEEN, _UNKNOWN = -1, 0
"""For the core: the normal's side is known, or it is the side of "camera" 0, which is the sensor."""


def packed_normals(normals: np.ndarray) -> np.ndarray:
    """Unit normals [n, 3] as the attribute `NORMAL`."""
    return np.rint(np.asarray(normals) * 127).astype(np.int8)


def load_surface(store: GridStore, key: CellKey) -> CellArrays:
    """Points of a cell float32 [n, 3], "turn": float32 [n, 4] quaternions wxyz that turn z to the normals, and "side":
    int32 [n].

    Raises:
        KeyError: there is no such cell, or it has no points.
        FormatError: the file is damaged.
    """
    arrays = load_points(store, key)
    points = arrays["points"].astype(np.float32, copy=False)
    if NORMAL in arrays:
        stored = arrays[NORMAL].astype(np.float32)
        if stored.shape != points.shape:
            raise FormatError(f"{store.path}: cell {key}: '{NORMAL}' is {list(stored.shape)}, expected [n, 3]")
        normals = stored / np.maximum(np.linalg.norm(stored, axis=1, keepdims=True), 1e-6)
        normals[~stored.any(1)] = [0, 0, 1]
    else:
        normals = estimated_normals(points)
    side = np.full(len(points), _SEEN if NORMAL in arrays else _UNKNOWN, np.int32)
    return {"points": points, "turn": quaternions_from_normals(normals).astype(np.float32), "side": side}


def estimated_normals(points: np.ndarray) -> np.ndarray:
    """Unit normals float32 [n, 3] of points [n, 3] from each one's nearest neighbours, of either sign."""
    count = min(_NEIGHBOURS, len(points))
    if count < 3:
        return np.tile(np.array([0, 0, 1], np.float32), (len(points), 1))
    neighbours = points[cKDTree(points).query(points, count)[1]].astype(np.float64)
    centred = neighbours - neighbours.mean(1, keepdims=True)
    return np.linalg.eigh(centred.transpose(0, 2, 1) @ centred)[1][:, :, 0].astype(np.float32)


class Surface(Protocol):
    """Gives the target to align to, wherever the sensor is."""

    @property
    def target(self) -> GicpTarget | None:
        """None where the map has nothing."""

    @property
    def points(self) -> int:
        """Points of the map that the target was made from."""

    @property
    def sided(self) -> bool:
        """Whether normals point to the side that the sensor sees; else their signs mean nothing."""

    @property
    def damaged(self) -> Iterable[str]:
        """What is wrong with cells that were left out."""

    def move_to(self, position: np.ndarray, velocity: np.ndarray | None = None) -> bool:
        """Makes the target that of a place [3] in the world; whether it is another one than before."""

    def close(self) -> None:
        """Nothing is asked of it any more."""


def make_target(
    cells: CellArrays, sensor: np.ndarray, settings: TargetSettings, context: NativeContext,
    base: GicpTarget | None = None,
) -> GicpTarget:  # fmt: skip
    """The target of the arrays of `load_surface`, and of what `base` holds.

    Args:
        sensor: position [3] that surfaces of unknown side face.
    """
    count = len(cells["points"])
    log_scales = np.tile(np.log(settings.voxel * np.array([1, 1, FLATNESS])).astype(np.float32), (count, 1))
    return GicpTarget.from_arrays(
        np.ascontiguousarray(cells["points"], np.float32), np.ascontiguousarray(cells["turn"], np.float32), log_scales,
        np.full(count, _OPACITY_LOGIT, np.float32), settings, context, np.ascontiguousarray(cells["side"], np.int32),
        np.reshape(sensor, (1, 3)), base=base,
    )  # fmt: skip


class PartialSurface:
    """The surface within R' of the sensor. When the sensor enters a cell, the cells that came are added to the target;
    what went stays in it until it has as many points as `_MOST_LEFT` of the partial map, or a cell was written anew:
    then the target is made anew from the cells that are there.

    Args:
        store: the map; it must stay open.
        settings: of the target.
        context: threads to work on.
        submaps: None: the store's.
    """

    def __init__(
        self, store: GridStore, settings: TargetSettings, context: NativeContext, submaps: SubmapSettings | None = None
    ) -> None:
        self.map = PartialMap(store, submaps, load_surface)
        self.target: GicpTarget | None = None
        self.sided = True
        self.points = 0
        """Points that the target was made from."""
        self._settings, self._context = settings, context
        self.damaged: set[str] = set()
        """What is wrong with cells that were within R' and cannot be read."""
        self._versions: dict[CellKey, int] = {}
        """Of the cells in the target."""

    def move_to(self, position: np.ndarray, velocity: np.ndarray | None = None) -> bool:
        """See `Surface`."""
        status = self.map.update(position, velocity)
        if status is MapStatus.UNCHANGED:
            return False
        self.damaged.update(self.map.damaged.values())
        if not len(self.map.points):
            changed = self.target is not None
            self.target, self.points, self._versions = None, 0, {}
            return changed
        return self._make(position)

    def _make(self, position: np.ndarray) -> bool:
        """Adds to the target, or makes it anew; whether there was anything to do."""
        versions, slices = self.map.versions, self.map.slices
        came = [key for key in versions if key not in self._versions]
        added = sum(slices[key].stop - slices[key].start for key in came)
        rewritten = any(self._versions.get(key, version) != version for key, version in versions.items())
        left = self.points + added - len(self.map.points)
        if self.target is None or rewritten or left > _MOST_LEFT * len(self.map.points):
            self.target = make_target(self.map.arrays, position, self._settings, self._context)
            self.points, self._versions = len(self.map.points), versions
            return True
        if came:
            arrays = {n: np.concatenate([v[slices[k]] for k in came]) for n, v in self.map.arrays.items()}
            self.target = make_target(arrays, position, self._settings, self._context, self.target)
            self.points, self._versions = self.points + added, {**self._versions, **versions}
        return bool(came)

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
    """The surface of the whole map, read once. Memory and reading time go with the map."""

    def __init__(self, store: GridStore, settings: TargetSettings, context: NativeContext) -> None:
        self.target: GicpTarget | None = None
        self.points = 0
        self.sided = True
        self.damaged: list[str] = []
        self._store, self._settings, self._context = store, settings, context
        self._read = False

    def move_to(self, position: np.ndarray, velocity: np.ndarray | None = None) -> bool:
        """See `Surface`; the first call reads the map."""
        if self._read:
            return False
        self._read = True
        cells = [cell for key in self._store.cells() if (cell := self._cell(key)) is not None]
        if not cells:
            return False
        arrays = {name: np.concatenate([cell[name] for cell in cells]) for name in cells[0]}
        cells.clear()
        self.points = len(arrays["points"])
        self.sided = bool((arrays["side"] == _SEEN).all())
        self.target = make_target(arrays, position, self._settings, self._context)
        return True

    def close(self) -> None:
        """Nothing to end."""

    def _cell(self, key: CellKey) -> CellArrays | None:
        try:
            return load_surface(self._store, key)
        except FormatError as error:
            self.damaged.append(str(error))
        except KeyError:  # a cell without points
            pass
        return None
