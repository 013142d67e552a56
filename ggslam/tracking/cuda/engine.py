# SPDX-License-Identifier: Apache-2.0
"""Tracking on an NVIDIA GPU: the work of `CpuTrackingEngine` by kernels, in one call and one wait per alignment.

A frame's depth is sent once, and its colour where grey values are compared. Points, their number, grey images, textured
points, the whole optimisation from the coarse voxels to the fine ones and its result stay on the device; the host gets
the result in one copy, and waits for that alone. Sums have a fixed order: results repeat bit for bit.

What the kernels are asked for is one structure that is filled once: of it, what changes is written.
"""

from __future__ import annotations

import ctypes
import math
import weakref
from typing import Final

import numpy as np
import torch

from ggslam.abi.core import DepthPointsSettings
from ggslam.abi.cuda import AlignJob, AlignResult, MoverEvidenceJob, TrackJob
from ggslam.cuda.library import CudaLibrary, library_and_device
from ggslam.cuda.memory import GrowingMemory
from ggslam.scene.camera import Camera
from ggslam.tracking.cuda.blocks import BlockPool
from ggslam.tracking.cuda.fetches import FetchRing
from ggslam.tracking.cuda.frame_upload import FrameUpload
from ggslam.tracking.cuda.greys import CudaGreys, CudaPhotometricPart
from ggslam.tracking.cuda.host_greys import HostGreys
from ggslam.tracking.cuda.points import CudaPoints, words_for
from ggslam.tracking.cuda.results import cuda_alignment
from ggslam.tracking.cuda.target import CudaTarget
from ggslam.tracking.gicp import (
    AlignmentResult,
    GicpTarget,
    PhotometricPart,
    PhotometricSource,
    native_align_settings,
)
from ggslam.tracking.points import PointSource, check_depth, grid_stride, native_points_settings
from ggslam.tracking.settings import UNBOUNDED, AlignSettings, DepthNoise, PhotometricSettings, PointSettings

_GUESS: Final = TrackJob.align.offset + AlignJob.guess.offset


class CudaTrackingEngine:
    """Extracts points and aligns them on torch's current stream. One engine serves one thread at a time.

    Args:
        camera: of all frames.
        device: CUDA device; None: the current one.
        library: the compiled kernels; None: those of the device, compiled if need be.

    Raises:
        MissingDependency: no CUDA device, or the kernels cannot be compiled.
        NativeCoreError: the compiled kernels do not fit this code.
    """

    def __init__(
        self, camera: Camera, device: torch.device | str | None = None, library: CudaLibrary | None = None
    ) -> None:
        self.library, self.device = library_and_device(device, library)
        self.camera = camera
        self._memory = GrowingMemory(self.device)
        self._target = CudaTarget(self.device)
        self._depth = FrameUpload((camera.height, camera.width), np.float32, self.device)
        self.greys = CudaGreys(self.library, self.device, camera, self._depth)
        self._host_greys = HostGreys(self.device)
        self._point_blocks, self._match_blocks = BlockPool(self.device), BlockPool(self.device)
        self._ring = FetchRing(self.device)
        self._pending: weakref.ref[CudaPoints] | None = None
        self._grid = (-1, -1)  # that there is memory for
        self._point_room = self._point_words = 0
        self._points_of: tuple[PointSettings, DepthNoise, int] | None = None  # and stride, that the job is set for
        self._workspace = torch.zeros(0, dtype=torch.uint8, device=self.device)
        self._largest = (0, 0)  # room and textured points that the workspace is known to have room for
        self._settings_of: tuple[AlignSettings, DepthNoise, PhotometricSettings | None] | None = None
        self._results = torch.zeros(AlignResult.ALIGN_RESULTS, dtype=torch.float64, device=self.device)
        pinned = self.device.type == "cuda"
        self._arrived = torch.zeros(AlignResult.ALIGN_RESULTS, dtype=torch.float64, pin_memory=pinned)
        self._found = self._arrived.numpy()
        self._job = TrackJob(results=self._arrived.data_ptr())
        self._reference = ctypes.byref(self._job)
        self.evidence: MoverEvidenceJob = self._job.evidence
        """What is asked of an alignment that brings evidence of what moves, but for depth and pose."""
        guess = np.frombuffer(self._job, np.float64, 12, _GUESS)
        self._guess_rotation, self._guess_translation = guess[:9].reshape(3, 3), guess[9:]
        job = self._job
        job.align.results, job.points.depth = self._results.data_ptr(), self._depth.address
        job.align.device = job.points.device = self.device.index or 0

    def points(self, depth: np.ndarray, settings: PointSettings, noise: DepthNoise) -> CudaPoints:
        """Sends a depth image, and gets `points.extract_points` ready, which the first alignment or reader starts.

        Args:
            depth: float32 [H, W], metres, 0 where unknown.

        Raises:
            ValueError: `depth` has another shape than the camera.
        """
        self.send_depth(depth)
        stride, job = grid_stride(self._depth.known, settings.count), self._job.points
        before, usual = self._points_of, settings.near_weight >= UNBOUNDED
        if not (before is not None and usual and before[0] is settings and before[1] is noise and before[2] == stride):
            self._set_points(native_points_settings(self.camera, settings, noise, stride, depth))
            self._points_of = settings, noise, stride
        found = CudaPoints(self._point_room, self._point_blocks.take(self._point_words), self._extract, self._ring)
        job.out = found.arrays
        self._pending = weakref.ref(found)
        return found

    def send_depth(self, depth: np.ndarray) -> None:
        """Sends a frame's depth image ahead of what is made of it.

        Args:
            depth: float32 [H, W], metres, 0 where unknown.

        Raises:
            ValueError: `depth` has another shape than the camera.
        """
        if depth.shape != self._depth.staged.shape:
            check_depth(depth, self.camera)
        before = None if self._pending is None else self._pending()
        if before is not None and not before.is_extracted:
            self._extract(before)
        self._depth.send(depth)

    @property
    def depth_on_device(self) -> int:
        """Where depth images are on the device."""
        return self._depth.address

    def note_depth_arrival(self) -> None:
        """The host has waited for the stream that `send_depth` used."""
        self._depth.under_way = False

    def align(
        self, source: PointSource, target: GicpTarget, T_world_camera_guess: np.ndarray, settings: AlignSettings,
        noise: DepthNoise, photometric: PhotometricSource | None = None,
    ) -> AlignmentResult:  # fmt: skip
        """As `gicp.align`, of points that `points` gave; waits for the result.

        Raises:
            TypeError: other points, or a photometric part of another engine.
        """
        if not isinstance(source, CudaPoints):
            raise TypeError("expected points that are on the device")
        job, align, room = self._job, self._job.align, source.room
        matched = self._match_blocks.take(2 * max(1, room))
        align.points, align.room = source.arrays, room
        align.match, align.squared_distance = matched.address, matched.address + 4 * max(1, room)
        self._guess_rotation[...] = T_world_camera_guess[:3, :3]
        self._guess_translation[...] = T_world_camera_guess[:3, 3]
        greys, before = None if photometric is None else photometric.settings, self._settings_of
        if before is None or before[0] is not settings or before[1] is not noise or before[2] is not greys:
            align.settings = native_align_settings(settings, noise, greys)
            self._settings_of = settings, noise, greys
        self._target.fill(target, job)
        self._set_photometric(photometric)
        if room > self._largest[0] or align.photometric_points.count > self._largest[1]:
            self._make_room(align)
        job.makes_points = not source.is_extracted
        job.looks = source.looks
        align.stream = self.library.stream(self.device)
        self.library.call("track_wait", self._reference)
        self._depth.under_way = False
        self._target.note_made()
        found = self._found.copy()
        source.note_aligned(int(found[AlignResult.POINT_COUNT]), float(found[AlignResult.MEDIAN_DEPTH]))
        if isinstance(photometric, CudaPhotometricPart):
            self.greys.color.under_way = False
            textured = photometric.textured = int(found[AlignResult.TEXTURED])
            photometric.has_texture = textured >= photometric.least
        return cuda_alignment(found, matched, max(1, room), source.looks, settings)

    def expect_target(self, target: GicpTarget) -> None:
        """See `Tracker.expect_target`."""
        self._target.stage(target)

    def depth_address(self, depth: np.ndarray) -> int | None:
        """Where a frame's depth is on the device, if this very array was sent last."""
        return self._depth.address if self._depth.image is depth else None

    def bring_evidence(self, wanted: bool) -> None:
        """Whether each alignment from now on makes `evidence` as well, of the depth on the device at the pose that it
        finds: it is there when `align` returns."""
        if wanted:
            self.evidence.depth, self.evidence.pose = self._depth.address, self._results.data_ptr()
        self._job.makes_evidence = wanted

    # --- parts -------------------------------------------------------------------------------------------------------

    def _set_points(self, settings: DepthPointsSettings) -> None:
        """Sets how points are extracted, and the grid of those that may be."""
        job, stride = self._job.points, settings.stride
        first = 2 * settings.window * settings.window_step + stride // 2
        columns = max(0, math.ceil((self.camera.width - first) / stride))
        rows = max(0, math.ceil((self.camera.height - first) / stride))
        job.settings, job.columns, job.rows = settings, columns, rows
        self._point_room, self._point_words = columns * rows, words_for(columns * rows)
        if self._grid != (columns, rows):
            size = self.library.functions.ggslam_cuda_depth_points_bytes(ctypes.byref(job))
            job.workspace = self._memory.block("points", size).data_ptr()
            self._grid = columns, rows

    def _extract(self, points: CudaPoints) -> None:
        """Starts to extract the points that were got ready last, if that was not done yet."""
        if not points.is_extracted:
            self._job.points.stream = self.library.stream(self.device)
            self.library.call("depth_points", ctypes.byref(self._job.points))
            points.is_extracted = True

    def _set_photometric(self, part: PhotometricSource | None) -> None:
        """Sets what grey values contribute, and what has to be made for that.

        Raises:
            TypeError: it is of another engine.
        """
        job, align = self._job, self._job.align
        job.makes_reference = job.makes_greys = 0
        align.textured = None
        if part is None:
            align.photometric_points.count = 0
        elif isinstance(part, CudaPhotometricPart):
            self.greys.prepare(part, job)
        elif isinstance(part, PhotometricPart):
            self._host_greys.send(part, align)
        else:
            raise TypeError("expected a photometric part of this engine or of the host")

    def _make_room(self, align: AlignJob) -> None:
        """Memory that an alignment works in, all zero when new."""
        room, textured = align.room, align.photometric_points.count
        self._largest = max(room, self._largest[0]), max(textured, self._largest[1])
        align.room, align.photometric_points.count = self._largest
        size = self.library.functions.ggslam_cuda_align_bytes(ctypes.byref(align))
        align.room, align.photometric_points.count = room, textured
        if self._workspace.numel() < size:
            self._workspace = torch.zeros(size + size // 4, dtype=torch.uint8, device=self.device)
        align.workspace = self._workspace.data_ptr()
