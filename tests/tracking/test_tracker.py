# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

from dataclasses import replace
from typing import Any

import cv2
import numpy as np
import pytest

from ggslam.features.orb import FeatureSettings, FeatureView, pose_from_matches
from ggslam.native.loader import NativeContext
from ggslam.scene.camera import Camera
from ggslam.scene.frame import Frame
from ggslam.scene.poses import inverse, se3_exp, se3_log
from ggslam.tracking.engine import CpuTrackingEngine
from ggslam.tracking.gicp_tracker import GicpTracker
from ggslam.tracking.noise import estimate_noise
from ggslam.tracking.settings import DepthNoise, PhotometricSettings, RecoverySettings, TrackerSettings
from ggslam.tracking.shared_features import SharedFeatures
from ggslam.tracking.surface import MeasuredSurface
from ggslam.tracking.tracker import TrackingStatus

CAMERA = Camera(320, 240, 260.0, 260.0, 159.5, 119.5)
STILL = se3_exp(np.zeros(6))


def picture(size: int = 1024) -> np.ndarray:
    """A square of blobs, strokes and dots that can be told apart, float32 [size, size]."""
    rng = np.random.default_rng(4)
    image = np.full((size, size), 0.5, np.float32)
    for sigma, contrast in ((3, 1.0), (8, 1.2), (25, 1.5)):
        noise = cv2.GaussianBlur(rng.normal(size=(size, size)).astype(np.float32), (0, 0), sigma)
        image += contrast * 0.12 * noise / noise.std()
    return np.clip(image, 0, 1)


PICTURE = picture()


def wall_view(T: np.ndarray, corner: bool, gain: float = 1.0) -> Frame:
    """A wall z = 2 with the picture on it (4 m wide); with `corner` also walls x = 0.6 and y = 0.5."""
    rays = CAMERA.rays().astype(float) @ T[:3, :3].T
    origin = T[:3, 3]
    planes = np.array([0.6, 0.5, 2.0] if corner else [np.inf, np.inf, 2.0])
    depths = (planes - origin) / np.where(rays > 1e-9, rays, 1e-9)
    depth = depths.min(-1)
    hit = origin + rays * depth[..., None]
    u = (hit[..., 0] + hit[..., 2] - 2) * 256 + 512
    v = (hit[..., 1] + hit[..., 2] - 2) * 256 + 512
    grey = cv2.remap(PICTURE, u.astype(np.float32), v.astype(np.float32), cv2.INTER_LINEAR)
    color = np.repeat(np.uint8(np.clip(grey * gain, 0, 1) * 255)[..., None], 3, 2)
    return Frame(0, 0, 0.0, color, depth.astype(np.float32), CAMERA)


def run(poses: list[np.ndarray], corner: bool, settings: TrackerSettings, gain: float = 1.0) -> list:
    """Tracks the views; the first is the only keyframe."""
    context = NativeContext(2)
    tracker, surface = GicpTracker(CAMERA, settings, context, poses[0]), MeasuredSurface(settings.target, context)
    results = []
    for T in poses:
        results.append(tracker.track(wall_view(T, corner, gain if results else 1.0)))
        if len(results) == 1:
            tracker.set_target(surface.add(results[0].points, poses[0]))
    return results


def error_m(found: np.ndarray, truth: np.ndarray) -> float:
    return float(np.linalg.norm(se3_log(inverse(truth) @ found)[:3]))


def test_a_slow_motion_is_followed() -> None:
    poses = [se3_exp(i * np.array([0.01, -0.005, 0.004, 0.005, 0.008, 0.0])) for i in range(8)]
    results = run(poses, True, TrackerSettings())
    assert results[0].status is TrackingStatus.FIRST
    for result, truth in zip(results[1:], poses[1:], strict=True):
        assert result.status is TrackingStatus.OK
        assert error_m(result.T_world_camera, truth) < 2e-3


def test_a_frame_is_looked_for_where_the_motion_leads(monkeypatch: pytest.MonkeyPatch) -> None:
    """The camera's motion is taken in its own axes, which are turned against the world's here."""
    T_world_wall = se3_exp(np.array([0.3, -0.2, 0.1, 0.5, 1.2, -0.4]))
    poses = [T_world_wall @ se3_exp(i * np.array([0.03, -0.01, 0.02, 0.01, 0.02, 0.0])) for i in range(3)]
    starts, align = [], CpuTrackingEngine.align

    def watched(engine: CpuTrackingEngine, points: Any, target: Any, guess: np.ndarray, *more: Any) -> Any:
        starts.append(guess)
        return align(engine, points, target, guess, *more)

    monkeypatch.setattr(CpuTrackingEngine, "align", watched)
    tracker = GicpTracker(CAMERA, TrackerSettings(), NativeContext(2), poses[0])
    surface = MeasuredSurface(TrackerSettings().target, tracker.context)
    for T in poses:
        starts.clear()
        result = tracker.track(wall_view(inverse(T_world_wall) @ T, True))
        if tracker.target is None:
            tracker.set_target(surface.add(result.points, T))
    assert error_m(starts[0], poses[2]) < 3e-3


@pytest.mark.parametrize("gain", [1.0, 0.8])
def test_grey_values_hold_the_camera_at_a_bare_wall(gain: float) -> None:
    poses = [se3_exp(i * np.array([0.012, 0.006, 0, 0, 0, 0.01])) for i in range(6)]
    blind = TrackerSettings(photometric=PhotometricSettings(mode="never"))
    seeing = TrackerSettings(photometric=PhotometricSettings(mode="degenerate"))
    lost_way = run(poses, False, blind, gain)[-1]
    kept_way = run(poses, False, seeing, gain)[-1]
    assert lost_way.status is TrackingStatus.DEGENERATE
    assert kept_way.gicp.photometric_share > 0.7
    assert error_m(lost_way.T_world_camera, poses[-1]) > 0.02
    assert error_m(kept_way.T_world_camera, poses[-1]) < 0.004


def test_a_jump_is_recovered_by_features() -> None:
    poses = [STILL, STILL, se3_exp(np.array([0.1, 0.05, -0.2, 0.0, -0.1, 0.7]))]
    settings = TrackerSettings(recovery=RecoverySettings(convincing_overlap=0.8))
    result = run(poses, True, settings)[-1]
    assert result.status is TrackingStatus.RECOVERED
    assert "features" in result.reason
    assert error_m(result.T_world_camera, poses[-1]) < 5e-3


def test_feature_matches_give_the_pose() -> None:
    truth = se3_exp(np.array([0.2, -0.1, 0.1, 0.03, 0.1, -0.1]))
    one, two = wall_view(STILL, True), wall_view(truth, True)
    found = pose_from_matches(
        FeatureView(two.color, two.depth, np.eye(4)), FeatureView(one.color, one.depth, STILL), CAMERA,
        FeatureSettings(),
    )
    assert found is not None and found.matches >= found.inliers >= FeatureSettings().min_inliers
    assert error_m(found.T_world_camera, truth) < 0.04


def test_nothing_to_match_gives_no_start() -> None:
    blank = FeatureView(np.zeros((240, 320, 3), np.uint8), np.ones((240, 320), np.float32), STILL)
    view = wall_view(STILL, True)
    textured = FeatureView(view.color, view.depth, STILL)
    no_depth = FeatureView(view.color, np.zeros((240, 320), np.float32), STILL)
    for frame, earlier in ((blank, textured), (textured, blank), (textured, no_depth)):
        assert pose_from_matches(frame, earlier, CAMERA, FeatureSettings()) is None


def test_an_empty_depth_image_is_lost_and_tracking_goes_on_after_it() -> None:
    context = NativeContext(2)
    tracker = GicpTracker(CAMERA, TrackerSettings(), context)
    surface = MeasuredSurface(TrackerSettings().target, context)
    first = wall_view(STILL, True)
    tracker.set_target(surface.add(tracker.track(first).points, STILL))
    lost = tracker.track(replace(first, depth=np.zeros_like(first.depth)))
    assert lost.status is TrackingStatus.LOST
    assert "only 0 points" in lost.reason
    again = tracker.track(first)
    assert again.status is TrackingStatus.OK
    assert error_m(again.T_world_camera, STILL) < 2e-3


def test_noise_is_measured() -> None:
    rng = np.random.default_rng(0)
    clean = wall_view(se3_exp(np.array([0, 0, -1.0, 0.3, 0.5, 0])), True).depth
    sigma = 0.001 + 0.002 * clean**2
    found = estimate_noise(clean + np.float32(rng.normal(size=clean.shape) * sigma), CAMERA)
    assert found is not None
    for z in (1.0, 1.5, 2.0):
        assert found.sigma(z) == pytest.approx(0.001 + 0.002 * z * z, rel=0.25)
    rounded = estimate_noise(np.round(clean, 3), CAMERA)
    assert rounded is not None
    assert rounded.sigma(3.0) < 1e-3
    assert estimate_noise(np.zeros((240, 320), np.float32), CAMERA) is None


def test_noise_given_is_not_measured() -> None:
    tracker = GicpTracker(CAMERA, TrackerSettings(noise=DepthNoise(0.01, 0.0)), NativeContext(1))
    tracker.track(wall_view(STILL, True))
    assert tracker.noise == DepthNoise(0.01, 0.0)


NOISY = TrackerSettings(noise=DepthNoise(0.002, 0.0))
"""Noise from which on grey values are always compared."""


def test_a_step_of_20_cm_and_15_degrees_is_tracked() -> None:
    poses = [STILL, STILL, se3_exp(np.array([0.17, -0.1, 0.03, 0.0, np.radians(13), np.radians(7)]))]
    result = run(poses, True, NOISY)[-1]
    assert result.status in (TrackingStatus.OK, TrackingStatus.RECOVERED)
    assert error_m(result.T_world_camera, poses[-1]) < 5e-3


def test_a_pose_that_the_image_contradicts_is_doubted(monkeypatch: pytest.MonkeyPatch) -> None:
    """Geometry that slides 15 cm along a shelf with all its overlap, from every start: the path jumps, and says so."""
    poses, align = [STILL, se3_exp(np.array([0.02, 0, 0, 0, 0, 0]))], CpuTrackingEngine.align
    assert run(poses, True, NOISY)[-1].status is TrackingStatus.OK
    aside = se3_exp(np.array([0.15, 0, 0, 0, 0, 0]))

    def slid(engine: CpuTrackingEngine, points: Any, target: Any, guess: np.ndarray, *more: Any) -> Any:
        found = align(engine, points, target, guess, *more)
        T = aside @ poses[-1]
        return replace(found, T_world_camera=T, photometric_residual=0.2)

    monkeypatch.setattr(CpuTrackingEngine, "align", slid)
    result = run(poses, True, NOISY)[1]
    assert result.status is TrackingStatus.DOUBTED
    assert "features shared with the last frame" in result.reason


def test_shared_features_tell_a_pose_from_another() -> None:
    truth = se3_exp(np.array([0.1, -0.05, 0.05, 0.03, 0.1, -0.1]))
    one, two = wall_view(STILL, True), wall_view(truth, True)
    views = [FeatureView(frame.color, frame.depth, T) for frame, T in ((two, truth), (one, STILL))]
    shared = SharedFeatures(views[0], views[1:], CAMERA, FeatureSettings())
    assert shared.contradict(truth) == "" and shared.contradict(STILL)
    assert shared.prefer(truth, STILL) is True and shared.prefer(STILL, truth) is False
    assert shared.prefer(truth, truth) is None
    nothing = SharedFeatures(views[0], [], CAMERA, FeatureSettings())
    assert nothing.contradict(STILL) == "" and nothing.prefer(truth, STILL) is None
