# SPDX-License-Identifier: Apache-2.0
"""The distance field of a map on a GPU: that of `DistanceField`, by CUDA kernels."""

from __future__ import annotations

import ctypes
from dataclasses import dataclass

import numpy as np

from ggslam.abi.cuda import FieldDistances, FieldJob, FieldRow, FieldSites, FusedBlock, FusedCount
from ggslam.cuda.transfers import download
from ggslam.volumes.cuda.field_memory import FieldMemory
from ggslam.volumes.cuda.fusion_jobs import grid_blocks
from ggslam.volumes.cuda.tsdf import CudaTsdf
from ggslam.volumes.esdf import FieldSettings, SurfaceDiscs
from ggslam.volumes.tsdf import VOXELS



@dataclass(frozen=True)
class CudaFieldStats:
    """What the last update did; see `UpdateStats`."""

    changed_blocks: int
    changed_sites: int
    recomputed_blocks: int
    computed_voxels: int


class CudaField:
    """The field of a map on a device. It is empty until the first `update`.

    A map has one field at a time. Updates do everything, however long it takes: there is no budget.

    Args:
        tsdf: the map.
        settings: how far distances are computed.
    """

    def __init__(self, tsdf: CudaTsdf, settings: FieldSettings | None = None) -> None:
        self.tsdf, self.settings = tsdf, settings or FieldSettings()
        state = tsdf.state
        self._memory = FieldMemory(tsdf.device, state.memory.room)
        self._device, self._grid = tsdf.device, grid_blocks(tsdf.library)
        state.grown.append(self._memory.grow)
        state.cleared.append(self._memory.clear)

    @property
    def memory_bytes(self) -> int:
        """Memory of the field on the device."""
        return self._memory.bytes

    def update(self) -> None:
        """Starts to bring the field up to date with the views so far; see `DistanceField.update`. The host does not wait
        for it."""
        self._start(False)

    def recompute(self) -> None:
        """The same, and makes all distances anew. Updates give the same, bit for bit, so this is for checks."""
        self._start(True)

    def _start(self, anew: bool) -> None:
        state = self.tsdf.state
        state.make_room()

        def run(number: int) -> None:
            s = self.tsdf.settings
            job = FieldJob(
                state.memory.structure(), self._memory.structure(), self.tsdf.library.stream(self._device),
                self._device.index or 0, number, self._grid, int(anew), self.settings.max_distance / s.voxel,
            )  # fmt: skip
            self.tsdf.library.call("field_update", ctypes.byref(job))

        state.ring.start(run)

    def stats(self) -> CudaFieldStats:
        """What the last operation did, which has to have been an update; waits for it."""
        counts = self.tsdf.state.settled()
        names = (
            FusedCount.CHANGED_ROWS, FusedCount.CHANGED_SITES, FusedCount.CONCERNED_ROWS, FusedCount.COMPUTED_VOXELS
        )  # fmt: skip
        return CudaFieldStats(*(int(counts[name]) for name in names))

    def coordinates(self) -> np.ndarray:
        """Coordinates of all blocks with distances, int32 [B, 3], in no particular order; waits."""
        return self._blocks()[0]

    def read(self, coordinates: np.ndarray) -> np.ndarray:
        """Distances of the voxels of the blocks at coordinates [n, 3], float32 [n, 512], metres; NaN: unknown. Waits."""
        at, rows, _ = self._blocks()
        found = download(self._memory.read("distances", int(rows.max(initial=-1)) + 1))[0]
        distances = found.reshape(-1).view(np.dtype(FieldDistances))["distance"]
        places = {tuple(c): row for c, row in zip(at.tolist(), rows.tolist(), strict=True)}
        out = np.full((len(coordinates), VOXELS), np.nan, np.float32)
        for n, place in enumerate(np.asarray(coordinates).tolist()):
            if (row := places.get(tuple(place))) is not None:
                out[n] = distances[row]
        return out

    def discs(self) -> SurfaceDiscs:
        """The surface that distances are measured from; waits."""
        at, rows, states = self._blocks()
        held = states["site_slot"] > 0
        slots = states["site_slot"][held] - 1
        found = download(self._memory.read("sites", int(slots.max(initial=-1)) + 1))[0]
        sites = found.reshape(-1).view(np.dtype(FieldSites))[slots]
        there = np.unpackbits(sites["held"].view(np.uint8).reshape(len(slots), -1), axis=1, bitorder="little") > 0
        points = np.moveaxis(sites["at"], 1, 2) + 8.0 * at[held][:, None] + 0.5
        voxel, origin = self.tsdf.settings.voxel, self.tsdf.origin
        points = (voxel * points[there]).astype(np.float32)
        moved = points if origin is None or not origin.any() else points + origin
        return SurfaceDiscs(moved, np.moveaxis(sites["normal"], 1, 2)[there], voxel * sites["radius"][there])

    def _blocks(self) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Coordinates, rows and `FieldRow`s of the blocks that have distances."""
        state = self.tsdf.state
        count = int(state.settled()[FusedCount.ROWS_USED])
        blocks, rows = download(state.memory.read("blocks", count), self._memory.read("rows", count))
        listed = blocks.reshape(-1).view(np.dtype(FusedBlock))
        states = rows.reshape(-1).view(np.dtype(FieldRow))
        there = (listed["present"] != 0) & (states["computed"] != 0)
        return listed["at"][there], np.nonzero(there)[0], states[there]
