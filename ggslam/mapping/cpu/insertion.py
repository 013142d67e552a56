# SPDX-License-Identifier: Apache-2.0
"""Inserts Gaussians where the map does not explain a frame yet."""

from __future__ import annotations

import ctypes

import cv2
import numpy as np

from ggslam.abi.arrays import address
from ggslam.abi.core import InsertionJob
from ggslam.errors import InputError
from ggslam.mapping.new_gaussians import NewGaussians
from ggslam.mapping.settings import InsertionSettings
from ggslam.native.loader import NativeContext, load_library
from ggslam.scene.camera import Camera


def find_unexplained(
    depth: np.ndarray, alpha: np.ndarray, rendered_depth: np.ndarray, s: InsertionSettings
) -> np.ndarray:
    """Pixels to insert at, bool [H, W]: nothing is rendered there, or something behind what is measured.

    Args:
        depth: measured depth [H, W], metres, 0 = none.
        alpha: rendered alpha [H, W].
        rendered_depth: rendered expected depth (normalised by alpha) [H, W].
    """
    tolerance = np.maximum(s.depth_tolerance_m, s.depth_tolerance_relative * depth)
    return (alpha < s.alpha_threshold) | (depth < rendered_depth - tolerance)


def new_gaussians(
    color: np.ndarray, depth: np.ndarray, camera: Camera, T_world_camera: np.ndarray, where: np.ndarray | None,
    s: InsertionSettings, context: NativeContext | None = None,
) -> NewGaussians[np.ndarray]:  # fmt: skip
    """Discs on the measured surface, one per selected pixel with usable depth, computed by the compiled core.

    Each disc covers its pixel's footprint: sigma = scale_pixels * stride * z / f across the viewing direction, longer
    by 1 / cos along the slope of the surface, thin along the normal, which comes from central differences of means over
    3x3 points. Where the 5x5 pixels around have a hole or a jump, or at the image's border, there is no normal, and it
    is a small sphere. The stride is 1, or with `adaptive_stride` 2 where neither colour nor depth has an edge: a wall
    needs fewer Gaussians than a bookshelf.

    Args:
        color: uint8 [H, W, 3].
        depth: float32 [H, W], metres, 0 or NaN = none.
        where: bool [H, W], the pixels that may be selected; None: all.
        context: threads to work on; None: this one.

    Raises:
        InputError: images of another size than the camera's, or of other types.
    """
    context = context or NativeContext(threads=1)
    color, depth, where = _checked_images(color, depth, where, camera)
    marks, pixels = np.empty(depth.shape, np.uint8), np.empty(depth.size, np.int64)
    job = InsertionJob(
        address(color), address(depth), address(where), address(marks), address(pixels), height=camera.height,
        width=camera.width, adaptive_stride=s.adaptive_stride, fx=camera.fx, fy=camera.fy, cx=camera.cx, cy=camera.cy,
        texture_threshold=s.texture_threshold, max_depth=s.max_depth_m, scale_pixels=s.scale_pixels,
        flatness=s.flatness, max_slope=s.max_slope,
    )  # fmt: skip
    job.rotation[:], job.translation[:] = T_world_camera[:3, :3].ravel().tolist(), T_world_camera[:3, 3].tolist()
    library = load_library()
    count = library.ggslam_insertion_select(context.handle, ctypes.byref(job))
    means, quaternions, log_scales, rgb = (np.empty((count, width), np.float32) for width in (3, 4, 3, 3))
    job.means, job.quaternions, job.log_scales, job.rgb = map(address, (means, quaternions, log_scales, rgb))
    library.ggslam_insertion_shape(context.handle, ctypes.byref(job), count)
    return NewGaussians(means, quaternions, log_scales, rgb, pixels[:count])


def _checked_images(
    color: np.ndarray, depth: np.ndarray, where: np.ndarray | None, camera: Camera
) -> tuple[np.ndarray, np.ndarray, np.ndarray | None]:
    """The images as the compiled core takes them."""
    size = (camera.height, camera.width)
    for name, image, shape, kind in (("color", color, (*size, 3), np.uint8), ("depth", depth, size, np.float32),
                                     ("where", where, size, np.bool_)):  # fmt: skip
        if image is not None and (image.shape != shape or image.dtype != kind):
            expected, found = f"{np.dtype(kind)} {list(shape)}", f"{image.dtype} {list(image.shape)}"
            raise InputError(f"insertion: {name}: expected {expected}, found {found}")
    kept = None if where is None else np.ascontiguousarray(where)
    return np.ascontiguousarray(color), np.ascontiguousarray(depth), kept


def fill_gaussians(
    color: np.ndarray, depth: np.ndarray, alpha: np.ndarray, camera: Camera, T_world_camera: np.ndarray,
    s: InsertionSettings,
) -> NewGaussians[np.ndarray]:  # fmt: skip
    """Small spheres where neither the sensor nor the map knows a surface, at the depth of the nearest known pixel.

    Args:
        color: uint8 [H, W, 3]; depth: [H, W], metres, 0 = none; alpha: rendered alpha [H, W].
    """
    stride = s.fill_stride
    grid = np.s_[stride // 2 :: stride, stride // 2 :: stride]
    rows, columns = np.nonzero((depth[grid] <= 0) & (alpha[grid] < 0.5))
    pixels = (rows * stride + stride // 2) * depth.shape[1] + columns * stride + stride // 2
    if not len(pixels) or not (depth > 0).any():
        pixels = pixels[:0]
        z = np.zeros(0, np.float32)
    else:
        absent = (depth <= 0).astype(np.uint8)
        _, label = cv2.distanceTransformWithLabels(absent, cv2.DIST_L2, 3, labelType=cv2.DIST_LABEL_PIXEL)
        depth_of_label = np.zeros(label.max() + 1, np.float32)
        depth_of_label[label[depth > 0]] = depth[depth > 0]
        z = depth_of_label[label.reshape(-1)[pixels]]
    positions = camera.rays().reshape(-1, 3)[pixels] * z[:, None]
    R, t = T_world_camera[:3, :3].astype(np.float32), T_world_camera[:3, 3].astype(np.float32)
    sigma = 2 * s.scale_pixels * stride * z * (2.0 / (camera.fx + camera.fy))
    smooth = cv2.blur(color, (stride, stride)).reshape(-1, 3)[pixels]
    return NewGaussians(
        means=positions @ R.T + t,
        quaternions=np.tile(np.array([1, 0, 0, 0], np.float32), (len(pixels), 1)),
        log_scales=np.repeat(np.log(sigma)[:, None], 3, 1).astype(np.float32),
        rgb=smooth.astype(np.float32) / 255,
        pixels=pixels,
    )
