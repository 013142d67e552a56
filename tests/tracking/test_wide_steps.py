# SPDX-License-Identifier: Apache-2.0
"""Wide steps and fast turns: what features and the shift of the image contribute where constant velocity is wrong."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from ggslam.evaluation.trajectory import score_trajectory
from ggslam.features.orb import FeatureSettings, FeatureView, ViewMatches
from ggslam.scene.camera import Camera
from ggslam.scene.poses import inverse, se3_exp, separation
from ggslam.sequences import open_sequence
from ggslam.slam.config import Config
from ggslam.slam.slam import Slam
from ggslam.synthetic import RayCaster, Shutter, furnished_room, write_synthetic_sequence
from ggslam.tracking.feature_hold import follow_weakly
from ggslam.tracking.gicp import AlignmentResult, AlignmentStatus
from ggslam.tracking.image_turn import image_turn, small_image
from ggslam.tracking.observability import PointSpread
from ggslam.tracking.points import FramePoints
from ggslam.tracking.seen_before import share_seen_before
from ggslam.tracking.shared_features import SharedFeatures

CAMERA = Camera(320, 240, 240.0, 240.0, 159.5, 119.5)


def track(folder: Path) -> tuple[list[str], float, int]:
    """How each frame was tracked, the ATE in cm (aligned), and in how many something moved."""
    sequence, config = open_sequence(folder), Config()
    slam = Slam(
        sequence.camera,
        replace(config, mapping=replace(config.mapping, iterations_per_frame=1, first_frame_iterations=5)),
    )
    for frame in sequence.stream():
        slam.step(frame)
    known = [i for i, frame in enumerate(slam.frames) if frame.status != "lost"]
    assert sequence.ground_truth is not None
    found = np.stack([slam.pose_of(slam.frames[i]) for i in known])
    scores = score_trajectory(found, np.stack([sequence.ground_truth[i] for i in known]))
    return [f.status for f in slam.frames], 100 * scores.ate_rmse_m, len(slam.movers.pixels)


@pytest.mark.long("a walk is drawn and tracked")
@pytest.mark.parametrize(
    "scene, speed, frames, limit_cm",
    [("bare", 6, 14, 2.0), ("corridor", 5, 14, 1.5)],
    ids=["35 cm past bare walls", "a walk at two frames a second"],
)
def test_wide_steps_are_tracked(tmp_path: Path, scene: str, speed: int, frames: int, limit_cm: float) -> None:
    folder = write_synthetic_sequence(tmp_path / scene, scene=scene, speed=speed, frames=frames)
    statuses, ate_cm, _ = track(folder)
    assert statuses.count("lost") == 0 and statuses.count("recovered") <= 3
    assert ate_cm < limit_cm


@pytest.mark.long("every row of 24 frames is drawn five times")
def test_fast_turns_lose_nothing_and_move_nothing(tmp_path: Path) -> None:
    """Up to 14 degrees a frame, blurred, with a Kinect's noise and rolling shutters."""
    folder = write_synthetic_sequence(
        tmp_path / "turns", trajectory="turns", speed=3, frames=24, seed=1, shutter=Shutter(0.4, 0.2)
    )
    statuses, ate_cm, moving = track(folder)
    assert statuses.count("lost") == 0 and moving == 0
    assert ate_cm < 3


def test_the_shift_of_an_image_tells_a_turn() -> None:
    caster, T = RayCaster(furnished_room(0), 0), np.eye(4)
    T[:3, 3] = (2.0, 1.8, 1.4)
    T[:3, :3] = [[1, 0, 0], [0, 0, 1], [0, -1, 0]]
    before = small_image(caster.render(CAMERA, T).color)
    for yaw, pitch in ((6.0, 0.0), (-12.0, 3.0), (0.0, 8.0)):
        turn = se3_exp(np.array([0, 0, 0, *np.radians([pitch, yaw, 0.0])]))
        found = image_turn(before, small_image(caster.render(CAMERA, T @ turn).color), CAMERA)
        assert separation(found, turn)[1] < 0.25 * np.hypot(yaw, pitch)
    assert (image_turn(before, np.full_like(before, 9), CAMERA) == np.eye(4)).all()


def alignment(T: np.ndarray, weak: np.ndarray) -> AlignmentResult:
    return AlignmentResult(
        T, AlignmentStatus.DEGENERATE, True, 1, 0.9, 0.0, np.eye(6), np.eye(6), np.zeros(6), weak, None, 0.0
    )


def test_only_weak_directions_follow_the_features() -> None:
    spread = PointSpread(1.0, np.array([0.0, 0.0, 2.0]), 0.5)
    found, other = np.eye(4), se3_exp(np.array([0.03, -0.02, 0.05, 0.0, 0.0, 0.0]))
    along = follow_weakly(alignment(found, np.eye(6)[:1]), other, spread)
    np.testing.assert_allclose(along[:3, 3], [0.03, 0, 0], atol=1e-12)
    # A turn about the points' centroid, which is weak too, moves the camera about it.
    turned = se3_exp(np.array([0, 0, 0, 0, 0.1, 0.0]))
    turned[:3, 3] = spread.centroid - turned[:3, :3] @ spread.centroid
    followed = follow_weakly(alignment(found, np.eye(6)[[4]]), turned, spread)
    np.testing.assert_allclose(followed, turned, atol=1e-12)
    np.testing.assert_allclose(follow_weakly(alignment(found, np.eye(6)[:0]), other, spread), found, atol=1e-12)


def shared_of(pixels: np.ndarray, monkeypatch: pytest.MonkeyPatch) -> SharedFeatures:
    """Matches seen by the identity at these pixels, 2 m away."""
    view = FeatureView(np.zeros((240, 320, 3), np.uint8), np.zeros((240, 320), np.float32), np.eye(4))
    rays = (pixels - (CAMERA.cx, CAMERA.cy)) / (CAMERA.fx, CAMERA.fy)
    matches = ViewMatches(2 * np.column_stack([rays, np.ones(len(pixels))]), pixels, np.eye(4))
    monkeypatch.setattr("ggslam.tracking.shared_features.match_views", lambda *_: matches)
    return SharedFeatures(view, [view], CAMERA, FeatureSettings())


def test_features_all_over_the_image_vouch_for_a_pose_and_those_on_one_thing_do_not(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    pixels = np.random.default_rng(0).uniform((5, 5), (315, 235), (80, 2))
    aside = se3_exp(np.array([0.1, 0, 0, 0, 0, 0]))
    everywhere = shared_of(pixels, monkeypatch)
    assert everywhere.vouch(np.eye(4)) and not everywhere.vouch(aside)
    assert everywhere.keeps(np.eye(4), np.eye(4), 0.8) and not everywhere.keeps(aside, np.eye(4), 0.8)
    assert not shared_of(pixels[:30], monkeypatch).vouch(np.eye(4))  # too few
    assert not shared_of(pixels * 0.2 + 10, monkeypatch).vouch(np.eye(4))  # all in one part of the image


def test_the_share_that_was_seen_before() -> None:
    """A wall 2 m away: half of it, about, is new after a turn by half the field of view, and none after none."""
    depth = np.full((240, 320), 2.0, np.float32)
    view = FeatureView(np.zeros((240, 320, 3), np.uint8), depth, np.eye(4))
    xyz = CAMERA.back_project(depth).reshape(-1, 3)[::7]
    points = FramePoints(xyz, xyz, np.zeros((len(xyz), 6)), np.zeros((len(xyz), 2), int), np.ones(len(xyz)))
    assert share_seen_before(points, np.eye(4), [view], CAMERA) == 1
    aside = np.eye(4)
    aside[0, 3] = 0.5 * 320 / CAMERA.fx * 2  # half the width of what is seen
    assert abs(share_seen_before(points, aside, [view], CAMERA) - 0.5) < 0.02
    assert share_seen_before(points, inverse(aside), [view, view], CAMERA) < 0.52
    assert share_seen_before(points, np.eye(4), [], CAMERA) == 0
