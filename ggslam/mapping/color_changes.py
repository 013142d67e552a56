# SPDX-License-Identifier: Apache-2.0
"""Changes all colours of a map at once: to another exposure, or to those of a better picture."""

from __future__ import annotations

import numpy as np
import torch

from ggslam.mapping.keyframe import Keyframe
from ggslam.scene.gaussian_map import SH_C0, GaussianMap, rgb_to_sh
from ggslam.scene.poses import transform_points
from ggslam.system.tuning import Tuning


class ColorChangeTuning(Tuning):
    """Which Gaussians take a new colour."""

    max_depth_error = 0.05
    """Largest distance from the measured depth, as a share of it, at which a Gaussian takes the new colour."""


def scale_colors(gaussians: GaussianMap, gain: np.ndarray) -> None:
    """Multiplies the colours by a gain for each channel [3], so that the map has another exposure.

    Adam's moments follow: gradients with respect to a colour that is `gain` times as bright are that much smaller.
    """
    factor = torch.as_tensor(gain, dtype=torch.float32).to(gaussians.device)
    gaussians.sh.mul_(factor)
    gaussians.sh[:, 0].add_((factor - 1) * (0.5 / SH_C0))  # colour = 0.5 + SH_C0 * sh
    if gaussians.with_moments:
        first, second = gaussians.moments["sh"]
        first.div_(factor)
        second.div_(factor**2)
    gaussians.version += 1


def take_colors(gaussians: GaussianMap, keyframe: Keyframe) -> None:
    """Gives Gaussians that a keyframe sees, at the depth it measured, the colours it sees there; Adam begins anew with
    their colours."""
    points = transform_points(gaussians.means.detach().cpu().numpy().astype(np.float64), keyframe.T_camera_world)
    camera, depth = keyframe.camera, keyframe.depth_m()
    z = np.maximum(points[:, 2], 1e-6)
    u = np.rint(camera.fx * points[:, 0] / z + camera.cx)
    v = np.rint(camera.fy * points[:, 1] / z + camera.cy)
    inside = (points[:, 2] > 0) & (u >= 0) & (v >= 0) & (u < camera.width) & (v < camera.height)
    rows = np.flatnonzero(inside)
    u, v = u[rows].astype(np.int64), v[rows].astype(np.int64)
    measured = depth[v, u]
    near = np.abs(points[rows, 2] - measured) < ColorChangeTuning.max_depth_error * measured
    rows, colors = rows[near], keyframe.color[v[near], u[near]].astype(np.float32) / 255
    index = torch.from_numpy(rows).to(gaussians.device)
    gaussians.sh[index] = 0
    gaussians.sh[index, 0] = rgb_to_sh(torch.from_numpy(colors)).to(gaussians.device)
    if gaussians.with_moments:
        for moments in gaussians.moments["sh"]:
            moments[index] = 0
    gaussians.version += 1
