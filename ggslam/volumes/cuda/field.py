# SPDX-License-Identifier: Apache-2.0
"""The distance field of a map on a GPU: that of `DistanceField`, by CUDA kernels."""

from __future__ import annotations

import ctypes
from dataclasses import dataclass

import numpy as np

from ggslam.abi.cuda import FieldJob, FusedCount
from ggslam.volumes.cuda.field_memory import FieldMemory
from ggslam.volumes.cuda.field_on_host import held_field, put_field
from ggslam.volumes.cuda.fusion_jobs import grid_blocks
from ggslam.volumes.cuda.tsdf import CudaTsdf
from ggslam.volumes.esdf import DistanceField, FieldSettings, SurfaceDiscs
from ggslam.volumes.tsdf import VOXELS, TsdfMap


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
        """Starts to bring the field up to date with the views so far, see `DistanceField.update`. The host does not
        wait for it."""
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
        counts = self.tsdf.state.settle()
        names = (
            FusedCount.CHANGED_ROWS, FusedCount.CHANGED_SITES, FusedCount.CONCERNED_ROWS, FusedCount.COMPUTED_VOXELS
        )  # fmt: skip
        return CudaFieldStats(*(int(counts[name]) for name in names))

    def coordinates(self) -> np.ndarray:
        """Coordinates of all blocks with distances, int32 [B, 3], in no particular order; waits."""
        return held_field(self.tsdf.state, self._memory).at

    def read(self, coordinates: np.ndarray) -> np.ndarray:
        """Distances of the voxels of blocks at coordinates [n, 3], float32 [n, 512], metres, NaN: unknown; waits."""
        held = held_field(self.tsdf.state, self._memory)
        places = {tuple(at): row for row, at in enumerate(held.at.tolist())}
        rows = np.array([places.get(tuple(at), -1) for at in np.asarray(coordinates).tolist()], np.intp)
        distances = np.concatenate([held.distances["distance"], np.full((1, VOXELS), np.nan, np.float32)])
        return distances[rows]

    def discs(self) -> SurfaceDiscs:
        """The surface that distances are measured from; waits."""
        held = held_field(self.tsdf.state, self._memory)
        blocks, slots, numbers = held.site_numbers()
        voxel, origin = self.tsdf.settings.voxel, self.tsdf.origin
        points = (voxel * (held.sites["at"][slots, :, numbers] + 8.0 * held.at[blocks] + 0.5)).astype(np.float32)
        moved = points if origin is None or not origin.any() else points + origin
        normals, radii = held.sites["normal"][slots, :, numbers], held.sites["radius"][slots, numbers]
        return SurfaceDiscs(moved, normals, voxel * radii)

    def to_native(self, tsdf: TsdfMap) -> DistanceField:
        """The same field in the compiled core; waits.

        Args:
            tsdf: what `to_native` of the field's map gave, after the field was brought up to date with it.
        """
        field = DistanceField(tsdf, self.settings)
        put_field(held_field(self.tsdf.state, self._memory), field)
        return field
