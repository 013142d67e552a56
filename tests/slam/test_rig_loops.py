# SPDX-License-Identifier: Apache-2.0
"""A rig that comes back closes its loop by what any of its cameras saw, and stays one body."""

from __future__ import annotations

import dataclasses
from pathlib import Path

import numpy as np
import pytest

from ggslam.loops.activity import ActivitySettings
from ggslam.scene.poses import inverse, se3_exp, separation
from ggslam.sequences import open_sequence
from ggslam.sequences.rig import RigSequence
from ggslam.slam.config import load_config
from ggslam.slam.loop_settings import LoopSettings
from ggslam.slam.rig_slam import RigSlam
from ggslam.slam.schedules import NewKeyframe
from ggslam.tracking.points import extract_points
from ggslam.tracking.settings import DepthNoise
from ggslam.tracking.tracker import TrackingResult, TrackingStatus

FORGETFUL = LoopSettings(activity=ActivitySettings(forget_after=0.05, near=0.15, batch=1, spread=0))
CHEAP = ["mapping.iterations_per_frame=1", "mapping.first_frame_iterations=20", "identity.enabled=false"]
DRIFT = np.array([0.15, 0.06, -0.09, 0.0, np.radians(4), 0.0])
"""Of the whole way: 18 cm and 4 degrees."""


def there_and_back(sequence: RigSequence, loops: LoopSettings, blind: int | None = None) -> tuple[RigSlam, np.ndarray]:
    """A rig goes through the room and back, tracked with drift; every second instant is a keyframe of both cameras.

    Args:
        sequence: of the rig.
        loops: settings.
        blind: the number of a camera that no keyframes are made of.

    Returns:
        The run, and the first camera's true poses, [24, 4, 4].
    """
    slam = RigSlam(sequence.rig, dataclasses.replace(load_config(None, CHEAP), loops=loops), has_masks=False)
    slam.tracker.noise = noise = DepthNoise()
    assert sequence.ground_truth is not None and slam.loops is not None
    order = [*range(0, 24, 2), *range(22, -1, -2)]
    first = [sequence.ground_truth[sequence.frames_of(0)[i]] for i in order]
    truth, step = np.array([inverse(first[0]) @ T for T in first]), se3_exp(DRIFT / len(order))
    T_world_first = np.eye(4)
    for k, i in enumerate(order):
        moves = slam.moves_followed
        slam.follow_corrections()
        for T_new_old in slam.corrections.moves[moves:]:
            T_world_first = T_new_old @ T_world_first
        T_world_first = T_world_first @ inverse(truth[k - 1]) @ truth[k] @ step if k else T_world_first
        for number in range(2):
            if number == blind:
                continue
            index = int(sequence.frames_of(number)[i])
            frame = dataclasses.replace(sequence.frame(index), index=2 * k + number, instant=k)
            points = extract_points(frame.depth, frame.camera, slam.config.tracking.points, noise, slam.context)
            # The second camera is 10 ms late: where it was by the truth, seen from the first one.
            T_first_camera = inverse(first[k]) @ sequence.ground_truth[index]
            tracking = TrackingResult(T_world_first @ T_first_camera, TrackingStatus.OK, 1.0, 0.0, "", points)
            slam.map_keyframe(NewKeyframe(frame, tracking, slam.moves_followed))
        slam.mapper.run(2)
    return slam, truth


def error_of(slam: RigSlam, truth: np.ndarray, number: int) -> float:
    """Of the newest keyframe of a camera, metres, as one of the first camera."""
    newest = [k for k in slam.mapper.keyframes if k.camera_number == number][-1]
    T = slam.rig.pose_of_first(newest.T_world_camera, number)
    return float(np.linalg.norm(T[:3, 3] - truth[-1, :3, 3]))


@pytest.fixture(scope="module")
def sequence(rig: Path) -> RigSequence:
    found = open_sequence(rig)
    assert isinstance(found, RigSequence)
    return found


@pytest.mark.long("a walk of 24 instants")
@pytest.mark.parametrize("blind", [None, 0])
def test_a_loop_is_closed_by_any_camera(sequence: RigSequence, blind: int | None) -> None:
    slam, truth = there_and_back(sequence, FORGETFUL, blind)
    assert slam.loops is not None
    closed = [e for e in slam.loops.events if e.kind == "closed"]
    assert closed, [e.reason for e in slam.loops.events]
    assert all(error_of(slam, truth, number) < 0.06 for number in range(2) if number != blind)
    for part, pose in zip(slam.surface.poses, slam.loops.poses, strict=True):
        np.testing.assert_allclose(part, pose, atol=1e-9)
    if blind is None:  # cameras of one instant are where the rig has them, but for 10 ms
        for k in range(0, len(slam.loops.poses), 2):
            apart, turned = separation(
                inverse(slam.loops.poses[k]) @ slam.loops.poses[k + 1], sequence.rig.T_first_camera[1]
            )
            assert apart < 0.03 and turned < 1.5


@pytest.mark.long("a walk of 24 instants")
def test_odometry_goes_from_camera_to_camera_within_an_instant_only(sequence: RigSequence) -> None:
    """Drift gathers along the way of each camera, and not by turning around to the other one."""
    slam, _ = there_and_back(sequence, LoopSettings(confirmations=100))
    assert slam.loops is not None
    tree = slam.loops.graph._tree
    assert tree.parents == [-1, 0, *(parent for k in range(2, 48, 2) for parent in (k - 2, k))]
    rigid = [np.sqrt(np.trace(tree.steps[k][:3, :3])) for k in range(1, 48, 2)]
    moving = [np.sqrt(np.trace(tree.steps[k][:3, :3])) for k in range(2, 48, 2)]
    assert max(rigid) < 1e-3 < min(moving) < max(moving) < 0.05
