# SPDX-License-Identifier: Apache-2.0
"""Targets on the device: the voxels of the compiled core, and the hash table that finds them."""

from __future__ import annotations

import threading
import weakref
from ctypes import sizeof
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch

from ggslam.abi.arrays import address
from ggslam.abi.core import Voxel, VoxelMoments
from ggslam.abi.cuda import TrackJob, VoxelBlock, VoxelLevel, VoxelLevelJob, VoxelSlot
from ggslam.cuda.memory import GrowingMemory
from ggslam.cuda.transfers import Upload
from ggslam.native.loader import load_library
from ggslam.system.tuning import Tuning
from ggslam.tracking.gicp import GicpTarget


class HashTableTuning(Tuning):
    """Hash table of voxels on the device."""

    min_slots_per_block = 4
    """Fewest slots per block, so that most look-ups end at the first slot."""


@dataclass(frozen=True)
class _Staged:
    """A target in page-locked memory, ready to be sent.

    Attributes:
        target: the target.
        settings: what its voxels' shapes are to be made with; None: they are there.
        voxels, blocks: how many there are at each level.
        begins: bytes before each of voxels and blocks, and all bytes.
    """

    target: weakref.ref[GicpTarget]
    settings: Any
    voxels: list[int]
    blocks: list[int]
    begins: list[int]


class CudaTarget:
    """The newest target on the device. It is sent when it is first used, in one copy; the next one takes its memory.
    The thread that made it may get it ready to be sent (`stage`).

    Args:
        device: where to.
    """

    def __init__(self, device: torch.device) -> None:
        self._device = device
        self._core = load_library()
        self._memory = GrowingMemory(device)
        self._upload = Upload(device)
        self._target: weakref.ref[GicpTarget] | None = None
        self._staged: _Staged | None = None
        self._staging = threading.Lock()

    def stage(self, target: GicpTarget) -> None:
        """Copies a target to page-locked memory; in any thread."""
        with self._staging:
            self._stage(target)

    def fill(self, target: GicpTarget, job: TrackJob) -> None:
        """Sets the levels of the job to those of the target, and whether they have to be made."""
        job.makes_levels = 0
        if self._target is None or self._target() is not target:
            self._target = None
            with self._staging:
                job.fine, job.coarse = self._send(self._stage(target), target.voxel)
            job.align.fine, job.align.coarse = job.fine.level, job.coarse.level
            job.makes_levels = 1
            self._target = weakref.ref(target)

    def _stage(self, target: GicpTarget) -> _Staged:
        """Blocks and voxels of both levels on the host; of voxels without shapes the moments, for the device to finish.
        """
        if self._staged is not None and self._staged.target() is target:
            return self._staged
        core, handle, settings = self._core, target.gathered_handle, target.settings_to_finish
        copy, size = core.ggslam_gicp_target_voxels, sizeof(Voxel)
        if settings is not None:
            copy, size = core.ggslam_gicp_target_moments, sizeof(VoxelMoments)
        voxels = [core.ggslam_gicp_target_size(handle, level) for level in (0, 1)]
        blocks = [core.ggslam_gicp_target_blocks(handle, level, None) for level in (0, 1)]
        begins = np.cumsum([0, *(size * n for n in voxels), *(sizeof(VoxelBlock) * n for n in blocks)]).tolist()
        self._staged = None
        host = address(self._upload.begin(begins[-1]))
        for level in (0, 1):
            copy(handle, level, host + begins[level])
            core.ggslam_gicp_target_blocks(handle, level, host + begins[2 + level])
        self._staged = _Staged(weakref.ref(target), settings, voxels, blocks, begins)
        return self._staged

    def _send(self, staged: _Staged, voxel: float) -> tuple[VoxelLevelJob, VoxelLevelJob]:
        """Starts to send what was staged; what makes the levels of it."""
        voxels, blocks, begins = staged.voxels, staged.blocks, staged.begins
        sent = self._memory.block("target", begins[-1])
        self._upload.send(sent[: begins[-1]])
        first = sent.data_ptr()
        made = []
        for level in (0, 1):
            job = VoxelLevelJob(
                blocks=first + begins[2 + level], voxels=first + begins[level], block_count=blocks[level],
                voxel_count=voxels[level], device=self._device.index or 0,
            )  # fmt: skip
            if staged.settings is not None:
                job.moments, job.settings = first + begins[level], staged.settings
                job.voxels = self._memory.block(f"voxels {level}", sizeof(Voxel) * voxels[level]).data_ptr()
            job.level = self._level(level, job, voxel)
            made.append(job)
        return made[0], made[1]

    def _level(self, level: int, job: VoxelLevelJob, voxel: float) -> VoxelLevel:
        """The level that the job is to make, with room for its hash table."""
        places = 64
        while places < HashTableTuning.min_slots_per_block * job.block_count:
            places *= 2
        slots = self._memory.block(f"slots {level}", sizeof(VoxelSlot) * places)
        size = np.float32(voxel) * np.float32(4 if level else 1)
        return VoxelLevel(job.voxels, slots.data_ptr(), places - 1, size, np.float32(1) / size)
