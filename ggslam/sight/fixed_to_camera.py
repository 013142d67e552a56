# SPDX-License-Identifier: Apache-2.0
"""Detects what is fixed to the camera (the tool of a robot, the bonnet of a car): it is in every image at the same
place.

It does not belong to the world: one looks through where it was a moment ago, and it is where it was in the image.
"""

from __future__ import annotations

import ctypes
from collections.abc import Sequence

import numpy as np

from ggslam.abi.arrays import address
from ggslam.abi.core import FixedToCameraJob, LocatedDepth
from ggslam.native.loader import load_library
from ggslam.scene.camera import Camera
from ggslam.sight.margin import Margin
from ggslam.system.tuning import Tuning

_SAME = Margin.usual().native()
_PAST = Margin.usual().times(3).native()
"""The other view has to look past a surface by more than one margin: small images have the nearest depth of each cell,
so that slanted surfaces and outlines differ by more. Of pixels of the world half as many are taken for fixed so."""


class FixedTuning(Tuning):
    """What two views tell about what is fixed to the camera."""

    min_shift = 0.03
    """Smallest expected shift of a world point between two views, as a share of the image width."""


def shrink_depth(depth: np.ndarray, camera: Camera, factor: int) -> tuple[np.ndarray, Camera]:
    """Depth `factor` times smaller, the nearest of each cell that is known (rows and columns left over are cut), and
    its camera.

    Raises:
        ValueError: the image is not of the camera's size.
    """
    if depth.shape != (camera.height, camera.width):
        raise ValueError(f"views: expected depth {(camera.height, camera.width)}, found {depth.shape}")
    h, w = camera.height // factor, camera.width // factor
    depth, small = np.ascontiguousarray(depth, np.float32), np.empty((h, w), np.float32)
    load_library().ggslam_shrink_depth(address(depth), *depth.shape, factor, address(small))
    middle = (factor - 1) / 2
    smaller = Camera(
        w, h, camera.fx / factor, camera.fy / factor, (camera.cx - middle) / factor, (camera.cy - middle) / factor
    )
    return small, smaller


def count_comparisons(
    depth: np.ndarray, T_world_camera: np.ndarray, earlier: Sequence[tuple[np.ndarray, np.ndarray]], camera: Camera,
    counts: np.ndarray,
) -> None:  # fmt: skip
    """Compares a view of a camera with some before it, each with the other.

    Args:
        depth: of the view, float32 [h, w], metres, 0 where unknown.
        T_world_camera: its pose [4, 4].
        earlier: depth and pose of each of the others.
        camera: of all.
        counts: int32 [3, h, w]. To each is added how many of the two comparisons for each earlier view say
            of a pixel that its surface is fixed to the camera: it is where it was in the image, and the other view
            looks through where it would be in the world; that its depth is what it was in the image, though as a part
            of the world it would be elsewhere; that its surface is where a part of the world has to be.

    Raises:
        ValueError: an image is not of the camera's size.
    """
    shape = (camera.height, camera.width)
    if counts.shape != (3, *shape):
        raise ValueError(f"views: expected counts {(3, *shape)}, found {counts.shape}")
    views = (LocatedDepth * (1 + len(earlier)))()
    for view, (image, pose) in zip(views, ((depth, T_world_camera), *earlier), strict=True):
        if image.shape != shape:
            raise ValueError(f"views: expected depth {shape}, found {image.shape}")
        view.depth, view.T_world_camera[:] = address(image), pose[:3].ravel().tolist()
    second, least_shift = ctypes.addressof(views) + ctypes.sizeof(LocatedDepth), FixedTuning.min_shift * camera.width
    job = FixedToCameraJob(
        views[0], second, len(earlier), *shape, camera.fx, camera.fy, camera.cx, camera.cy, _SAME,
        _PAST, least_shift, address(counts),
    )  # fmt: skip
    load_library().ggslam_fixed_to_camera(job)
