# SPDX-License-Identifier: Apache-2.0
"""What left a room leaves the map, and what stands before or behind it does not."""

from __future__ import annotations

import numpy as np
import torch

from ggslam.mapping.keyframe import make_keyframe
from ggslam.mapping.pruning import drop_before
from ggslam.scene.camera import Camera
from ggslam.scene.frame import Frame
from ggslam.scene.gaussian_map import GaussianMap

CAMERA = Camera(80, 60, 70.0, 70.0, 39.5, 29.5)


def test_only_what_is_as_far_as_what_is_gone_goes() -> None:
    gaussians, depths = GaussianMap(), (1.4, 2.0, 2.5)
    for z in depths:
        x, y = np.meshgrid(np.linspace(-0.1, 0.1, 9), np.linspace(-0.1, 0.1, 9))
        means = torch.tensor(np.stack([x.ravel() * z, y.ravel() * z, np.full(81, z)], 1), dtype=torch.float32)
        turned = torch.tensor([[1.0, 0, 0, 0]]).repeat(81, 1)
        gaussians.insert(
            means, turned, torch.full((81, 3), -5.0), torch.zeros(81), torch.full((81, 3), 0.5), birth_keyframe=0
        )
    depth = np.full((60, 80), 2.0, np.float32)
    keyframe = make_keyframe(0, Frame(0, 0, 0.0, np.zeros((60, 80, 3), np.uint8), depth, CAMERA), np.eye(4))
    gone = np.zeros((60, 80), bool)
    gone[20:40, 30:50] = True
    assert drop_before(gaussians, np.array([0]), [(keyframe, gone, gone)]) == 81
    assert sorted(set(gaussians.means[:, 2].tolist())) == [np.float32(1.4), 2.5]
    assert drop_before(gaussians, np.array([1]), [(keyframe, gone, gone)]) == 0
