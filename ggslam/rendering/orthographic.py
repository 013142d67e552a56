# SPDX-License-Identifier: Apache-2.0
"""Parallel projection by any pinhole renderer.

A pinhole projects (x, y, z) to f x / z. Gaussians moved to (x z / K, y z / K, z) and scaled by z / K are projected to
f x / K, whatever their depth: with f = K * scale the picture is the orthographic one. EWA's Jacobian
f / z [1 0 -x/K; 0 1 -y/K] leaves of the scaled covariance scale^2 [1 0 -x/K; 0 1 -y/K] Sigma [...]^T, so the covariance
is that of a parallel projection up to a shear of x / K, 1e-5 per metre from the axis. Order and near plane are
those of z. All of it is differentiable with respect to the Gaussians.
"""

from __future__ import annotations

from typing import Final

import numpy as np
import torch

from ggslam.rendering.reference import view_colours
from ggslam.rendering.types import Gaussians, GaussianTensors, active_coefficients, check_gaussians
from ggslam.scene.camera import Camera
from ggslam.scene.camera_models import OrthographicCamera
from ggslam.scene.gaussian_map import rgb_to_sh
from ggslam.scene.poses import left_multiplication, matrix_to_quaternion

NARROWING: Final = 1e5
"""K: 1 m beside the axis is seen under 1e-5 radians."""
STRETCH: Final = 1e3
"""Depths are enlarged by it, so that scales stay in the range that is drawn (1e-10 m)."""


def pinhole_like(camera: OrthographicCamera) -> Camera:
    """The pinhole camera that `narrow_gaussians` Gaussians are rendered with, from the world's origin along z."""
    focal = camera.scale * NARROWING
    return Camera(camera.width, camera.height, focal, focal, camera.cx, camera.cy)


def narrow_gaussians(gaussians: Gaussians, T_camera_world: np.ndarray, active_sh_degree: int | None) -> GaussianTensors:
    """Gaussians whose pinhole picture by `pinhole_like` is the orthographic picture of `gaussians`; depths are
    `STRETCH` times as large.

    Args:
        gaussians: on any device.
        T_camera_world: float64 [4, 4], world to camera.
        active_sh_degree: see `ggslam.render`; every Gaussian is seen from the same direction, the camera's.
    """
    check_gaussians(gaussians)
    means = gaussians.means
    T = torch.as_tensor(np.asarray(T_camera_world, np.float64)).to(means)
    x, y, z = (means @ T[:3, :3].T + T[:3, 3]).unbind(-1)
    # Gaussians in the camera's plane or behind it are left out by the near plane, whatever their size.
    ahead = z.clamp_min(1e-6)
    widening = STRETCH * ahead / NARROWING
    turn = left_multiplication(matrix_to_quaternion(np.asarray(T_camera_world, np.float64)[:3, :3]))
    return GaussianTensors(
        means=torch.stack([x * widening, y * widening, z * STRETCH], -1),
        quaternions=gaussians.quaternions @ torch.as_tensor(turn).to(means).T,
        log_scales=gaussians.log_scales + torch.log(widening)[:, None],
        opacity_logits=gaussians.opacity_logits,
        sh=_colors_along(gaussians, T, active_sh_degree)[:, None],
        features=gaussians.features,
    )


def _colors_along(gaussians: Gaussians, T: torch.Tensor, active_sh_degree: int | None) -> torch.Tensor:
    """Coefficients [N, 3] of degree 0 of the colours seen along the camera's axis."""
    sh = gaussians.sh[:, : active_coefficients(gaussians, active_sh_degree)]
    # Directions are those from the camera to the means: at (0, 0, 1) in the camera frame, all are the axis.
    still = torch.eye(4).to(T)
    axis = T[2, :3].expand(len(sh), 3)
    return rgb_to_sh(view_colours(sh, axis, still))
