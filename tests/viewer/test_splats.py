# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

import numpy as np
import torch

from ggslam.rendering.types import GaussianTensors
from ggslam.scene.poses import quaternion_to_matrix
from ggslam.viewer.splats import most_visible, splats_of


def some(count: int, seed: int = 0) -> GaussianTensors:
    draw = np.random.default_rng(seed)

    def tensor(*shape: int) -> torch.Tensor:
        return torch.from_numpy(draw.normal(size=shape).astype(np.float32))

    scales = tensor(count, 3) * 0.5 - 4
    return GaussianTensors(
        tensor(count, 3), tensor(count, 4), scales, tensor(count), tensor(count, 1, 3), tensor(count, 0)
    )


def test_covariances_are_those_of_the_gaussians() -> None:
    gaussians = some(20)
    splats = splats_of(gaussians)
    for row in range(20):
        R = quaternion_to_matrix(gaussians.quaternions[row].double().numpy())
        expected = R @ np.diag(np.exp(2 * gaussians.log_scales[row].double().numpy())) @ R.T
        assert np.allclose(splats.covariances[row], expected, rtol=1e-4, atol=1e-9)
    assert np.allclose(splats.opacities, torch.sigmoid(gaussians.opacity_logits).numpy(), atol=1e-6)
    expected_colors = np.clip(0.5 + 0.28209479177387814 * gaussians.sh[:, 0].numpy(), 0, 1) * 255
    assert np.abs(splats.colors - expected_colors).max() <= 0.5 + 1e-3


def test_rows_are_taken_in_their_order() -> None:
    gaussians, index = some(9), np.array([7, 2, 5])
    assert np.array_equal(splats_of(gaussians, index).centers, splats_of(gaussians).centers[index])


def test_the_most_visible_are_kept() -> None:
    gaussians = some(4)
    gaussians.log_scales[:] = -4
    gaussians.opacity_logits[:] = torch.tensor([3.0, -20.0, -1.0, 3.0])
    gaussians.log_scales[3] = torch.tensor([-4.0, -9.0, -9.0])  # a needle covers little
    assert most_visible(gaussians, 10).tolist() == [0, 2, 3]
    assert most_visible(gaussians, 1).tolist() == [0]
    assert most_visible(gaussians, 2).tolist() == [0, 2]


def test_small_objects_keep_a_share() -> None:
    gaussians = some(40)
    gaussians.log_scales[:] = -2
    gaussians.log_scales[30:] = -6  # one object of ten small ones
    gaussians.opacity_logits[:] = 2
    owners = np.repeat([0, 7], [30, 10])
    assert (most_visible(gaussians, 16) < 30).all()
    kept = most_visible(gaussians, 16, owners)
    assert len(kept) == 16 and (owners[kept] == 7).sum() == 2
