# SPDX-License-Identifier: Apache-2.0
"""Targets on the device: the voxels of the compiled core, and the hash table that finds them.

A target that grew from the one on the device shares most blocks with it: those that changed are sent, in one copy with
where they belong, and the kernels put them there. Any other target is sent whole in the same form.
"""

from __future__ import annotations

import ctypes
import threading
import weakref
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch

from ggslam.abi.arrays import address
from ggslam.abi.core import TargetChanges, TargetCopy
from ggslam.abi.cuda import TrackJob
from ggslam.cuda.transfers import Upload
from ggslam.native.loader import load_library
from ggslam.system.tuning import Tuning
from ggslam.tracking.cuda.target_memory import TargetMemory
from ggslam.tracking.gicp import GicpTarget


class CudaTargetTuning(Tuning):
    """Targets on the device."""

    staging_bytes = 1 << 20
    """Page-locked memory that blocks are sent from, until more are sent at once. A keyframe of 640x480 changes 0.3 to
    0.9 MB."""


@dataclass(frozen=True)
class _Staged:
    """What the device lacks of a target, in page-locked memory and ready to be sent.

    Attributes:
        target: the target.
        settings: what its voxels' shapes are to be made with; None: they are there.
        before: the copy on the device that this is added to.
        changes: what there is, and where.
        source: that, page-locked uint8 [n].
        out: where it goes, uint8 [n].
    """

    target: weakref.ref[GicpTarget]
    settings: Any
    before: tuple[int, int, int]
    changes: TargetChanges
    source: torch.Tensor
    out: torch.Tensor


class CudaTarget:
    """A copy of the newest target on the device: it is brought up to date when another one is first used. The thread
    that made that may get it ready to be sent (`stage`).

    Args:
        device: where to.
    """

    def __init__(self, device: torch.device) -> None:
        self._device = device
        self._core = load_library()
        self._memory = TargetMemory(device)
        self._upload, self._room = Upload(device), 0
        self._target: weakref.ref[GicpTarget] | None = None
        self._copy = TargetCopy()  # what is on the device
        self._sent: tuple[weakref.ref[GicpTarget], TargetCopy] | None = None  # not yet known to have arrived
        self._staged: _Staged | None = None
        self._staging = threading.Lock()

    def stage(self, target: GicpTarget) -> None:
        """Copies what the device lacks of a target to page-locked memory; in any thread."""
        with self._staging:
            if self._memory.has_stream:  # the first one is sent by who uses it
                self._stage(target)

    def fill(self, target: GicpTarget, job: TrackJob) -> None:
        """Sets the levels of the job to those of the target, and whether they have to be made. `note_made` when that
        was started."""
        job.makes_levels = 0
        if self._target is not None and self._target() is target:
            return
        with self._staging:
            if self._sent is not None:  # what became of that is not known
                self._copy, self._sent = TargetCopy(), None
            self._memory.note_stream()
            staged = self._stage(target)
            self._send(staged, target.voxel, job)
            self._target, self._staged = None, None
            self._sent = weakref.ref(target), staged.changes.target
        job.align.fine, job.align.coarse = job.fine.level, job.coarse.level
        job.makes_levels = 1

    def note_made(self) -> None:
        """The device makes the levels that `fill` asked for."""
        if self._sent is not None:
            self._target, self._copy = self._sent
            self._sent = None
            self._memory.note_used()

    def _stage(self, target: GicpTarget) -> _Staged:
        """Blocks that changed and their voxels on the host; of voxels without shapes the moments, for the device to
        finish."""
        copy = self._copy  # the other thread may put a newer one there
        before = copy.number, copy.version, copy.finished
        if self._staged is not None and self._staged.target() is target and self._staged.before == before:
            return self._staged
        self._staged = None
        handle, settings, changes = target.gathered_handle, target.settings_to_finish, TargetChanges()
        size = self._room = max(self._room, CudaTargetTuning.staging_bytes)
        while True:
            size = self._core.ggslam_gicp_target_changes(
                handle, ctypes.byref(copy), settings is None, address(self._upload.begin(self._room)), self._room,
                ctypes.byref(changes),
            )  # fmt: skip
            if size <= self._room:
                break
            self._room = max(size, 2 * self._room)
        out, source = self._memory.reserve(changes, size, settings is not None), self._upload.filled_part(size)
        self._staged = _Staged(weakref.ref(target), settings, before, changes, source, out)
        return self._staged

    def _send(self, staged: _Staged, voxel: float, job: TrackJob) -> None:
        """Starts to send what was staged, and sets the jobs that make the levels of it."""
        self._memory.use(not staged.changes.whole, job.fine, job.coarse)
        self._upload.send_part(staged.source, staged.out)
        first, settings = self._memory.address, staged.settings
        for changes, made, size in (
            (staged.changes.fine, job.fine, np.float32(voxel)),
            (staged.changes.coarse, job.coarse, np.float32(4) * np.float32(voxel)),
        ):
            made.empties, made.device = staged.changes.whole, self._device.index or 0
            made.blocks, made.indices = first + changes.blocks_at, first + changes.indices_at
            made.block_count, made.voxel_count = changes.block_count, changes.voxel_count
            values = first + changes.values_at
            made.new_voxels, made.new_moments = (values, None) if settings is None else (None, values)
            if settings is not None:
                made.settings = settings
            made.level.voxels, made.level.size, made.level.inverse_size = made.voxels, size, np.float32(1) / size
