# SPDX-License-Identifier: Apache-2.0
"""Noise that no single image shows is known from frames that do not lie on one another."""

from __future__ import annotations

import numpy as np
import pytest

from ggslam.tracking.points import FramePoints
from ggslam.tracking.residual_noise import EVERY, FEWEST, ResidualNoise
from ggslam.tracking.settings import DepthNoise


def observed(sigma: float, first: DepthNoise, frames: int = 2 * FEWEST) -> DepthNoise:
    """Noise after frames of points 2 m away whose distances to the surface have a standard deviation."""
    random, points = np.random.default_rng(0), np.zeros((2000, 3), np.float32)
    points[:, 2] = 2.0
    frame = FramePoints(points, points, np.zeros((2000, 6), np.float32), np.zeros((2000, 2), np.int32), points[:, 0])
    watch, noise = ResidualNoise(), first
    for _ in range(frames):
        squared = (sigma * random.standard_normal(2000)).astype(np.float32) ** 2
        squared[:200] = np.inf  # without a match
        noise = watch.observe(frame, squared, noise)
    return noise


def test_smooth_depth_that_errs_is_found_out() -> None:
    noise = observed(0.012, DepthNoise(0.00025, 0.0))
    assert noise.sigma(2.0) == pytest.approx(0.012, rel=0.05)
    assert noise.square > 0  # it grows with the distance


def test_an_honest_noise_is_kept() -> None:
    honest = DepthNoise(0.001, 0.002)
    assert observed(1.5 * honest.sigma(2.0), honest) is honest
    exact = DepthNoise(0.0002, 0.0)  # the surface's own noise does not count as the camera's
    assert observed(0.0008, exact) is exact


def test_a_few_frames_are_no_evidence() -> None:
    first = DepthNoise(0.00025, 0.0)
    assert observed(0.012, first, FEWEST - 1) is first
    watch = ResidualNoise()
    assert sum(watch.due() for _ in range(10 * EVERY)) == 10
