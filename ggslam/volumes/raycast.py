# SPDX-License-Identifier: Apache-2.0
"""The surface of a TSDF as a camera sees it: depth, normals, colours, objects."""

from __future__ import annotations

import ctypes
from dataclasses import dataclass

import numpy as np

from ggslam.abi.core import RaycastView, SurfaceImages
from ggslam.errors import InputError
from ggslam.native.loader import load_library
from ggslam.scene.camera import Camera
from ggslam.scene.origin import moved_pose
from ggslam.volumes.surface_cells import surface_cells
from ggslam.volumes.tsdf import TsdfMap


@dataclass(frozen=True)
class RenderedSurface:
    """Images of the surface; all 0 where none is seen.

    Attributes:
        depth: float32 [H, W], along the optical axis, metres.
        normals: float32 [H, W, 3], unit, in the camera's axes, towards free space.
        colors: uint8 [H, W, 3].
        labels: uint16 [H, W], object; 0: none.
    """

    depth: np.ndarray
    normals: np.ndarray
    colors: np.ndarray
    labels: np.ndarray


def check_view(T_world_camera: np.ndarray, near: float, far: float) -> np.ndarray:
    """The pose as float64 [4, 4].

    Raises:
        InputError: it is not finite, or the range of depth is none.
    """
    if not 0 < near < far:
        raise InputError(f"expected 0 < near < far, found near {near} and far {far}")
    pose = np.asarray(T_world_camera, np.float64)
    if pose.shape != (4, 4) or not np.isfinite(pose).all():
        raise InputError(f"expected a finite pose [4, 4], found {pose.tolist()}")
    return pose


def render_depth(
    tsdf: TsdfMap, camera: Camera, T_world_camera: np.ndarray, near: float = 0.1, far: float = 10.0,
    min_weight: float | None = None,
) -> RenderedSurface:  # fmt: skip
    """Casts a ray through every pixel centre to the first change from free space to the inside.

    The field is interpolated trilinearly between voxels that are all known; surfaces seen from behind are passed
    through. Where the surface runs is looked up again only after the map has changed.

    Args:
        tsdf: the map.
        camera: its size is that of the images.
        T_world_camera: float64 [4, 4].
        near, far: range of depth, metres.
        min_weight: voxels of less weight (in measurements from 1 m), or never seen, count as unknown; None: see
            `TsdfSettings.least_weight`.

    Raises:
        InputError: a range that is none, or a pose that is not finite.
    """
    pose = check_view(T_world_camera, near, far)
    shape = (camera.height, camera.width)
    images = RenderedSurface(
        np.zeros(shape, np.float32), np.zeros((*shape, 3), np.float32), np.zeros((*shape, 3), np.uint8),
        np.zeros(shape, np.uint16),
    )  # fmt: skip
    pose = moved_pose(pose, -tsdf.origin)
    cells = surface_cells(tsdf, min_weight)
    view = RaycastView(
        camera.fx, camera.fy, camera.cx, camera.cy, near, far, (ctypes.c_float * 9)(*pose[:3, :3].ravel()),
        (ctypes.c_float * 3)(*pose[:3, 3]), camera.width, camera.height,
    )  # fmt: skip
    pointers = SurfaceImages(*(a.ctypes.data for a in (images.depth, images.normals, images.colors, images.labels)))
    load_library().ggslam_raycast(tsdf.context.handle, cells.handle, ctypes.byref(view), ctypes.byref(pointers))
    return images
