# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

import math

import numpy as np

from ggslam.scene.camera import Camera
from ggslam.scene.poses import se3_exp, transform_points
from ggslam.viewer.cameras import (
    CameraTuning,
    best_view,
    box_lines,
    top_view,
    view_from_behind,
    view_of_pose,
)

CAMERA = Camera(320, 240, 300.0, 290.0, 160.0, 119.0)


def test_a_view_of_a_pose_looks_where_it_looked() -> None:
    T = se3_exp(np.array([0.2, 0.1, -0.4, 0.3, -0.2, 0.5]))
    view = view_of_pose(T, 2.0)
    assert np.allclose(transform_points(view.look_at[None], np.linalg.inv(T)), [[0, 0, 2.0]])
    assert np.allclose(view.up, -T[:3, 1])


def test_the_top_view_sees_the_map_from_above_without_the_ceiling() -> None:
    draw = np.random.default_rng(0)
    up = np.array([0.0, -1.0, 0.0])
    centers = draw.uniform([-2, -1.5, 0], [2, 1.0, 6], (5000, 3))
    fov = math.radians(50)
    view = top_view(centers, np.zeros((3, 3)), np.array([0.0, 0, 1]), up, fov)
    depth = (view.position - centers) @ up
    assert (depth[(centers @ up) > CameraTuning.headroom_m + 0.01] < view.near).all()  # cut away
    below = (centers @ up) < CameraTuning.headroom_m - 0.01
    assert (depth[below] > view.near).all()
    sideways = np.linalg.norm((centers - view.position)[:, [0, 2]], axis=1)[below]
    assert (sideways < math.tan(fov / 2) * depth[below] * 1.05).all()
    assert abs(view.up @ up) < 1e-9 and np.allclose(view.up, [0, 0, 1])


def test_lines_of_boxes() -> None:
    edges = box_lines(np.array([1.0, 0, 0]), np.eye(3), np.array([1.0, 2, 3]))
    lengths = np.linalg.norm(edges[:, 0] - edges[:, 1], axis=1)
    assert sorted(lengths.round(5).tolist()) == [1.0] * 4 + [2.0] * 4 + [3.0] * 4
    assert np.allclose(edges.reshape(-1, 3).mean(axis=0), [1, 0, 0])


def test_a_camera_is_seen_from_behind_and_above() -> None:
    T = se3_exp(np.array([0.3, -0.2, 1.0, 0.4, 0.1, -0.3]))
    view = view_from_behind(T, 2.0)
    seen = np.linalg.inv(T) @ np.append(view.position, 1)
    assert seen[2] < 0 and seen[1] < 0 and np.isclose(seen[0], 0)
    assert np.allclose(np.linalg.inv(T) @ np.append(view.look_at, 1), [0, 0, 2, 1])


def test_boxes_are_looked_at_from_the_nearest_camera_that_sees_them() -> None:
    def at(x: float, z: float, turned: bool = False) -> np.ndarray:
        T = se3_exp(np.array([0, 0, 0, 0, np.pi if turned else 0.0, 0]))
        T[:3, 3] = x, 0, z
        return T

    box = (np.array([0.1, 0.0, 3.0]), np.eye(3), np.full(3, 0.2))
    poses = [at(0, 0), at(0, 1.5), at(0, 2.5, turned=True), at(2.0, 2.5)]  # far, near, near and away, near and beside
    view = best_view([box], poses, CAMERA, 0.05)
    assert np.allclose(view.position, [0, 0, 1.5]) and np.allclose(view.look_at, box[0], atol=1e-6)
    assert np.allclose(view.up, [0, -1, 0]) and view.near == 0.05
