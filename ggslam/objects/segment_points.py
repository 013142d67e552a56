# SPDX-License-Identifier: Apache-2.0
"""Where the segments of a keyframe lie, found by the compiled core in the calling thread."""

from __future__ import annotations

import ctypes
from dataclasses import dataclass

import numpy as np

from ggslam.abi import core
from ggslam.abi.arrays import address
from ggslam.errors import InputError
from ggslam.native.loader import load_library
from ggslam.objects.overlap import SegmentOverlap
from ggslam.scene.camera import Camera


class SegmentPoints:
    """The points of a keyframe by segment, in the camera's frame.

    Attributes:
        overlap: of the segments with the objects.
        depth: float32 [H, W], metres, 0 = unknown.
        camera: of the keyframe.

    Raises:
        InputError: images of different size.
    """

    def __init__(self, overlap: SegmentOverlap, depth: np.ndarray, camera: Camera) -> None:
        rays = camera.rays()
        if not rays.shape[:2] == depth.shape == overlap.row.shape:
            sizes = [list(shape) for shape in (rays.shape[:2], depth.shape, overlap.row.shape)]
            raise InputError(f"camera, depth and segments must have one size, found {sizes}")
        self.overlap, self.depth, self.camera = overlap, depth, camera
        self._arrays = [
            overlap.row, np.ascontiguousarray(depth, np.float32), np.ascontiguousarray(rays[0, :, 0]),
            np.ascontiguousarray(rays[:, 0, 1]),
        ]  # fmt: skip
        self._image = core.SegmentedDepth(*map(address, self._arrays), *depth.shape, len(overlap.segments))

    def find_extents(self, segments: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Of segments with these numbers [n], all different: centres float64 [n, 3] and root mean square distances of
        their points from them, float64 [n]; metres, 0: no depth."""
        asked = np.ascontiguousarray(segments, np.int32)
        centres, squares = np.empty((len(asked), 3)), np.empty(len(asked))
        job = core.ExtentsJob(self._image, address(asked), len(asked), address(centres), address(squares))
        load_library().ggslam_segment_extents(ctypes.byref(job))
        return centres, np.sqrt(squares)

    def fit_planes(
        self, segments: np.ndarray, stride: int, flat_m: float, min_on_plane: float, behind_m: float
    ) -> list[SegmentPlane | None]:
        """Of segments with these numbers [n] the planes that most of their points lie on; None: it is not flat, or has
        less than ten points.

        Args:
            stride: every n-th pixel along each axis is used.
            flat_m: on a plane are points nearer than this, in metres, up to 3 m of depth; it grows in proportion
                beyond.
            min_on_plane: smallest share of a segment's points there.
            behind_m: points are behind a plane from this distance on, in metres up to 2 m of depth; it grows in
                proportion beyond.
        """
        asked = np.ascontiguousarray(segments, np.int32)
        planes = (core.SegmentPlane * len(asked))()
        job = core.SegmentPlanesJob(
            self._image, stride, address(asked), len(asked), flat_m, min_on_plane, behind_m, ctypes.addressof(planes)
        )
        load_library().ggslam_segment_planes(ctypes.byref(job))
        return [
            SegmentPlane(np.array(found.normal), found.offset, np.array(found.middle), found.behind)
            if found.is_flat
            else None
            for found in planes
        ]


@dataclass(frozen=True)
class SegmentPlane:
    """The plane of a segment in the camera's frame, metres.

    Attributes:
        normal: float64 [3], unit, towards the camera.
        offset: n . x of its points.
        middle: float64 [3], mean point of the segment.
        behind: share of all points of the image that lie behind it.
    """

    normal: np.ndarray
    offset: float
    middle: np.ndarray
    behind: float
