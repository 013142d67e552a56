# SPDX-License-Identifier: Apache-2.0
"""Photometric parts that were made on the host, on their way to the device."""

from __future__ import annotations

import weakref

import numpy as np
import torch

from ggslam.abi import core as structures
from ggslam.abi.cuda import AlignJob
from ggslam.cuda.memory import GrowingMemory
from ggslam.cuda.transfers import Upload
from ggslam.tracking.gicp import PhotometricPart
from ggslam.tracking.photometric import PhotometricReference


class HostGreys:
    """Sends the textured points of a frame, and the reference unless it is there already.

    Args:
        device: where to.
    """

    def __init__(self, device: torch.device) -> None:
        self._memory = GrowingMemory(device)
        self._points, self._pixels = Upload(device), Upload(device)
        self._reference: weakref.ref[PhotometricReference] | None = None

    def send(self, part: PhotometricPart, job: AlignJob) -> None:
        """Sets the job's photometric part."""
        count = len(part.points)
        staged = self._points.begin(16 * count).view(np.float32)
        staged[: 3 * count], staged[3 * count :] = part.points.points.ravel(), part.points.intensity
        points = self._memory.block("points", 16 * count)
        self._points.send(points[: 16 * count])
        job.photometric_points = structures.PhotometricPoints(points.data_ptr(), points.data_ptr() + 12 * count, count)
        reference = part.reference
        pixels = self._memory.block("reference", reference.pixels.nbytes)
        if self._reference is None or self._reference() is not reference:
            staged = self._pixels.begin(reference.pixels.nbytes).view(np.float32)
            np.copyto(staged, reference.pixels.ravel())
            self._pixels.send(pixels[: reference.pixels.nbytes])
            self._reference = weakref.ref(reference)
        job.reference = reference.native()
        job.reference.pixels = pixels.data_ptr()
