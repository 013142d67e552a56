# SPDX-License-Identifier: Apache-2.0
"""Insertion in numpy and OpenCV, step by step: what the compiled core's is held against."""

from __future__ import annotations

import cv2
import numpy as np

from ggslam.mapping.new_gaussians import NewGaussians
from ggslam.mapping.settings import InsertionSettings
from ggslam.scene.camera import Camera
from ggslam.scene.poses import matrix_to_quaternion


def grid_selection(color: np.ndarray, depth: np.ndarray, s: InsertionSettings) -> tuple[np.ndarray, np.ndarray]:
    """Pixels of the sampling grid, bool [H, W], and the grid's stride at each, int32 [H, W].

    The stride is 1, or with `adaptive_stride` 2 where neither colour nor depth has an edge: a wall needs fewer
    Gaussians than a bookshelf.
    """
    height, width = depth.shape
    if not s.adaptive_stride:
        return np.ones((height, width), bool), np.ones((height, width), np.int32)
    grey = cv2.cvtColor(color, cv2.COLOR_RGB2GRAY).astype(np.float32)
    texture = np.abs(cv2.Sobel(grey, cv2.CV_32F, 1, 0)) + np.abs(cv2.Sobel(grey, cv2.CV_32F, 0, 1))
    steps = np.abs(cv2.Sobel(depth, cv2.CV_32F, 1, 0)) + np.abs(cv2.Sobel(depth, cv2.CV_32F, 0, 1))
    edge = np.where(steps > 0.3 * depth, 1e3, texture)
    smooth = cv2.dilate(edge, np.ones((3, 3), np.uint8)) < s.texture_threshold
    stride = np.where(smooth, 2, 1).astype(np.int32)
    rows, columns = np.mgrid[0:height, 0:width]
    return (rows % stride == stride // 2) & (columns % stride == stride // 2), stride


def surface_normals(depth: np.ndarray, camera: Camera, pixels: np.ndarray) -> np.ndarray:
    """Unit normals towards the camera, float32 [M, 3], from central differences; zero where there is none.

    Args:
        depth: [H, W], metres. A pixel whose 5x5 surroundings have a hole or a jump gets no normal.
        camera: its intrinsics.
        pixels: flat indices of the pixels wanted, int64 [M].
    """
    height, width = depth.shape
    smooth = cv2.boxFilter(camera.back_project(depth), -1, (3, 3), borderType=cv2.BORDER_REPLICATE).reshape(-1, 3)
    good = _is_smooth(depth).reshape(-1)[pixels]
    row, column = np.divmod(pixels, width)
    good &= (row > 0) & (row < height - 1) & (column > 0) & (column < width - 1)
    normals = np.zeros((len(pixels), 3), np.float32)
    inner = pixels[good]
    du, dv = smooth[inner + 1] - smooth[inner - 1], smooth[inner + width] - smooth[inner - width]
    normals[good] = _unit(np.cross(dv, du))  # rows run down and columns right, so this order faces the camera
    return normals


def _is_smooth(depth: np.ndarray) -> np.ndarray:
    """Whether depth is known and without a jump in the 5x5 pixels around each pixel, bool [H, W].

    A plane is linear in inverse depth however steeply it is seen, so a jump shows in the second difference.
    """
    inverse = 1 / np.maximum(depth, 1e-3)
    bend = np.zeros_like(depth)
    bend[:, 1:-1] = np.abs(inverse[:, 2:] + inverse[:, :-2] - 2 * inverse[:, 1:-1])
    bend[1:-1] = np.maximum(bend[1:-1], np.abs(inverse[2:] + inverse[:-2] - 2 * inverse[1:-1]))
    broken = (bend > 0.03 * inverse) | (depth <= 0)
    return cv2.dilate(broken.astype(np.uint8), np.ones((5, 5), np.uint8)) == 0


def new_gaussians(
    color: np.ndarray, depth: np.ndarray, camera: Camera, T_world_camera: np.ndarray, where: np.ndarray,
    s: InsertionSettings,
) -> NewGaussians[np.ndarray]:  # fmt: skip
    """Discs on the measured surface, one per selected pixel (bool [H, W]) with usable depth.

    Each disc covers its pixel's footprint: sigma = scale_pixels * stride * z / f across the viewing direction, longer
    by 1 / cos along the slope of the surface, thin along the normal. Without a normal it is a small sphere.
    """
    on_grid, stride = grid_selection(color, depth, s)
    usable = (depth > 0.05) & (depth < s.max_depth_m)
    pixels = np.flatnonzero(where & on_grid & usable)
    positions = camera.rays().reshape(-1, 3)[pixels] * depth.reshape(-1)[pixels, None]
    normals = surface_normals(depth, camera, pixels)
    footprint = s.scale_pixels * stride.reshape(-1)[pixels] * positions[:, 2] * (2.0 / (camera.fx + camera.fy))
    log_scales, axes = _disc_shape(positions, normals, footprint, s)
    R = T_world_camera[:3, :3].astype(np.float32)
    return NewGaussians(
        means=positions @ R.T + T_world_camera[:3, 3].astype(np.float32),
        quaternions=matrix_to_quaternion(np.einsum("ij,njk->nik", R, axes)).astype(np.float32),
        log_scales=log_scales,
        rgb=color.reshape(-1, 3)[pixels].astype(np.float32) / 255,
        pixels=pixels,
    )


def _disc_shape(
    positions: np.ndarray, normals: np.ndarray, footprint: np.ndarray, s: InsertionSettings
) -> tuple[np.ndarray, np.ndarray]:
    """Log standard deviations [M, 3] and axes (columns of [M, 3, 3]): slope direction, across it, normal."""
    rays = -positions / np.linalg.norm(positions, axis=1, keepdims=True)
    has_normal = np.einsum("ni,ni->n", normals, normals) > 0.5
    n = np.where(has_normal[:, None], normals, rays)
    cosine = np.clip(np.einsum("ni,ni->n", n, rays), 1e-3, 1)
    across = np.cross(n, rays)
    length = np.linalg.norm(across, axis=1, keepdims=True)
    helper = np.where(np.abs(n[:, :1]) < 0.9, [[1.0, 0, 0]], [[0, 1.0, 0]]).astype(np.float32)
    across = np.where(length > 1e-4, across / np.maximum(length, 1e-9), _unit(np.cross(n, helper)))
    along = np.cross(across, n)
    stretch = np.where(has_normal, np.minimum(1 / cosine, s.max_slope), 1)
    thin = np.where(has_normal, s.flatness, 1)
    scales = footprint[:, None] * np.stack([stretch, np.ones_like(stretch), thin], 1)
    return np.log(scales).astype(np.float32), np.stack([along, across, n], -1).astype(np.float32)


def _unit(v: np.ndarray) -> np.ndarray:
    return v / np.maximum(np.linalg.norm(v, axis=-1, keepdims=True), 1e-12)
