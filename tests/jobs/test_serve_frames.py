# SPDX-License-Identifier: Apache-2.0
"""REP 105: the camera has no jump in `odom`, whatever happens to the map."""

from __future__ import annotations

import numpy as np

from ggslam.jobs.serve.channels import CAMERA, FLOOR, MAP, ODOM, OPTICAL, T_CAMERA_OPTICAL
from ggslam.jobs.serve.frames_tree import FramesTree, fixed_frames
from ggslam.scene.poses import inverse, se3_exp, separation

STEP = se3_exp(np.array([0.02, 0, 0.01, 0, 0.03, 0]))
"""Of the camera, frame by frame."""
MOVE = se3_exp(np.array([0.5, 0.1, -0.2, 0, 0.2, 0]))
"""A correction of the map."""


def chain(tree: FramesTree) -> np.ndarray:
    edges = {(parent, child): T for parent, child, T in (*tree.transforms.edges, *fixed_frames(None).edges)}
    return np.asarray(edges[MAP, ODOM] @ edges[ODOM, CAMERA] @ edges[CAMERA, OPTICAL])


def test_the_optical_frame_looks_along_x_of_the_camera() -> None:
    np.testing.assert_allclose(T_CAMERA_OPTICAL[:3, :3] @ [0, 0, 1], [1, 0, 0])  # forward
    np.testing.assert_allclose(T_CAMERA_OPTICAL[:3, :3] @ [1, 0, 0], [0, -1, 0])  # right
    np.testing.assert_allclose(T_CAMERA_OPTICAL[:3, :3] @ [0, 1, 0], [0, 0, -1])  # down
    assert np.linalg.det(T_CAMERA_OPTICAL) == 1


def test_a_correction_goes_to_map_odom_alone() -> None:
    """The map moves at frame 10; the tracker follows with the next frame, as in a run."""
    tree, tracked, before = FramesTree(), np.eye(4), np.eye(4)
    steps, jumps = [], []
    for k in range(20):
        moves = [MOVE] if k == 11 else []
        if k:
            tracked = (MOVE @ tracked if moves else tracked) @ STEP
        T_map = MOVE @ tracked if k == 10 else tracked  # the map is ahead of the tracker
        last, last_map = tree.T_odom_optical, tree.T_map_odom
        tree.step(tracked, T_map, moves, unbroken=k > 0)
        np.testing.assert_allclose(chain(tree), T_map, atol=1e-12)
        steps.append(separation(last, tree.T_odom_optical))
        jumps.append(separation(last_map, tree.T_map_odom)[0])
        before = T_map
    np.testing.assert_allclose(steps[1:], [separation(np.eye(4), STEP)] * 19, atol=1e-9)
    assert [k for k, jump in enumerate(jumps) if jump > 1e-9] == [10]
    assert jumps[10] > 0.4
    np.testing.assert_allclose(chain(tree), before, atol=1e-12)


def test_a_camera_that_is_found_anew_does_not_jump_in_odom() -> None:
    tree = FramesTree()
    tree.step(np.eye(4), np.eye(4), [], unbroken=False)
    tree.step(STEP, STEP, [], unbroken=True)
    elsewhere = MOVE @ STEP
    tree.move_world(MOVE)  # while it was lost
    tree.step(elsewhere, elsewhere, [], unbroken=False)
    np.testing.assert_allclose(tree.T_odom_optical, STEP, atol=1e-12)
    np.testing.assert_allclose(chain(tree), elsewhere, atol=1e-12)
    tree.step(elsewhere @ STEP, elsewhere @ STEP, [], unbroken=True)
    np.testing.assert_allclose(tree.T_odom_optical, STEP @ STEP, atol=1e-12)


def test_a_run_in_an_earlier_map_begins_where_it_is_found() -> None:
    tree = FramesTree()
    tree.step(MOVE, MOVE, [], unbroken=False)
    np.testing.assert_allclose(tree.T_odom_optical, np.eye(4), atol=1e-12)
    np.testing.assert_allclose(chain(tree), MOVE, atol=1e-12)


def test_the_floor_hangs_below_the_map() -> None:
    edges = {child: (parent, T) for parent, child, T in fixed_frames(inverse(MOVE)).edges}
    assert edges[FLOOR][0] == MAP
    np.testing.assert_allclose(edges[FLOOR][1], MOVE, atol=1e-12)
    assert fixed_frames(None).fixed and len(fixed_frames(None).edges) == 1
