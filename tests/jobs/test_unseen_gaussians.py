# SPDX-License-Identifier: Apache-2.0
"""What keyframes do not see is not changed by training on them."""

from __future__ import annotations

import numpy as np
import torch

from ggslam.jobs.merge.unseen_gaussians import UnseenGaussians, find_seen
from ggslam.mapping.keyframe import Keyframe, make_keyframe
from ggslam.scene.camera import Camera
from ggslam.scene.frame import Frame
from ggslam.scene.gaussian_map import GaussianMap

CAMERA = Camera(40, 30, 30.0, 30.0, 19.5, 14.5)


def look(depth: np.ndarray) -> Keyframe:
    """From the origin along z."""
    color = np.full((30, 40, 3), 128, np.uint8)
    return make_keyframe(
        0,
        Frame(index=0, source_index=0, timestamp=0.0, color=color, depth=depth.astype(np.float32), camera=CAMERA),
        np.eye(4),
    )


def map_at(points: list[list[float]]) -> GaussianMap:
    gaussians, count = GaussianMap(0, 4), len(points)
    gaussians.insert(
        torch.tensor(points), torch.tensor([[1.0, 0, 0, 0]]).repeat(count, 1), torch.full((count, 3), -3.0),
        torch.zeros(count), torch.full((count, 3), 0.5),
    )  # fmt: skip
    return gaussians


def test_what_is_hidden_or_outside_is_not_seen() -> None:
    depth = np.full((30, 40), 1.0)
    depth[:, :10] = 0
    gaussians = map_at([[0, 0, 1.0], [0, 0, 1.02], [0, 0, 1.2], [2, 0, 1.0], [0, 0, -1.0], [-0.6, 0, 1.2]])
    assert find_seen(gaussians, [look(depth)], 0.01).tolist() == [True, True, False, False, False, True]
    assert find_seen(gaussians, [look(depth)], 0.1)[2], "noise may be as large"
    nearer, farther = look(depth), look(3 * depth)
    assert find_seen(gaussians, [nearer, farther], 0.01)[2], "another keyframe sees it"


def test_what_is_not_seen_comes_back_and_the_rest_stays_as_trained() -> None:
    gaussians = map_at([[0, 0, 1.0], [0, 0, 1.5]])
    unseen = UnseenGaussians(gaussians, [look(np.full((30, 40), 1.0))], 0.01)
    names = ("means", "quaternions", "log_scales", "opacity_logits", "sh", "features")
    before = {name: getattr(gaussians, name).clone() for name in names}
    for name in names:
        getattr(gaussians, name)[:] += 1
    unseen.restore()
    assert len(unseen) == 1
    for name in names:
        now = getattr(gaussians, name)
        assert torch.equal(now[1], before[name][1]) and torch.equal(now[0], before[name][0] + 1)
