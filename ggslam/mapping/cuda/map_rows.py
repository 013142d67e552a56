# SPDX-License-Identifier: Apache-2.0
"""First values of new rows of a map on a device."""

from __future__ import annotations

import ctypes
import struct
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Final

from ggslam.abi.cuda import FillJob
from ggslam.cuda.library import CudaLibrary
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
        library: the kernels.
        device_index: of the CUDA device.
    """

    def __init__(self, library: CudaLibrary, device_index: int) -> None:
        self._library = library
        self._job = FillJob(device=device_index)
        self._of: tuple[object, ...] = ()  # map and arrays that are known
        self._arrays: dict[str, _Array] = {}

    def append(self, gaussians: GaussianMap, added: int, opacity_logit: float, birth_keyframe: int) -> slice:
        """Appends so many Gaussians; returns their rows. Of one opacity, and otherwise as `GaussianMap.insert` begins
        them, but for means, rotations, sizes and colours, which the caller has to write."""
        rows = gaussians.extend(added)
        arrays, job = self._known(gaussians), self._job
        values = {"opacity_logits": _bits(opacity_logit), "birth_keyframe": birth_keyframe}
        job.count, job.stream = 0, self._library.stream(gaussians.device)
        for name, array in arrays.items():
            if name not in _NO_FILLS and array.row_bytes:
                fill = job.fills[job.count]
                fill.words = array.place + rows.start * array.row_bytes
                fill.count, fill.value = added * array.row_bytes // _WORD, values.get(name, 0)
                job.count += 1
        self._library.call("fill_words", ctypes.byref(job))
        return rows

    def places(self, gaussians: GaussianMap, row: int) -> Mapping[str, int]:
        """Address of a row in every array."""
        return {name: array.place + row * array.row_bytes for name, array in self._known(gaussians).items()}

    def _known(self, gaussians: GaussianMap) -> dict[str, _Array]:
        state = gaussians, gaussians.allocations
        if state != self._of:
            self._of, self._arrays = state, {}
            for name, array in gaussians.storage.items():
                bytes_of_row = array.element_size() * (array.numel() // max(1, array.shape[0]))
                self._arrays[name] = _Array(array.data_ptr(), bytes_of_row)
        return self._arrays


def _bits(value: float) -> int:
    """Of a number as float32."""
    return int(struct.unpack("I", struct.pack("f", value))[0])
