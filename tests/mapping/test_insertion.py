# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

import numpy as np
import pytest

from ggslam.mapping.cpu.insertion import find_unexplained, grid_selection, new_gaussians, surface_normals
from ggslam.mapping.settings import InsertionSettings
from ggslam.scene.camera import Camera
from ggslam.scene.poses import quaternion_to_matrix, se3_exp

CAMERA = Camera(64, 48, 60.0, 60.0, 31.5, 23.5)


def plane_depth(normal: np.ndarray, distance: float) -> np.ndarray:
    """Depth of the plane n.x = -distance seen by CAMERA."""
    return (-distance / (CAMERA.rays() @ normal)).astype(np.float32)


def normals_of(depth: np.ndarray) -> np.ndarray:
    return surface_normals(depth, CAMERA, np.arange(depth.size)).reshape(*depth.shape, 3)


@pytest.mark.parametrize("tilt", [0.0, 0.5, 1.0])
def test_discs_lie_in_the_surface(tilt: float) -> None:
    normal = np.array([0.0, -np.sin(tilt), -np.cos(tilt)])
    depth = plane_depth(normal, 2.0)
    inner = normals_of(depth)[6:-6, 6:-6].reshape(-1, 3)
    assert np.abs(inner - normal).max() < 1e-3
    T = se3_exp(np.array([0.3, -0.2, 0.5, 0.2, 0.4, -0.3]))
    where = np.zeros((48, 64), bool)
    where[10:30, 10:40] = True
    s = InsertionSettings(flatness=0.2, adaptive_stride=False)
    new = new_gaussians(np.full((48, 64, 3), 128, np.uint8), depth, CAMERA, T, where, s)
    assert len(new.means) == where.sum()
    R = quaternion_to_matrix(new.quaternions.astype(float))
    smallest = np.argmin(new.log_scales, 1)
    axis = R[np.arange(len(R)), :, smallest]
    assert np.abs(np.abs(axis @ (T[:3, :3] @ normal)) - 1).max() < 1e-3
    # means lie on the plane, in world coordinates
    in_camera = (new.means - T[:3, 3]) @ T[:3, :3]
    assert np.abs(in_camera @ normal + 2.0).max() < 1e-5
    # the footprint is stretched along the slope and nowhere else
    scales = np.sort(np.exp(new.log_scales), 1)
    footprint = s.scale_pixels * in_camera[:, 2] / 60.0
    assert np.allclose(scales[:, 1], footprint, rtol=1e-4) and np.all(scales[:, 2] <= s.max_slope * footprint * 1.001)
    assert np.allclose(scales[:, 0], 0.2 * footprint, rtol=1e-4)


def test_no_gaussian_without_depth_and_none_at_jumps_has_a_false_normal() -> None:
    depth = np.full((48, 64), 1.0, np.float32)
    depth[:, 32:] = 3.0
    depth[:5] = 0
    normals = normals_of(depth)
    assert np.abs(normals[20, 31:33]).max() == 0  # at the jump
    new = new_gaussians(
        np.zeros((48, 64, 3), np.uint8), depth, CAMERA, np.eye(4), np.ones((48, 64), bool), InsertionSettings()
    )
    assert len(new.means) and np.isfinite(new.means).all() and np.isfinite(new.quaternions).all()
    assert np.all(new.pixels >= 5 * 64)


def test_unexplained_is_alpha_or_something_in_front() -> None:
    s = InsertionSettings(alpha_threshold=0.5, depth_tolerance_m=0.05, depth_tolerance_relative=0.03)
    depth = np.array([[1.0, 1.0, 1.0, 1.0]], np.float32)
    alpha = np.array([[0.2, 1.0, 1.0, 1.0]], np.float32)
    rendered = np.array([[1.0, 1.0, 1.2, 0.5]], np.float32)
    assert find_unexplained(depth, alpha, rendered, s).tolist() == [[True, False, True, False]]


def test_adaptive_stride_thins_flat_regions_only() -> None:
    rng = np.random.default_rng(0)
    color = np.full((48, 64, 3), 100, np.uint8)
    color[:, 32:] = rng.integers(0, 255, (48, 32, 3))
    chosen, stride = grid_selection(color, np.ones((48, 64), np.float32), InsertionSettings(adaptive_stride=True))
    assert chosen[8:40, 40:56].all() and (stride[8:40, 40:56] == 1).all()
    assert chosen[8:40, 4:24].mean() == 0.25 and (stride[8:40, 4:24] == 2).all()
