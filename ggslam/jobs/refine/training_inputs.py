# SPDX-License-Identifier: Apache-2.0
"""Inputs of training a cell: its own Gaussians, those around it, and the keyframes that see them.
"""

from __future__ import annotations

import math
from collections import OrderedDict
from collections.abc import Mapping

import numpy as np

from ggslam.errors import FormatError
from ggslam.geometry.frustums import Frustums
from ggslam.jobs.refine.cell_mapper import CellBox
from ggslam.jobs.refine.cell_training import CellTask
from ggslam.jobs.refine.settings import RefineSettings
from ggslam.jobs.submaps.cell_gaussians import ARRAYS, GAUSSIANS, cell_arrays, gaussians_to_bytes
from ggslam.jobs.submaps.visit_records import read_record, recording_text
from ggslam.runs.records.visit import VisitRecord
from ggslam.scene.camera import Camera
from ggslam.scene.poses import inverse
from ggslam.submaps.cell_keys import CellKey
from ggslam.submaps.grid import GridStore
from ggslam.system.tuning import Tuning


class CellTrainingTuning(Tuning):
    """How neighbours of a cell are kept."""

    cells_in_memory = 64
    """Neighbours that are kept in memory: each is asked for up to 27 times."""


class StoreCells:
    """The cells of a store that have Gaussians.

    Args:
        store: which is not written to meanwhile.
        settings: how its cells are trained.
    """

    def __init__(self, store: GridStore, settings: RefineSettings) -> None:
        self.store, self.settings = store, settings
        self.versions = {
            key: record.parts[GAUSSIANS].version for key in store.cells()
            if GAUSSIANS in (record := store.cell(key)).parts and record.parts[GAUSSIANS].count
        }  # fmt: skip
        """Of the Gaussians of each cell."""
        self.damaged: dict[CellKey, str] = {}
        """Neighbours that could not be read, and why."""
        self._records: dict[str, _Views] = {}
        self._known: OrderedDict[CellKey, Mapping[str, np.ndarray]] = OrderedDict()

    def task(self, key: CellKey) -> CellTask:
        """All that training a cell needs.

        Raises:
            FormatError: its Gaussians are damaged, or nobody knows the recording that they are from.
        """
        name = f"{self.store.path}: cell {key}"
        own, visit = cell_arrays(self.store, key)
        if visit is None:
            raise FormatError(f"{name}: was stored before stores knew their recordings: make the store again")
        views, box = self._views_of(visit, name), CellBox.of(self.store.grid, key)
        low, high = own["means"].min(0).astype(float), own["means"].max(0).astype(float)
        return CellTask(
            key, name, box, self.store.get(key, GAUSSIANS), self._halo(key, box, own), views.text,
            views.that_see(low - self.settings.border, high + self.settings.border, self.settings.views), self.settings,
        )  # fmt: skip

    def _views_of(self, visit: str, name: str) -> _Views:
        if visit not in self._records:
            record = read_record(self.store, visit)
            if record is None:
                raise FormatError(f"{name}: nothing is known of the recording of its visit {visit!r}")
            self._records[visit] = _Views(record)
        return self._records[visit]

    def _halo(self, key: CellKey, box: CellBox, own: Mapping[str, np.ndarray]) -> bytes:
        """The Gaussians of other cells that lie around one, with its channels."""
        around, parts = box.grow(self.settings.halo), list[dict[str, np.ndarray]]()
        for other in self._neighbours(key):
            rows = self._arrays(other)
            if rows is None:
                continue
            inside = around.holds(rows["means"])
            if inside.any():
                parts.append(_rows_like(own, {name: rows[name][inside] for name in ARRAYS}))
        if not parts:
            return b""
        return gaussians_to_bytes({name: np.concatenate([part[name] for part in parts]) for name in ARRAYS}, None)

    def _neighbours(self, key: CellKey) -> list[CellKey]:
        """Cells that reach into the halo of one, sorted."""
        near = self.store.around(key, GAUSSIANS, math.ceil(self.settings.halo / self.store.grid.spacing))
        return [other for other in near if other in self.versions and other != key]

    def _arrays(self, key: CellKey) -> Mapping[str, np.ndarray] | None:
        if key in self._known:
            self._known.move_to_end(key)
            return self._known[key]
        if key in self.damaged:
            return None
        try:
            found, _ = cell_arrays(self.store, key)
        except FormatError as error:
            self.damaged[key] = str(error)
            return None
        self._known[key] = found
        if len(self._known) > CellTrainingTuning.cells_in_memory:
            self._known.popitem(last=False)
        return found


class _Views:
    """The keyframes of a visit, and what they may see."""

    def __init__(self, record: VisitRecord) -> None:
        self.text = recording_text(record)
        self._count = len(record.keyframes)
        reach = record.settings().mapping.insertion.max_depth_m
        cameras: dict[Camera, list[int]] = {}
        for number, keyframe in enumerate(record.keyframes):
            cameras.setdefault(record.camera_of(keyframe), []).append(number)
        poses = [inverse(keyframe.T_world_camera) for keyframe in record.keyframes]
        self._groups = [
            (numbers, Frustums.of(camera, np.stack([poses[k] for k in numbers]), np.full(len(numbers), reach)))
            for camera, numbers in cameras.items()
        ]

    def that_see(self, low: np.ndarray, high: np.ndarray, most: int) -> tuple[int, ...]:
        """Numbers of those that may see a box, evenly chosen where there are more than `most`."""
        seen = np.zeros(self._count, bool)
        for numbers, frustums in self._groups:
            seen[numbers] = frustums.touch(low[None], high[None])[:, 0]
        found = np.flatnonzero(seen)
        if len(found) > most:
            found = found[(np.arange(most) * (len(found) / most)).astype(int)]
        return tuple(found.tolist())


def _rows_like(own: Mapping[str, np.ndarray], rows: Mapping[str, np.ndarray]) -> dict[str, np.ndarray]:
    """Gaussians with as many coefficients and channels as others have: more are left out, lacking ones are zero."""
    found = dict(rows)
    for name in ("sh", "features"):
        found[name] = np.zeros((len(rows["means"]), *own[name].shape[1:]), np.float32)
        shared = min(found[name].shape[1], rows[name].shape[1])
        found[name][:, :shared] = rows[name][:, :shared]
    return found
