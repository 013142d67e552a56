# SPDX-License-Identifier: Apache-2.0
"""How much of a view two maps show alike, against walls of which it is known."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from ggslam.merging.coverage import Coverage, PlacedRun
from ggslam.merging.settings import SeamSettings
from ggslam.native.loader import NativeContext
from ggslam.scene.camera import Camera
from ggslam.scene.gaussian_map import GaussianMap

CAMERA = Camera(160, 120, 140.0, 140.0, 79.5, 59.5)
SETTINGS = SeamSettings(tolerance_m=0.05, tolerance_relative=0.03)


def wall(z: float, left: float = -2.0) -> GaussianMap:
    """An opaque wall from x = `left` to 2 m, z metres before the camera, which sees 1.14 m to either side at 2 m."""
    x, y = np.meshgrid(np.arange(left, 2.0, 0.02), np.arange(-1.2, 1.2, 0.02))
    means = torch.tensor(np.stack([x.ravel(), y.ravel(), np.full(x.size, z)], 1), dtype=torch.float32)
    gaussians, count = GaussianMap(), len(means)
    turned, scales = torch.tensor([[1.0, 0, 0, 0]]).repeat(count, 1), torch.tensor([[0.02, 0.02, 0.002]]).log()
    gaussians.insert(
        means, turned, scales.repeat(count, 1), torch.full((count,), 4.0), torch.full((count, 3), 0.5),
        birth_keyframe=0,
    )  # fmt: skip
    return gaussians


def share(own: GaussianMap, base: GaussianMap) -> float:
    run = PlacedRun(own, [CAMERA], np.eye(4)[None])
    return float(Coverage(SETTINGS, NativeContext(1)).shared_views(base, run)[0])


@pytest.mark.parametrize(("z", "expected"), [(2.0, 1.0), (2.055, 1.0), (1.945, 1.0), (2.07, 0.0), (1.93, 0.0)])
def test_walls_are_one_within_the_tolerance(z: float, expected: float) -> None:
    assert share(wall(2.0), wall(z)) == pytest.approx(expected, abs=0.01)


@pytest.mark.parametrize("left", [0.0, 0.6, -0.6])
def test_what_only_one_map_shows_is_not_shared(left: float) -> None:
    expected = (160 - (left / 2.0 * 140 + 79.5 + 0.5)) / 160
    assert share(wall(2.0), wall(2.0, left)) == pytest.approx(expected, abs=0.02)
    assert share(wall(2.0, left), wall(2.0)) == pytest.approx(expected, abs=0.02)


def test_nothing_is_shared_with_an_empty_map() -> None:
    assert share(wall(2.0), GaussianMap()) == 0 and share(GaussianMap(), wall(2.0)) == 0
