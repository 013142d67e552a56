# SPDX-License-Identifier: Apache-2.0
"""Rows of a map on a device that come and go."""

from __future__ import annotations

import ctypes
import struct
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Final

import torch

from ggslam.abi.cuda import FillJob, PruneJob, RowsJob
from ggslam.cuda.library import CudaLibrary
from ggslam.cuda.memory import GrowingMemory
from ggslam.cuda.transfers import Download
from ggslam.mapping.pruning import pruning_limits
from ggslam.mapping.settings import PruningSettings
from ggslam.scene.gaussian_map import GaussianMap

_WORD: Final = 4
_NO_FILLS: Final = ("means", "quaternions", "log_scales")


@dataclass
class _Array:
    """Where an array begins, and bytes of a row."""

    place: int
    row_bytes: int


class MapRows:
    """Rows of a map.

    Args:
        device: of the map.
        library: the kernels.
    """

    def __init__(self, device: torch.device, library: CudaLibrary) -> None:
        self._device, self._library = device, library
        self._fill, self._rows = FillJob(device=device.index or 0), RowsJob(device=device.index or 0)
        self._memory, self._kept = GrowingMemory(device), Download(1, device, torch.int32)
        self._of: tuple[object, ...] = ()  # map and arrays that are known
        self._arrays: dict[str, _Array] = {}
        self._workspace_bytes = 0

    # --- that come ---------------------------------------------------------------------------------------------------

    def append(self, gaussians: GaussianMap, added: int, opacity_logit: float, birth_keyframe: int) -> slice:
        """Appends so many Gaussians; returns their rows. Of one opacity, and otherwise as `GaussianMap.insert` begins
        them, but for means, rotations, sizes and colours, which the caller has to write."""
        rows, job = self.extend(gaussians, added, opacity_logit, birth_keyframe)
        self._library.call("fill_words", ctypes.byref(job))
        return rows

    def extend(
        self, gaussians: GaussianMap, added: int, opacity_logit: float, birth_keyframe: int
    ) -> tuple[slice, FillJob]:
        """As `append`, but that their values are not written: by what is returned with the rows, valid until the next
        call, the library does it."""
        rows = gaussians.extend(added)
        arrays, job = self._find_arrays(gaussians), self._fill
        values = {"opacity_logits": _bits(opacity_logit), "birth_keyframe": birth_keyframe}
        job.count, job.stream = 0, self._library.stream(gaussians.device)
        for name, array in arrays.items():
            if name not in _NO_FILLS and array.row_bytes:
                fill = job.fills[job.count]
                fill.words = array.place + rows.start * array.row_bytes
                fill.count, fill.value = added * array.row_bytes // _WORD, values.get(name, 0)
                job.count += 1
        return rows, job

    def places(self, gaussians: GaussianMap, row: int) -> Mapping[str, int]:
        """Address of a row in every array."""
        return {name: array.place + row * array.row_bytes for name, array in self._find_arrays(gaussians).items()}

    # --- that go -----------------------------------------------------------------------------------------------------

    def prune(self, gaussians: GaussianMap, settings: PruningSettings) -> int:
        """As `mapping.pruning.prune`. Waits once, for the number of those that go."""
        stays = self._memory.block("stays", len(gaussians))
        places, (logit, log_scale) = self.places(gaussians, 0), pruning_limits(settings)
        job = PruneJob(
            means=places["means"], log_scales=places["log_scales"], opacity_logits=places["opacity_logits"],
            stays=stays.data_ptr(), stream=self._library.stream(self._device), count=len(gaussians), least_logit=logit,
            largest_log_scale=log_scale, device=self._device.index or 0,
        )  # fmt: skip
        self._library.call("prune", ctypes.byref(job))
        return self.keep(gaussians, stays)

    def keep(self, gaussians: GaussianMap, stays: torch.Tensor) -> int:
        """As `GaussianMap.keep`: `stays`, bool or uint8 [at least N] on the device. Waits once."""
        job, count = self._rows, len(gaussians)
        if count == 0:
            return 0
        self._find_arrays(gaussians)
        job.count, job.stays, job.stream = count, stays.data_ptr(), self._library.stream(self._device)
        job.workspace = self._memory.block("rows", self._workspace_bytes).data_ptr()
        job.kept = self._kept.source.data_ptr()
        self._library.call("choose_rows", ctypes.byref(job))
        kept = int(self._kept.fetch()[0])
        if kept < count:
            self._library.call("move_rows", ctypes.byref(job), kept)
            gaussians.shorten(kept)
        return count - kept

    def _find_arrays(self, gaussians: GaussianMap) -> dict[str, _Array]:
        state = gaussians, gaussians.allocations
        if state != self._of:
            self._of, self._arrays = state, {}
            for name, array in gaussians.storage.items():
                bytes_of_row = array.element_size() * (array.numel() // max(1, array.shape[0]))
                self._arrays[name] = _Array(array.data_ptr(), bytes_of_row)
            self._describe(gaussians)
        return self._arrays

    def _describe(self, gaussians: GaussianMap) -> None:
        """Tells the job that moves rows of these arrays, and how much memory it needs when they are full."""
        job = self._rows
        job.count, job.array_count = gaussians.capacity, 0
        for array in self._arrays.values():
            if array.row_bytes:
                row = job.arrays[job.array_count]
                row.rows, row.words = array.place, array.row_bytes // _WORD
                job.array_count += 1
        self._workspace_bytes = self._library.functions.ggslam_cuda_rows_bytes(ctypes.byref(job))


def _bits(value: float) -> int:
    """Of a number as float32."""
    return int(struct.unpack("I", struct.pack("f", value))[0])
