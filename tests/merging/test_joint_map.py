# SPDX-License-Identifier: Apache-2.0
"""Maps are moved as a whole, colours that depend on the view with them, and put behind one another."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from ggslam.merging.joint_map import append_map, move_map, with_channels
from ggslam.rendering.cpu import CpuRasterizer
from ggslam.scene.camera import Camera
from ggslam.scene.gaussian_map import GaussianMap
from ggslam.scene.poses import inverse, se3_exp

CAMERA = Camera(64, 48, 60.0, 60.0, 31.5, 23.5)
T_NEW_OLD = se3_exp(np.array([0.5, -0.3, 1.0, 0.3, -0.8, 0.5]))


def some_map(degree: int, seed: int = 0, count: int = 60) -> GaussianMap:
    """Gaussians in front of a camera at the origin, of two keyframes and of none."""
    random = torch.Generator().manual_seed(seed)
    out = GaussianMap(degree)
    means = torch.rand((count, 3), generator=random) * torch.tensor([2.0, 1.5, 1.0]) + torch.tensor([-1.0, -0.75, 2.0])
    quaternions = torch.randn((count, 4), generator=random)
    scales = torch.log(0.03 + 0.1 * torch.rand((count, 3), generator=random))
    out.insert(means, quaternions, scales, 1.0, torch.rand((count, 3), generator=random))
    out.sh[:, 1:] = 0.2 * torch.randn(out.sh[:, 1:].shape, generator=random)
    out.birth_keyframe[:] = torch.arange(count, dtype=torch.int32) % 3 - 1
    return out


def picture(gaussians: GaussianMap, T_world_camera: np.ndarray) -> np.ndarray:
    return CpuRasterizer().forward(gaussians, CAMERA, inverse(T_world_camera), features=False).image.numpy().copy()


@pytest.mark.parametrize("degree", [0, 1, 2, 3])
def test_a_moved_map_looks_the_same_from_a_moved_camera(degree: int) -> None:
    gaussians = some_map(degree)
    before = picture(gaussians, np.eye(4))
    move_map(gaussians, np.stack([T_NEW_OLD, T_NEW_OLD]))
    assert np.abs(picture(gaussians, T_NEW_OLD) - before).max() < 2e-3
    assert (gaussians.birth_keyframe.numpy()[:3] == [-1, 0, 1]).all()


def test_each_keyframe_takes_its_own_gaussians_along() -> None:
    gaussians = some_map(0)
    means = gaussians.means.numpy().copy()
    move_map(gaussians, np.stack([np.eye(4), T_NEW_OLD]))
    own = gaussians.birth_keyframe.numpy()
    assert np.array_equal(gaussians.means.numpy()[own < 1], means[own < 1])
    assert (np.abs(gaussians.means.numpy()[own == 1] - means[own == 1]).max(1) > 0.1).all()


def test_maps_of_different_channels_are_put_behind_one_another() -> None:
    plain, rich = some_map(0, seed=1), some_map(1, seed=2)
    whole = with_channels(plain, 1, 16)
    assert np.array_equal(picture(whole, np.eye(4)), picture(plain, np.eye(4)))
    rows = append_map(whole, with_channels(rich, 1, 16), first_keyframe=10)
    assert len(whole) == 120 and rows == slice(60, 120)
    assert sorted(set(whole.birth_keyframe.numpy()[rows].tolist())) == [-1, 10, 11]
    assert with_channels(whole, 1, 16) is whole
