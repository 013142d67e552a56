# SPDX-License-Identifier: Apache-2.0
"""What the fusion of views works in on a device, and the jobs of its kernels."""

from __future__ import annotations

import ctypes
from ctypes import sizeof

import torch

from ggslam.abi.core import FusionSettings
from ggslam.abi.cuda import FusedCandidate, FusedMap, FusedRays, FusedUpdate, FuseJob
from ggslam.cuda.library import CudaLibrary
from ggslam.cuda.memory import GrowingMemory
from ggslam.system.tuning import Tuning
from ggslam.volumes.cuda.room import Room
from ggslam.volumes.cuda.view_inputs import SentImages
from ggslam.volumes.fusion_view import FusionView
from ggslam.volumes.settings import INTEGRATORS, TsdfSettings


class GridTuning(Tuning):
    """Size of kernels whose work the device alone knows."""

    blocks = 528
    """Blocks of threads: four of 512 threads for each of an H100's 132 multiprocessors."""
    emulated = 4
    """Blocks where tests run the kernels on the CPU."""


def grid_blocks(library: CudaLibrary) -> int:
    """Blocks of a kernel whose work the device alone knows; emulated ones cost as much each as they would on a GPU
    together."""
    return GridTuning.blocks if torch.version.cuda is not None and torch.cuda.is_available() else GridTuning.emulated


class FusionMemory:
    """Working memory of the fusion.

    Args:
        library: the kernels.
        device: where.
        settings: of the fusion.
        points: whether measured points are counted.
    """

    def __init__(self, library: CudaLibrary, device: torch.device, settings: TsdfSettings, points: bool) -> None:
        self._library, self._device, self._settings, self._points = library, device, settings, points
        self._images, self._lists = GrowingMemory(device), GrowingMemory(device)
        self._marks: torch.Tensor | None = None
        self._rays: torch.Tensor | None = None
        s = settings
        self._numbers = FusionSettings(
            s.min_depth, s.max_depth, s.free_share, s.edge_voxels * s.voxel, s.clearing, s.max_free_weight,
            INTEGRATORS.index(s.integrator), s.least_rays, int(points),
        )  # fmt: skip

    def job(self, fused: FusedMap, room: Room, view: FusionView, sent: SentImages) -> FuseJob:
        """The job of a view, but for its number."""
        c, T = view.camera, view.T_camera_world
        job = FuseJob(
            fused, sent.depth, sent.color or None, sent.labels or None, settings=self._numbers, fx=c.fx, fy=c.fy,
            cx=c.cx, cy=c.cy, width=c.width, height=c.height, device=self._device.index or 0,
            stream=self._library.stream(self._device), list_room=room.listed, update_room=room.updates,
            grid=grid_blocks(self._library),
        )  # fmt: skip
        job.rotation[:], job.translation[:] = T[:3, :3].ravel().tolist(), T[:3, 3].tolist()
        self._add_images(job)
        self._add_lists(job, room)
        return job

    def _add_images(self, job: FuseJob) -> None:
        pixels, memory = job.width * job.height, self._images
        job.prepared = memory.block("depth", 4 * (pixels + job.width + 16)).data_ptr()
        if self._settings.clearing > 0:
            job.eroded = memory.block("eroded", 4 * pixels).data_ptr()
        tiles = self._library.functions.ggslam_cuda_fuse_tiles(job.width, job.height)
        job.tiles = memory.block("tiles", 4 * tiles).data_ptr()
        job.valid = memory.block("valid", 4 * ((job.width + 3) // 4 + 1) * ((job.height + 3) // 4 + 1)).data_ptr()

    def _add_lists(self, job: FuseJob, room: Room) -> None:
        memory = self._lists
        job.cubes = memory.block("cubes", 16 * room.listed).data_ptr()
        job.candidates = memory.block("candidates", sizeof(FusedCandidate) * room.listed).data_ptr()
        job.updates = memory.block("updates", sizeof(FusedUpdate) * room.updates).data_ptr()
        if self._points:
            if self._marks is None or self._marks.numel() < 512 * room.updates:
                self._marks = torch.zeros(512 * room.updates, dtype=torch.uint8, device=self._device)
            job.octants = self._marks.data_ptr()
        if self._settings.integrator != "projection":
            size = 512 * sizeof(FusedRays) * room.updates
            if self._rays is None or self._rays.numel() < size:
                self._rays = torch.zeros(size, dtype=torch.uint8, device=self._device)
            job.rays = self._rays.data_ptr()

    def start(self, job: FuseJob, number: int) -> None:
        """Starts the fusion of a view."""
        job.number = job.revision = number
        self._library.call("fuse", ctypes.byref(job))
