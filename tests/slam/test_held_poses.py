# SPDX-License-Identifier: Apache-2.0
"""Whatever holds a pose in the world goes along when a loop is closed."""

from __future__ import annotations

import dataclasses
import itertools
import re
from pathlib import Path

import numpy as np
import pytest
from held_poses import held_poses

from ggslam.scene.poses import inverse, se3_exp
from ggslam.sequences import open_sequence
from ggslam.sequences.rig import RigSequence
from ggslam.slam.config import load_config
from ggslam.slam.loop_closing import LoopCloser
from ggslam.slam.loop_results import Correction
from ggslam.slam.rig_slam import RigSlam
from ggslam.slam.slam import Slam
from ggslam.tracking.tracker import TrackingResult, TrackingStatus

QUICK = [
    "mapping.iterations_per_frame=1", "mapping.first_frame_iterations=5", "keyframes.max_gap=2",
    "loops.repair_iterations=0",
]  # fmt: skip
BEND = np.array([0.03, -0.02, 0.025, 0.01, -0.008, 0.01])
"""Twist [6] by which the newest keyframe lies elsewhere: 4 cm and 1 degree."""
STAYS = {
    r"\.T_keyframe_camera$": "relative to a keyframe",
    r"\.T_color_depth$": "motion between two exposures",
    r"\.(motion|velocity|turned|rig_motion)$": "motion between two frames",
    r"\._T_map_added$": "within the local map, which moves as a whole",
    r"\.T_i_j$": "measured between two keyframes",
    r"\.graph\._tree\.poses": "where odometry alone has the keyframes",
    r"\.rig(\.|$)|T_first_|T_rig_": "between two cameras of a rig",
}
"""Paths of motions that a correction leaves alone, and what they are."""


def started(room: Path, rig: Path, kind: str) -> Slam:
    """A run of a few frames with everything on that holds poses."""
    if kind == "rig":
        sequence = open_sequence(rig)
        assert isinstance(sequence, RigSequence)
        slam: Slam = RigSlam(sequence.rig, load_config(None, QUICK), has_masks=True)
    else:
        sequence = open_sequence(room)
        slam = Slam(sequence.camera, load_config(None, [*QUICK, f"tracker={kind}"]), has_masks=True)
    groups = itertools.groupby(sequence.stream(), key=lambda frame: (frame.instant, frame.index * (kind != "rig")))
    for _, frames in itertools.islice(groups, 14):
        slam.step_together([dataclasses.replace(frame, depth_delay=0.01) for frame in frames])
    return slam


def close_loop(slam: Slam) -> Correction:
    """Ties the newest keyframe to the first one, where it does not lie, and moves all that follows."""
    loops = slam.loops
    assert loops is not None
    newest = len(loops.poses) - 1
    T_first_newest = inverse(loops.poses[0]) @ se3_exp(BEND) @ loops.poses[newest]
    correction = loops._close(14, 0, loops.graph.add_loop(0, newest, T_first_newest, 1e6 * np.eye(6)))
    assert correction is not None, loops.events[-1].reason
    slam.corrections.apply(correction, loops)
    slam.filters.loop_closed()
    slam.follow_corrections()
    return correction


def moved_well(path: str, before: np.ndarray, after: np.ndarray, T_new_old: np.ndarray) -> bool:
    """Whether a pose went with the newest keyframe or with the one whose number its path names; inverses, too."""
    numbers = [int(text) for text in re.findall(r"\[(\d+)\]", path)]
    ways = [T_new_old[-1], *(T_new_old[k] for k in numbers if k < len(T_new_old))]
    if before.ndim == 3 and len(before) == len(T_new_old):
        ways.append(T_new_old)
    forward = any(np.allclose(after, T @ before, atol=1e-6) for T in ways)
    return forward or any(np.allclose(inverse(after), T @ inverse(before), atol=1e-6) for T in ways)


@pytest.mark.parametrize("kind", ["gicp", "edges_planes", "rig"])
def test_every_holder_of_a_pose_moves(room: Path, rig: Path, kind: str) -> None:
    slam = started(room, rig, kind)
    before = held_poses(slam)
    correction = close_loop(slam)
    after = held_poses(slam)
    assert np.linalg.norm(correction.T_new_old[-1] - np.eye(4)) > 0.02
    behind = [
        path for path, pose in before.items()
        if path in after and pose.shape == after[path].shape
        and not moved_well(path, pose, after[path], correction.T_new_old)
        and not any(re.search(pattern, path) for pattern in STAYS)
    ]  # fmt: skip
    assert not behind, f"left behind by a correction (or motions to be named in STAYS): {behind}"
    found = " ".join(before)
    for holder in (".policy.", ".poses.", ".tracker.", ".filters[", ".surface.", ".mapper.keyframes"):
        assert holder in found


def test_a_correction_is_followed_once_and_by_late_keyframes(room: Path, rig: Path) -> None:
    slam = started(room, rig, "gicp")
    known = slam.moves_followed
    correction = close_loop(slam)
    assert slam.tracker.target is slam.surface.target
    once = held_poses(slam.tracker) | held_poses(slam.policy)
    slam.follow_corrections()
    again = held_poses(slam.tracker) | held_poses(slam.policy)
    assert all(np.array_equal(once[path], again[path]) for path in once)
    points = slam.mapper.keyframes[0]
    late = TrackingResult(se3_exp(BEND), TrackingStatus.OK, 1.0, 0.0, "", points)  # type: ignore[arg-type]
    moved = slam.corrections.follow(late, known).T_world_camera
    np.testing.assert_allclose(moved, correction.T_new_old[-1] @ se3_exp(BEND), atol=1e-12)
    np.testing.assert_array_equal(slam.corrections.follow(late, slam.moves_followed).T_world_camera, se3_exp(BEND))


def test_gaussians_go_with_the_keyframe_that_inserted_them(room: Path, rig: Path) -> None:
    slam = started(room, rig, "gicp")
    birth, before = slam.map.birth_keyframe.numpy().copy(), slam.map.means.detach().numpy().copy()
    assert slam.loops is not None
    T = np.stack([se3_exp(0.1 * k * BEND) for k in range(len(slam.loops.poses))])
    poses = T @ np.array(slam.loops.poses)
    slam.corrections.apply(Correction(poses, T, set(), set(), set(range(len(T)))), slam.loops)
    expected = np.einsum("nij,nj->ni", T[birth][:, :3, :3], before) + T[birth][:, :3, 3]
    np.testing.assert_allclose(slam.map.means.detach().numpy(), expected, atol=1e-4)
    np.testing.assert_allclose(slam.surface.poses, poses, atol=1e-9)


def test_keyframes_that_moved_apart_no_longer_look_at_the_same(room: Path, rig: Path) -> None:
    slam = started(room, rig, "gicp")
    loops = slam.loops
    assert loops is not None
    count, spread = len(loops.poses), slam.config.loops.activity.spread
    first_moved = count - spread - 1
    assert first_moved > 0 and loops.activity.around(count - 1) == set(range(count))
    T = np.tile(np.eye(4), (count, 1, 1))
    T[first_moved:, 0, 3] = 50.0
    slam.corrections.apply(Correction(T @ np.array(loops.poses), T, set(), set(), set(range(count))), loops)
    assert loops.activity.around(count - 1) == set(range(first_moved, count))


def sightings(slam: Slam, numbers: list[int], apart_m: float, **settings: int) -> LoopCloser:
    """A loop closer that has found the same correction at some keyframes, the last one this far from the others."""
    from ggslam.slam.loop_closing import _Found

    loops = slam.loops
    assert loops is not None
    loops.settings = dataclasses.replace(loops.settings, **settings)
    shift = se3_exp(np.array([apart_m, 0, 0, 0, 0, 0]))
    loops._verified = [_Found(k, 0, np.eye(4) if k < numbers[-1] else shift, np.eye(4)) for k in numbers]
    return loops


@pytest.mark.parametrize(
    ("gap", "apart", "confirmed"), [(3, 0.0, True), (4, 0.0, False), (1, 0.99, True), (1, 1.01, False)]
)
def test_sightings_confirm_one_another_within_the_gap(room: Path, gap: int, apart: float, confirmed: bool) -> None:
    slam = Slam(open_sequence(room).camera, load_config(None, QUICK))
    limit = slam.config.loops.agreement_m
    loops = sightings(slam, [10, 10 + gap], apart * limit, confirmations=2, confirmation_gap=3)
    assert loops._is_confirmed() == confirmed
