# SPDX-License-Identifier: Apache-2.0
"""Noise that no single image shows is known from frames that do not lie on one another."""

from __future__ import annotations

import numpy as np
import pytest

from ggslam.scene.camera import Camera
from ggslam.tracking.gicp_tracker import GicpTracker
from ggslam.tracking.points import FramePoints
from ggslam.tracking.residual_noise import ResidualNoise, ResidualNoiseTuning
from ggslam.tracking.settings import DepthNoise, TrackerSettings


def observed(
    sigma: float,
    first: DepthNoise,
    frames: int = 2 * ResidualNoiseTuning.min_measurements,
    depth: float = 2.0,
    watch: ResidualNoise | None = None,
) -> DepthNoise:
    """Noise after frames of points so far away whose distances to the surface have a standard deviation."""
    random, points = np.random.default_rng(0), np.zeros((2000, 3), np.float32)
    points[:, 2] = depth
    frame = FramePoints(points, points, np.zeros((2000, 6), np.float32), np.zeros((2000, 2), np.int32), points[:, 0])
    watch, noise = watch or ResidualNoise(), first
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


def test_near_surfaces_are_gathered_in_smaller_voxels() -> None:
    smooth = DepthNoise(0.0002, 0.0)
    assert observed(0.0016, smooth, depth=0.5).sigma(0.5) == pytest.approx(0.0016, rel=0.05)
    assert observed(0.0016, smooth) is smooth
    assert observed(0.0003, smooth, depth=0.5) is smooth


@pytest.mark.parametrize(("sigma", "mode"), [(None, "always"), (0.0003, "degenerate"), (0.0016, "always")])
def test_grey_values_are_compared_until_smooth_depth_has_shown_its_error(sigma: float | None, mode: str) -> None:
    tracker = GicpTracker(Camera(80, 60, 70.0, 70.0, 39.5, 29.5))
    tracker.noise = DepthNoise(0.0002, 0.0)
    if sigma is not None:
        observed(sigma, tracker.noise, watch=tracker.state.residuals)
    assert tracker._mode(2.0) == mode
    told = TrackerSettings(noise=DepthNoise(0.0002, 0.0))  # whoever gives the noise is believed
    known = GicpTracker(Camera(80, 60, 70.0, 70.0, 39.5, 29.5), told)
    known.noise = told.noise
    assert known._mode(2.0) == "degenerate"


def test_a_few_frames_are_no_evidence() -> None:
    first = DepthNoise(0.00025, 0.0)
    assert observed(0.012, first, ResidualNoiseTuning.min_measurements - 1) is first
    watch = ResidualNoise()
    assert sum(watch.due() for _ in range(10 * ResidualNoiseTuning.early_stride)) == 10
