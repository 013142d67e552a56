# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

import numpy as np
import torch

from ggslam.rendering.types import GaussianTensors
from ggslam.viewer.splats import most_visible


def some(count: int, seed: int = 0) -> GaussianTensors:
    draw = np.random.default_rng(seed)

    def tensor(*shape: int) -> torch.Tensor:
        return torch.from_numpy(draw.normal(size=shape).astype(np.float32))

    scales = tensor(count, 3) * 0.5 - 4
    return GaussianTensors(
        tensor(count, 3), tensor(count, 4), scales, tensor(count), tensor(count, 1, 3), tensor(count, 0)
    )


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
