# SPDX-License-Identifier: Apache-2.0
"""Photometric parts of alignments, made on the device from the frame's colour and depth."""

from __future__ import annotations

import ctypes
from dataclasses import dataclass
from typing import Final

import cv2
import numpy as np
import torch

from ggslam.abi import core as structures
from ggslam.abi.cuda import GreyJob, TrackJob
from ggslam.cuda.library import CudaLibrary
from ggslam.cuda.memory import GrowingMemory
from ggslam.features.orb import FeatureView
from ggslam.scene.camera import Camera
from ggslam.scene.poses import inverse
from ggslam.tracking.cuda.frame_upload import FrameUpload
from ggslam.tracking.photometric import reduced_camera
from ggslam.tracking.settings import PhotometricSettings

_COUNT_BYTES: Final = 256
"""Bytes of the block of textured points before the points: their number."""


class CudaPhotometricPart:
    """The photometric terms of alignments of one frame: a `PhotometricSource`.

    Args:
        view: the frame.
        reference: the one that its grey values are compared with.
        settings: see there.
        shrink: by how much images are reduced.
        least: fewest textured points that are used.
    """

    def __init__(
        self, view: FeatureView, reference: FeatureView, settings: PhotometricSettings, shrink: int, least: int
    ) -> None:
        self.view, self.reference, self.settings = view, reference, settings
        self.shrink, self.least = shrink, least
        self.textured: int | None = None
        """How many points are textured; None: no alignment told yet."""
        self.has_texture = True
        """See `PhotometricSource`."""

    def is_of(self, view: FeatureView, reference: FeatureView, settings: PhotometricSettings, shrink: int) -> bool:
        """Whether it was made of these."""
        return (
            self.view is view and self.reference is reference and self.settings is settings and self.shrink == shrink
        )


@dataclass
class _Image:
    """Grey values of a view on the device, see `PhotometricReference.pixels`."""

    memory: torch.Tensor
    view: FeatureView | None = None
    shrink: int = 0


class CudaGreys:
    """Keeps what the device makes of the frame at hand and of the one that it is compared with. A frame that becomes
    the reference need not be sent again.

    Args:
        library: the kernels.
        device: where.
        camera: of all frames.
        depth: where the frame's depth is sent to.
    """

    def __init__(self, library: CudaLibrary, device: torch.device, camera: Camera, depth: FrameUpload) -> None:
        self._library, self._device, self._camera = library, device, camera
        self._depth = depth
        self.color = FrameUpload((camera.height, camera.width, 3), np.uint8, device)
        """Where the frame's colour is sent to."""
        self._others: tuple[FrameUpload, FrameUpload] | None = None
        self._memory = GrowingMemory(device)
        self._images: list[_Image] = []
        self._part: CudaPhotometricPart | None = None
        self._made: CudaPhotometricPart | None = None
        self._job = GreyJob()
        self._filled_for: tuple[PhotometricSettings, int] | None = None
        self._small = camera
        self.reference = structures.PhotometricReferenceView()
        """The one that `prepare` was asked for last, as an alignment takes it."""
        self.points = structures.PhotometricPoints()
        """Where the textured points of the frame are made."""
        self._view_of: tuple[np.ndarray, int] | None = None

    def part(
        self, view: FeatureView, reference: FeatureView, settings: PhotometricSettings, shrink: int, least: int
    ) -> CudaPhotometricPart | None:
        """The photometric part of a frame; None if an alignment has told that it has not enough texture."""
        part = self._part
        if part is not None and part.view is view and part.is_of(view, reference, settings, shrink):
            return part if part.has_texture else None
        self._part = CudaPhotometricPart(view, reference, settings, shrink, least)
        return self._part

    def prepare(self, part: CudaPhotometricPart, job: TrackJob) -> None:
        """Sets what an alignment compares, and what has to be made before of the reference and of the frame, unless it
        is there. Images that this takes are on their way to the device."""
        filled = self._filled_for
        if filled is None or filled[0] is not part.settings or filled[1] != part.shrink:
            self._fill(part.settings, part.shrink)
        reference = self._image_of(part.reference, part.shrink)
        if reference is None:
            reference = self._place_for(part.reference, part.shrink, part.view)
            if self._others is None:
                shape = (self._camera.height, self._camera.width)
                self._others = (
                    FrameUpload((*shape, 3), np.uint8, self._device), FrameUpload(shape, np.float32, self._device)
                )  # fmt: skip
            job.reference = self._job_for(part.reference, reference, *self._others, chooses=False)
            job.makes_reference = 1
        if self._made is not part:
            image = self._image_of(part.view, part.shrink) or self._place_for(part.view, part.shrink, part.reference)
            job.greys = self._job_for(part.view, image, self.color, self._depth, chooses=True)
            job.makes_greys = 1
            self._made = part
        place = part.reference.T_world_camera, reference.memory.data_ptr()
        if self._view_of is None or self._view_of[0] is not place[0] or self._view_of[1] != place[1]:
            self._set_reference(*place)
        align = job.align
        align.photometric_points, align.textured = self.points, self._job.count
        align.reference, align.least_textured = self.reference, part.least

    # --- parts -------------------------------------------------------------------------------------------------------

    def _fill(self, settings: PhotometricSettings, shrink: int) -> None:
        """What is the same for all frames."""
        camera, job = reduced_camera(self._camera, shrink), self._job
        weights = cv2.getGaussianKernel(3, 0.7, cv2.CV_32F)
        job.fx, job.fy, job.cx, job.cy = camera.fx, camera.fy, camera.cx, camera.cy
        job.blur_side, job.blur_middle = float(weights[0, 0]), float(weights[1, 0])
        job.min_squared_gradient = settings.min_gradient**2
        job.width, job.height, job.shrink = self._camera.width, self._camera.height, shrink
        most = job.most_points = min(settings.points, camera.width * camera.height)
        points = self._memory.block("points", _COUNT_BYTES + 16 * most).data_ptr()
        job.count, job.points = points, points + _COUNT_BYTES
        job.intensity = job.points + 12 * most
        self.points = structures.PhotometricPoints(job.points, job.intensity, most)
        size = self._library.functions.ggslam_cuda_grey_bytes(ctypes.byref(job))
        job.workspace = self._memory.block("workspace", size).data_ptr()
        pixels = 4 * camera.width * camera.height
        self._images = [_Image(torch.empty(pixels, dtype=torch.float32, device=self._device)) for _ in range(2)]
        self._small, self._filled_for = camera, (settings, shrink)
        self._made = self._view_of = None

    def _image_of(self, view: FeatureView, shrink: int) -> _Image | None:
        for image in self._images:
            if image.view is view and image.shrink == shrink:
                return image
        return None

    def _place_for(self, view: FeatureView, shrink: int, other: FeatureView) -> _Image:
        """Where a view's image goes: not where that of another view is."""
        first, second = self._images
        image = second if first.view is other else first
        image.view, image.shrink = view, shrink
        return image

    def _job_for(
        self, view: FeatureView, image: _Image, color: FrameUpload, depth: FrameUpload, chooses: bool
    ) -> GreyJob:
        """What makes an image of a view, whose images are sent for it; its depth may be there already."""
        color.send(view.color)
        depth.have(view.depth)
        job = GreyJob.from_buffer_copy(self._job)
        job.color, job.depth, job.pixels = color.address, depth.address, image.memory.data_ptr()
        if not chooses:
            job.count = None
        return job

    def _set_reference(self, T: np.ndarray, address: int) -> None:
        """The reference is a view at a pose T_world_camera [4, 4] whose image is at an address."""
        T_reference_world, small, out = inverse(T), self._small, self.reference
        out.pixels, out.width, out.height = address, small.width, small.height
        out.fx, out.fy, out.cx, out.cy = small.fx, small.fy, small.cx, small.cy
        out.rotation[:] = T_reference_world[:3, :3].ravel().tolist()
        out.translation[:] = T_reference_world[:3, 3].tolist()
        self._view_of = T, address
