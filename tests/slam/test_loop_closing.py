# SPDX-License-Identifier: Apache-2.0
"""Loops are closed; false ones are not."""

from __future__ import annotations

import copy
import dataclasses
from pathlib import Path

import numpy as np
import pytest
from drifting_camera import walk_with_drift

from ggslam.evaluation.trajectory import score_trajectory
from ggslam.loops.activity import ActivitySettings
from ggslam.loops.revisits import RevisitSettings
from ggslam.rendering.cpu import CpuRasterizer
from ggslam.scene.frame import Frame
from ggslam.scene.poses import inverse, se3_exp
from ggslam.sequences import open_sequence
from ggslam.slam.config import Config, load_config
from ggslam.slam.loop_settings import LoopSettings
from ggslam.slam.schedules import NewKeyframe
from ggslam.slam.slam import Slam
from ggslam.tracking.points import extract_points
from ggslam.tracking.settings import DepthNoise
from ggslam.tracking.tracker import TrackingResult, TrackingStatus

CHEAP = ["mapping.iterations_per_frame=1", "mapping.first_frame_iterations=20", "identity.enabled=false"]


@pytest.fixture(scope="module")
def frames(room: Path) -> list[Frame]:
    return list(open_sequence(room).stream())


FORGETFUL = LoopSettings(activity=ActivitySettings(forget_after=0.05, near=0.15, batch=1, spread=0))
"""Whatever the camera has not seen for a step is put aside."""
IN_VIEW = LoopSettings(revisits=RevisitSettings(gap=4, least_way=0.1), repair_iterations=5)
"""Nothing is put aside in a room as small as this."""


def drifting(
    frames: list[Frame], loops: LoopSettings = FORGETFUL, keyframes: int = 24, drift: float = 1.0
) -> tuple[Slam, np.ndarray]:
    """A camera goes through the room and back again, tracked with drift: 18 cm and 4 degrees in all. Gives the run up
    to a keyframe, which all frames are, and their true poses."""
    config = dataclasses.replace(load_config(None, CHEAP), loops=loops)
    slam = Slam(frames[0].camera, config, has_masks=False)
    truth = walk_with_drift(slam, frames, drift * np.array([0.15, 0.06, -0.09, 0.0, np.radians(4), 0.0]), keyframes)
    return slam, truth


@pytest.fixture(scope="module")
def closing(frames: list[Frame]) -> tuple[Slam, np.ndarray]:
    """A drifting camera that closes its loop."""
    return drifting(frames)


@pytest.fixture(scope="module")
def unconfirmed(frames: list[Frame]) -> tuple[Slam, np.ndarray]:
    """The same one, which believes no sighting that is not confirmed by a hundred others."""
    return drifting(frames, dataclasses.replace(FORGETFUL, confirmations=100))


def error_of_keyframes(slam: Slam, truth: np.ndarray) -> float:
    return float(np.linalg.norm(slam.mapper.keyframes[-1].T_world_camera[:3, 3] - truth[-1, :3, 3]))


def test_a_loop_is_closed_and_everything_follows(
    closing: tuple[Slam, np.ndarray], unconfirmed: tuple[Slam, np.ndarray]
) -> None:
    (slam, truth), (unclosed, _) = closing, unconfirmed
    assert slam.loops is not None and unclosed.loops is not None
    closed = [e for e in slam.loops.events if e.kind == "closed"]
    assert closed, [e.reason for e in slam.loops.events]
    assert error_of_keyframes(unclosed, truth) > 0.1
    assert error_of_keyframes(slam, truth) < error_of_keyframes(unclosed, truth) / 3
    # Poses, surface and Gaussians are where their keyframes are.
    for part, pose in zip(slam.surface.poses, slam.loops.poses, strict=True):
        np.testing.assert_allclose(part, pose, atol=1e-9)
    last = slam.mapper.keyframes[-1]
    view = CpuRasterizer(context=slam.context).forward(slam.map, slam.camera, last.T_camera_world, features=False)
    seen = (last.depth_m() > 0) & (view.alpha.numpy() > 0.7)
    assert np.abs(view.expected_depth.numpy() - last.depth_m())[seen].mean() < 0.05
    slam.follow_corrections()  # the tracker hears of it with the next frame
    assert slam.moves_followed == len(closed) and slam.tracker.target is slam.surface.target


def test_a_loop_within_the_view_is_closed(frames: list[Frame], unconfirmed: tuple[Slam, np.ndarray]) -> None:
    (slam, truth), (unclosed, _) = drifting(frames, IN_VIEW), unconfirmed
    assert slam.loops is not None and not slam.loops.activity.inactive()
    kinds = [e.kind for e in slam.loops.events]
    assert "closed" in kinds, [e.reason for e in slam.loops.events]
    assert error_of_keyframes(slam, truth) < error_of_keyframes(unclosed, truth) / 3
    for part, pose in zip(slam.surface.poses, slam.loops.poses, strict=True):
        np.testing.assert_allclose(part, pose, atol=1e-9)


def test_without_drift_old_keyframes_agree_and_nothing_moves(frames: list[Frame]) -> None:
    slam, truth = drifting(frames, IN_VIEW, drift=0.0)
    assert slam.loops is not None
    assert {e.kind for e in slam.loops.events} == {"agreed"} and len(slam.corrections) == 0
    np.testing.assert_allclose(slam.loops.poses, truth, atol=1e-9)


def test_one_sighting_alone_closes_nothing(unconfirmed: tuple[Slam, np.ndarray]) -> None:
    slam, _ = unconfirmed
    assert slam.loops is not None
    kinds = {event.kind for event in slam.loops.events}
    assert "verified" in kinds and "closed" not in kinds


def test_false_closures_are_rejected_and_change_nothing(closing: tuple[Slam, np.ndarray]) -> None:
    slam, _ = closing
    assert slam.loops is not None
    graph = copy.deepcopy(slam.loops.graph)
    before = graph.optimise().poses
    for i, j in ((0, 9), (1, 11), (3, 8)):
        wrong = se3_exp(np.array([1.0, -0.5, 0.3, 0.3, 0.2, 0.4])) @ inverse(graph.poses[i]) @ graph.poses[j]
        graph.add_loop(i, j, wrong, 1e6 * np.eye(6))
    result = graph.optimise()
    assert set(result.rejected) >= set(range(len(graph.loops) - 3, len(graph.loops)))
    np.testing.assert_allclose(result.poses, before, atol=1e-3)


def test_a_keyframe_from_before_the_loss_that_comes_late_hangs_on_the_one_before_it(frames: list[Frame]) -> None:
    slam, _ = drifting(frames, keyframes=6)
    loops = slam.loops
    assert loops is not None
    points = extract_points(frames[4].depth, slam.camera, slam.config.tracking.points, DepthNoise(), slam.context)
    last, count = loops.poses[-1].copy(), len(loops.poses)
    loops._found_at = (1000, 0)  # the tracker was lost and found at keyframe 0 by frame 1000
    late = TrackingResult(last, TrackingStatus.OK, 1.0, 0.0, "", points)
    slam.map_keyframe(NewKeyframe(dataclasses.replace(frames[4], index=990), late, slam.moves_followed))
    assert loops.graph._tree.parents[count] == count - 1 and count not in loops.activity.active
    slam.map_keyframe(NewKeyframe(dataclasses.replace(frames[4], index=1001), late, slam.moves_followed))
    assert loops.graph._tree.parents[count + 1] == 0 and count + 1 in loops.activity.active
    assert loops._found_at is None


def test_loops_can_be_turned_off(frames: list[Frame]) -> None:
    slam = Slam(frames[0].camera, load_config(None, [*CHEAP, "loops.enabled=false"]), has_masks=False)
    for frame in frames[:4]:
        slam.step(frame)
    result = slam.finish()
    assert slam.loops is None and result.places is None and result.loop_events == []


def test_a_room_is_tracked_the_same_with_loops_and_without(frames: list[Frame]) -> None:
    trajectories = []
    for enabled in ("true", "false"):
        slam = Slam(frames[0].camera, load_config(None, [*CHEAP, f"loops.enabled={enabled}"]), has_masks=False)
        for frame in frames[:12]:
            slam.step(frame)
        trajectories.append(slam.finish().trajectory())
    np.testing.assert_array_equal(*trajectories)
    assert score_trajectory(list(trajectories[0]), np.array([f.T_world_camera for f in frames[:12]])) is not None
    assert Config().loops.enabled
