# SPDX-License-Identifier: Apache-2.0
"""Tracking on an NVIDIA GPU: the work of `CpuTrackingEngine` by kernels, with one wait per alignment.

A frame's depth is sent once. Points, their number, the whole optimisation from the coarse voxels to the fine ones and
its result stay on the device; the host gets the result in one copy, and waits for that alone. Sums have a fixed order:
results repeat bit for bit.

What grey values contribute is chosen on the host, from images at reduced resolution, while the device extracts points:
the textured points of a frame are sent in one copy (80 kB at most), the reference image when it is another one.
"""

from __future__ import annotations

import ctypes
import math
import weakref

import numpy as np
import torch

from ggslam.abi import core as structures
from ggslam.abi.cuda import AlignJob, AlignResult, DepthPointsJob
from ggslam.cuda.library import CudaLibrary, library_and_device
from ggslam.cuda.memory import GrowingMemory
from ggslam.cuda.transfers import Download, Upload
from ggslam.scene.camera import Camera
from ggslam.tracking.cuda.points import CudaPoints
from ggslam.tracking.cuda.results import cuda_alignment
from ggslam.tracking.cuda.target import CudaTarget
from ggslam.tracking.gicp import AlignmentResult, GicpTarget, PhotometricPart, native_align_settings
from ggslam.tracking.photometric import PhotometricReference
from ggslam.tracking.points import PointSource, check_depth, grid_stride, native_points_settings
from ggslam.tracking.settings import AlignSettings, DepthNoise, PointSettings


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
        self._target = CudaTarget(self.library, self.device)
        self._depth = torch.empty(4 * camera.width * camera.height, dtype=torch.uint8, device=self.device)
        self._depth_upload, self._grey_upload, self._reference_upload = (Upload(self.device) for _ in range(3))
        self._results = Download(AlignResult.ALIGN_RESULTS, self.device)
        self._workspace = torch.zeros(0, dtype=torch.uint8, device=self.device)
        self._reference: weakref.ref[PhotometricReference] | None = None

    def points(self, depth: np.ndarray, settings: PointSettings, noise: DepthNoise) -> CudaPoints:
        """Starts `points.extract_points`.

        Args:
            depth: float32 [H, W], metres, 0 where unknown.

        Raises:
            ValueError: `depth` has another shape than the camera.
        """
        check_depth(depth, self.camera)
        staged = self._depth_upload.begin(self._depth.numel()).view(np.float32).reshape(depth.shape)
        np.copyto(staged, depth)
        self._depth_upload.send(self._depth)
        stride = grid_stride(int(np.count_nonzero(staged > 0)), settings.count)
        arguments = native_points_settings(self.camera, settings, noise, stride, depth)
        border = arguments.window * arguments.window_step
        columns, rows = (
            max(0, math.ceil((size - 2 * border - stride // 2) / stride)) for size in (depth.shape[1], depth.shape[0])
        )
        found = CudaPoints(columns * rows, self.device)
        job = DepthPointsJob(
            self._depth.data_ptr(), found.arrays(), None, self.library.stream(self.device), arguments,
            self.device.index or 0, columns, rows,
        )  # fmt: skip
        size = self.library.functions.ggslam_cuda_depth_points_bytes(ctypes.byref(job))
        job.workspace = self._memory.block("points", size).data_ptr()
        self.library.call("depth_points", ctypes.byref(job))
        return found

    def align(
        self, source: PointSource, target: GicpTarget, T_world_camera_guess: np.ndarray, settings: AlignSettings,
        noise: DepthNoise, photometric: PhotometricPart | None = None,
    ) -> AlignmentResult:  # fmt: skip
        """As `gicp.align`, of points that `points` gave; waits for the result.

        Raises:
            TypeError: other points.
        """
        if not isinstance(source, CudaPoints):
            raise TypeError("expected points that are on the device")
        matched = torch.empty((2, max(1, source.room)), dtype=torch.float32, device=self.device)
        fine, coarse = self._target.levels(target)
        job = AlignJob(
            points=source.arrays(), fine=fine, coarse=coarse, match=matched[0].data_ptr(),
            squared_distance=matched[1].data_ptr(), results=self._results.source.data_ptr(),
            stream=self.library.stream(self.device), device=self.device.index or 0, room=source.room,
            settings=native_align_settings(settings, noise, photometric.settings if photometric else None),
        )  # fmt: skip
        T = np.asarray(T_world_camera_guess, np.float64)
        job.guess[:] = [*T[:3, :3].ravel().tolist(), *T[:3, 3].tolist()]
        if photometric is not None and len(photometric.points):
            self._add_photometric(job, photometric)
        job.workspace = self._aligning_memory(job).data_ptr()
        self.library.call("align", ctypes.byref(job))
        source.send()  # some hundred kilobytes, so that a keyframe has them without another wait
        found = self._results.wait()
        source.set_header(int(found[AlignResult.POINT_COUNT]), float(found[AlignResult.MEDIAN_DEPTH]))
        return cuda_alignment(found, matched, settings)

    def _aligning_memory(self, job: AlignJob) -> torch.Tensor:
        """What an alignment works in, all zero when new."""
        size = self.library.functions.ggslam_cuda_align_bytes(ctypes.byref(job))
        if self._workspace.numel() < size:
            self._workspace = torch.zeros(size + size // 4, dtype=torch.uint8, device=self.device)
        return self._workspace

    def _add_photometric(self, job: AlignJob, part: PhotometricPart) -> None:
        """Sends the textured points, and the reference unless it is there already."""
        count = len(part.points)
        staged = self._grey_upload.begin(16 * count).view(np.float32)
        staged[: 3 * count], staged[3 * count :] = part.points.points.ravel(), part.points.intensity
        points = self._memory.block("grey points", 16 * count)
        self._grey_upload.send(points[: 16 * count])
        job.photometric_points = structures.PhotometricPoints(points.data_ptr(), points.data_ptr() + 12 * count, count)
        reference = part.reference
        pixels = self._memory.block("reference", reference.pixels.nbytes)
        if self._reference is None or self._reference() is not reference:
            staged = self._reference_upload.begin(reference.pixels.nbytes).view(np.float32)
            np.copyto(staged, reference.pixels.ravel())
            self._reference_upload.send(pixels[: reference.pixels.nbytes])
            self._reference = weakref.ref(reference)
        job.reference = reference.native()
        job.reference.pixels = pixels.data_ptr()
