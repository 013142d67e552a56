# SPDX-License-Identifier: Apache-2.0
"""Depth that was taken after colour is brought to colour's time along the camera's motion."""

from __future__ import annotations

import dataclasses
from pathlib import Path

import numpy as np

from ggslam.geometry.moved_depth import largest_shift, moved_depth
from ggslam.scene.camera import Camera
from ggslam.scene.frame import Frame
from ggslam.scene.poses import inverse, se3_exp, se3_log
from ggslam.sequences import open_sequence
from ggslam.slam.config import load_config
from ggslam.slam.filters.shutter_times import ShutterTimes
from ggslam.slam.slam import Slam

CAMERA = Camera(160, 120, 130.0, 130.0, 79.5, 59.5)
MOTION = se3_exp(np.array([0.02, 0.0, 0.01, 0.0, 0.03, 0.0]))


def wall_from(T_world_camera: np.ndarray, camera: Camera = CAMERA) -> np.ndarray:
    """Depth of a slanted wall: n . x = 2 in world axes."""
    normal = np.array([0.1, 0.2, 0.97])
    rays = camera.rays().astype(float) @ T_world_camera[:3, :3].T
    return ((2 - normal @ T_world_camera[:3, 3]) / (rays @ normal)).astype(np.float32)


def frame(depth: np.ndarray, index: int, delay: float) -> Frame:
    color = np.zeros((*depth.shape, 3), np.uint8)
    return Frame(index, index, 0.1 * index, color, depth, CAMERA, depth_delay=delay)


def test_depth_moves_with_the_camera() -> None:
    T_old_new = MOTION
    found = moved_depth(wall_from(np.eye(4)), CAMERA, inverse(T_old_new))
    seen = found > 0
    assert seen.mean() > 0.9  # the rest lay outside of the image
    assert np.abs(found - wall_from(T_old_new))[seen].max() < 0.012  # a pixel's worth on a slanted wall
    assert np.abs(wall_from(np.eye(4)) - wall_from(T_old_new))[seen].max() > 0.03
    assert not moved_depth(np.zeros((120, 160), np.float32), CAMERA, T_old_new).any()


def test_shifts_are_counted_in_pixels() -> None:
    turn = se3_exp(np.array([0.0, 0.0, 0.0, 0.0, 0.01, 0.0]))
    assert 1.3 < largest_shift(turn, CAMERA, 2.0) < 2.0  # 130 px to a radian, more in the corners
    assert largest_shift(np.eye(4), CAMERA, 2.0) == 0


def followed(delay: float, steps: int = 2) -> ShutterTimes:
    """A camera that has gone on at the same pace, its depth so many seconds late."""
    shutters = ShutterTimes()
    for k in range(steps):
        shutters.clean(frame(wall_from(np.eye(4)), k, delay))
        shutters.follow(se3_exp(k * 0.1 * np.array([0.2, 0.0, 0.1, 0.0, 0.3, 0.0])))
    return shutters


def test_the_motion_of_the_last_frames_goes_on() -> None:
    shutters, late = followed(0.04), se3_exp(0.4 * np.array([0.02, 0.0, 0.01, 0.0, 0.03, 0.0]))
    brought = shutters.clean(frame(wall_from(late), 2, 0.04))
    seen = brought.depth > 0
    assert brought.depth_delay == 0 and np.abs(brought.depth - wall_from(np.eye(4)))[seen].max() < 0.012
    np.testing.assert_allclose(shutters.T_color_depth, late, atol=1e-6)


def test_frames_are_left_alone_without_delay_motion_or_cause() -> None:
    together, slow, lost, wide = frame(wall_from(np.eye(4)), 2, 0.0), followed(0.04), followed(0.04), followed(0.04)
    assert followed(0.0).clean(together) is together
    late = frame(wall_from(np.eye(4)), 2, 0.04)
    slow.motion = np.eye(4)
    assert slow.clean(late) is late  # nothing moves
    lost.follow(None)
    assert lost.clean(late) is late
    assert wide.clean(far := frame(wall_from(np.eye(4)), 2, 0.09)) is far  # nearer to the next frame's colour
    assert ShutterTimes().clean(late) is late


def test_a_correction_of_the_map_is_no_motion() -> None:
    shutters = followed(0.04)
    assert shutters.motion is not None
    before, move = shutters.motion.copy(), se3_exp(np.array([1.0, 0.0, 0.0, 0.0, 1.0, 0.0]))
    shutters.move(move)
    shutters.clean(frame(wall_from(np.eye(4)), 2, 0.0))
    shutters.follow(move @ se3_exp(2 * 0.1 * np.array([0.2, 0.0, 0.1, 0.0, 0.3, 0.0])))
    assert np.linalg.norm(shutters.motion[:3, 3]) < 2 * np.linalg.norm(before[:3, 3])


def test_a_run_knows_the_motion_of_its_frames(room: Path) -> None:
    config = load_config(None, ["mapping.first_frame_iterations=0", "mapping.iterations_per_frame=0"])
    frames = [
        dataclasses.replace(f, timestamp=0.1 * f.index, depth_delay=0.02)
        for f in open_sequence(room, stop=3).stream(masks=False)
    ]
    slam = Slam(frames[0].camera, config, False)
    for given in frames[:2]:
        assert slam.clean(given) is given  # how the camera moves is not known yet
        slam.step(given)
    brought = slam.clean(frames[2])
    one, other = (slam.pose_of(f) for f in slam.frames)
    expected = moved_depth(frames[2].depth, slam.camera, se3_exp(0.2 * se3_log(inverse(one) @ other)))
    assert brought.depth_delay == 0 and (brought.depth != frames[2].depth).mean() > 0.3
    assert np.abs(brought.depth - expected).mean() < 1e-4
