# SPDX-License-Identifier: Apache-2.0
"""Something near that moves does not take the camera along, though its points are the most accurate ones."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from ggslam.native.loader import NativeContext
from ggslam.scene.frame import Frame
from ggslam.scene.poses import inverse, separation
from ggslam.tracking.gicp import align
from ggslam.tracking.gicp_tracker import GicpTracker
from ggslam.tracking.motion import CameraMotion, MotionTuning
from ggslam.tracking.points import extract_points, grid_stride, largest_weight
from ggslam.tracking.settings import (
    AlignSettings,
    DepthNoise,
    PointSettings,
    RecoverySettings,
    TargetSettings,
    TrackerSettings,
)
from ggslam.tracking.surface import MeasuredSurface

NOISE = DepthNoise(constant=0.0005, square=0.0019)
WARY = replace(PointSettings(), near_weight=RecoverySettings().near_weight)


def with_passer_by(frame: Frame, first_column: int, share: int = 8) -> np.ndarray:
    """The frame's depth, float32 [H, W], where something round as wide as one in `share` stands before the camera."""
    depth = frame.depth.copy()
    width = depth.shape[1] // share
    across = np.linspace(-1, 1, width)
    folds = 0.05 * np.sin(np.arange(depth.shape[0]) / 9)[:, None]
    depth[:, first_column : first_column + width] = 0.6 - 0.1 * np.sqrt(1 - 0.9 * across**2) + folds
    return depth


def error_m(frames: list[Frame], settings: PointSettings, share: int) -> float:
    """How far off the camera is found after what is near went on by 8 pixels."""
    before, after = frames[0], frames[1]
    assert before.T_world_camera is not None and after.T_world_camera is not None
    context, camera = NativeContext(2), before.camera
    surface = MeasuredSurface(TargetSettings(), context)
    points = extract_points(with_passer_by(before, 40, share), camera, settings, NOISE, context)
    target = surface.add(points, before.T_world_camera)
    points = extract_points(with_passer_by(after, 48, share), camera, settings, NOISE, context)
    found = align(points, target, after.T_world_camera, AlignSettings(), NOISE, context)
    return separation(inverse(found.T_world_camera), inverse(after.T_world_camera))[0]


@pytest.mark.parametrize("share", [6, 8, 12])
def test_something_near_that_moves_does_not_take_the_camera_along(frames: list[Frame], share: int) -> None:
    bounded, unbounded = error_m(frames, WARY, share), error_m(frames, PointSettings(), share)
    assert bounded < 0.007
    assert unbounded > 4 * bounded


def test_near_points_weigh_little_more_than_those_at_the_median_depth(frames: list[Frame]) -> None:
    frame = frames[0]
    depth = with_passer_by(frame, 40)
    context = NativeContext(1)
    free = extract_points(depth, frame.camera, PointSettings(), NOISE, context)
    bound = extract_points(depth, frame.camera, WARY, NOISE, context)
    stride = grid_stride(int(np.count_nonzero(depth > 0)), PointSettings().count)
    limit = largest_weight(depth, WARY, NOISE, stride)
    assert free.weights.max() > 10 * limit
    assert bound.weights.max() == pytest.approx(limit)
    far = free.weights < 0.9 * limit
    assert far.any() and np.array_equal(bound.weights[far], free.weights[far])


def test_a_frame_without_depth_has_a_bound_all_the_same() -> None:
    assert largest_weight(np.zeros((8, 8), np.float32), PointSettings(), NOISE, 2) == PointSettings().near_weight


def test_a_wary_tracker_bounds_near_points_for_a_while(frames: list[Frame]) -> None:
    settings = TrackerSettings(noise=NOISE, recovery=RecoverySettings(wary_frames=3))
    context, camera = NativeContext(2), frames[0].camera
    tracker = GicpTracker(camera, settings, context, frames[0].T_world_camera)
    surface = MeasuredSurface(settings.target, context)
    first = tracker.track(frames[0])
    tracker.set_target(surface.add(first.points.read(), first.T_world_camera))
    tracker.expect_motion()
    bounded = []
    for frame in frames[1:6]:
        depth = with_passer_by(frame, 40)
        weights = tracker.track(replace(frame, depth=depth)).points.read().weights
        bounded.append(bool(weights.max() < 2 * np.median(weights)))
    assert bounded == [True, True, True, False, False]


def test_images_that_suddenly_agree_far_less_are_noticed() -> None:
    motion = CameraMotion(np.eye(4))
    for _ in range(MotionTuning.frames):
        assert not motion.is_sudden(0.5)  # what is usual is not known yet
        motion.note_greys(0.008)
    assert motion.is_sudden(0.03) and not motion.is_sudden(0.015)
    for _ in range(MotionTuning.frames):
        motion.note_greys(0.03)
    assert not motion.is_sudden(0.04)  # a dark room is noisy all the time
