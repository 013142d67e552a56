# SPDX-License-Identifier: Apache-2.0
"""Pictures by the rules of 3D Gaussian Splatting from ggslam's rasterizer: fast, and near to the tests' own renderer.

It differs in two rules: it draws the Gaussian that makes a pixel opaque, and lets one cover 0.999 of a pixel, not 0.99.
"""

from __future__ import annotations

import numpy as np
import torch
from splat_maps import C0, Splats

from ggslam.rendering.cpu import CpuRasterizer
from ggslam.rendering.types import GaussianTensors
from ggslam.scene.camera import Camera

NEAR_M, LOW_PASS_PX2 = 0.2, 0.3


def standard_picture(splats: Splats, camera: Camera, T_camera_world: np.ndarray) -> np.ndarray:
    """What a viewer shows of some Gaussians, float32 [H, W, 3]: 0.3 px^2 of low-pass, nothing nearer than 0.2 m, no
    colours below 0."""
    R, t = T_camera_world[:3, :3], T_camera_world[:3, 3]
    colors = np.maximum(splats.colors(splats.means + R.T @ t), 0)  # the camera's centre is -R^T t
    opacities = splats.opacities.astype(float).clip(1e-12, 1 - 1e-12)
    columns = (splats.means, splats.quaternions, splats.log_scales.clip(-23, 10), np.log(opacities / (1 - opacities)),
               (colors[:, None] - 0.5) / C0, np.empty((len(colors), 0)))  # fmt: skip
    tensors = (torch.from_numpy(np.array(column, np.float32)) for column in columns)  # copies: files are read-only
    rasterizer = CpuRasterizer(near_plane=NEAR_M, low_pass=LOW_PASS_PX2)
    image = rasterizer.forward(GaussianTensors(*tensors), camera, T_camera_world).image
    return image.numpy().transpose(1, 2, 0).copy()
