# SPDX-License-Identifier: Apache-2.0
"""Poses of keyframes: who moves them, who reads them, and what stays."""

from __future__ import annotations

import numpy as np
import pytest

from ggslam.errors import FormatError
from ggslam.loops.activity import ActiveKeyframes
from ggslam.loops.pose_graph import PoseGraph
from ggslam.scene.keyframe_poses import KeyframePoses
from ggslam.scene.poses import se3_exp

START = [se3_exp(np.array([0.1 * k, 0, 0, 0, 0.05 * k, 0])) for k in range(5)]
MOVE = se3_exp(np.array([1.0, -2.0, 0.5, 0.1, 0.2, -0.3]))


def test_the_world_moves_or_each_keyframe_by_its_own() -> None:
    one, each = KeyframePoses(START), KeyframePoses(START)
    own = np.stack([MOVE @ MOVE if k == 3 else MOVE for k in range(5)])
    one.move(MOVE)
    each.move(own)
    assert np.array_equal(one.array(), [MOVE @ T for T in START])
    assert np.array_equal(each.array(), [T_new @ T for T_new, T in zip(own, START, strict=True)])
    assert one.version == each.version == 1


def test_poses_that_were_handed_out_stay() -> None:
    poses = KeyframePoses(START)
    before = poses[2]
    with pytest.raises(ValueError):
        before[0, 3] = 5
    poses.move(MOVE)
    assert np.array_equal(before, START[2]) and not np.array_equal(poses[2], before)


def test_new_keyframes_are_no_new_version() -> None:
    poses = KeyframePoses()
    assert [poses.append(T) for T in START] == [0, 1, 2, 3, 4] and len(poses) == 5 and poses.version == 0
    with pytest.raises(ValueError):
        poses.replace(np.stack(START[:4]))
    assert poses.version == 0 and np.array_equal(poses.array(), START)


def test_who_shares_them_follows() -> None:
    """As a run has them: keyframes are appended once, moved once, and all others read that."""
    shared, alone = KeyframePoses(), KeyframePoses()
    graph, activity = PoseGraph(None, shared), ActiveKeyframes(None, shared)
    moved = ActiveKeyframes(None, alone)
    for T in START:
        shared.append(T)
        graph.add_node(T)
        activity.add(T, 2.0)
        moved.add(MOVE @ T, 2.0)
        if len(graph) > 1:
            graph.add_odometry(len(graph) - 2, len(graph) - 1, np.eye(4), np.eye(6))
    assert len(shared) == len(graph) == len(activity) == 5
    shared.move(MOVE)
    assert np.allclose(graph.poses[4], MOVE @ START[4], atol=1e-12)
    assert activity.visits(0) == moved.visits(0) and activity.alike(0.1, 1.0) == moved.alike(0.1, 1.0)
    assert np.allclose(activity._cameras, moved._cameras, atol=1e-12)
    assert np.allclose(activity._middles, moved._middles, atol=1e-12)


def test_what_is_no_pose_is_refused() -> None:
    bad = KeyframePoses(START)
    bad._poses[1] = 2 * np.eye(4)
    with pytest.raises(FormatError):
        bad.check()
