# SPDX-License-Identifier: Apache-2.0
"""Frames keep their poses when an error has kept keyframes from the mapper."""

from __future__ import annotations

import numpy as np

from ggslam.mapping.keyframe import make_keyframe
from ggslam.scene.camera import Camera
from ggslam.scene.frame import Frame
from ggslam.scene.poses import inverse, se3_exp
from ggslam.slam.frame_poses import FramePoses
from ggslam.tracking.points import FramePoints
from ggslam.tracking.tracker import TrackingResult, TrackingStatus

CAMERA = Camera(8, 6, 7.0, 7.0, 3.5, 2.5)
NOTHING = FramePoints(
    np.empty((0, 3), np.float32), np.empty((0, 3), np.float32), np.empty((0, 6), np.float32),
    np.empty((0, 2), np.int32), np.empty(0, np.float32),
)  # fmt: skip


def path(number: int) -> np.ndarray:
    return se3_exp(np.array([0.1, -0.02, 0.05, 0.03, 0.04, -0.02]) * number)


def frame(number: int) -> Frame:
    shape = (CAMERA.height, CAMERA.width)
    return Frame(number, number, number / 30, np.zeros((*shape, 3), np.uint8), np.ones(shape, np.float32), CAMERA)


def test_frames_on_keyframes_that_never_came_keep_their_poses() -> None:
    poses, correction = FramePoses(), se3_exp(np.array([0.02, 0.01, 0.0, 0.0, 0.05, 0.0]))
    for number in range(10):
        if number == 8:
            poses.move(correction)  # of a loop that was closed meanwhile
        moved = correction @ path(number) if number >= 8 else path(number)
        if number % 2 == 0:
            poses.add_keyframe(moved)
        poses.add(frame(number), TrackingResult(moved, TrackingStatus.OK, 1.0, 0.0, "", NOTHING))
    poses.anchor_to(1, correction @ path(2))  # the camera was lost, and found at an old one
    poses.add(frame(10), TrackingResult(correction @ path(3), TrackingStatus.RECOVERED, 1.0, 0.0, "", NOTHING))
    taken_in = [make_keyframe(k, frame(2 * k), correction @ path(2 * k)) for k in range(2)]
    poses.leave_missing(taken_in)
    assert [frame.keyframe for frame in poses.frames] == [0, 0, 1, 1, 1, 1, 1, 1, 1, 1, 1]
    assert poses.keyframes_made == 2 and poses.anchor[0] == 1
    expected = [correction @ path(number) for number in [*range(10), 3]]
    for found, T in zip(poses.frames, expected, strict=True):
        np.testing.assert_allclose(poses.pose_of(found, taken_in), T, atol=1e-12)


def test_nothing_changes_where_all_keyframes_came() -> None:
    poses = FramePoses()
    for number in range(4):
        poses.add_keyframe(path(number))
        poses.add(frame(number), TrackingResult(path(number), TrackingStatus.OK, 1.0, 0.0, "", NOTHING))
    before = list(poses.frames)
    poses.leave_missing([make_keyframe(k, frame(k), path(k)) for k in range(4)])
    assert poses.frames == before and poses.anchor[0] == 3
    np.testing.assert_allclose(inverse(path(3)) @ poses.anchor[1], np.eye(4), atol=1e-12)
