# SPDX-License-Identifier: Apache-2.0
"""Where exactly a thing lies: a board of which one visit saw the front and the other the back."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.spatial import cKDTree

from ggslam.changes.candidate_views import CandidateViews
from ggslam.changes.pose_refinement import PoseRefinement
from ggslam.changes.shape import Shape
from ggslam.changes.sightings import Picture
from ggslam.scene.camera import Camera
from ggslam.scene.poses import inverse, se3_exp, transform_points

UP = np.array([0.0, 0.0, 1.0])
HALF = np.array([0.2, 0.02, 0.15])
"""Half of the board's edges, metres: 4 cm thick."""
CAMERA = Camera(width=96, height=72, fx=90.0, fy=90.0, cx=47.5, cy=35.5)
MOVED = se3_exp(np.array([0.1, 0.25, 0, 0, 0, np.radians(40)]))
FRONT, BACK = (-140, -90, -45), (40, 90, 135)
"""Degrees about the vertical from where cameras look at the board, in its own frame."""


def look(angle: float) -> np.ndarray:
    """A camera's pose in the frame of the board, T_board_camera."""
    eye = 1.1 * np.array([np.cos(np.radians(angle)), np.sin(np.radians(angle)), 0.25])
    ahead = -eye / np.linalg.norm(eye)
    right = np.cross(ahead, UP)
    right /= np.linalg.norm(right)
    T = np.eye(4)
    T[:3, :3], T[:3, 3] = np.stack([right, np.cross(ahead, right), ahead], 1), eye
    return T


def picture(angle: float, T_world_board: np.ndarray) -> Picture:
    """The board before a wall far behind, by where rays enter and leave it."""
    T = look(angle)
    row, column = np.mgrid[: CAMERA.height, : CAMERA.width]
    rays = np.stack([(column - CAMERA.cx) / CAMERA.fx, (row - CAMERA.cy) / CAMERA.fy, np.ones(row.shape)], -1)
    rays = rays @ T[:3, :3].T + 1e-9
    ends = (np.stack([-HALF, HALF])[:, None, None] - T[:3, 3]) / rays
    enter, leave = ends.min(0).max(-1), ends.max(0).min(-1)
    shown = enter < leave
    depth = np.where(shown, enter, 4.0).astype(np.float32)
    color = np.full((*depth.shape, 3), 128, np.uint8)
    return Picture(CAMERA, inverse(T_world_board @ T), depth, color, shown.astype(np.uint16))


def points_on_board(pictures: list[Picture]) -> tuple[np.ndarray, np.ndarray]:
    """World points [n, 3] of the board's pixels and directions to the cameras."""
    found, toward = [], []
    for p in pictures:
        row, column = np.nonzero(p.labels)
        z = p.depth[row, column].astype(float)
        points = np.stack([(column - CAMERA.cx) / CAMERA.fx * z, (row - CAMERA.cy) / CAMERA.fy * z, z], 1)
        T = inverse(p.T_camera_world)
        found.append(transform_points(points, T))
        toward.append(T[:3, 3] - found[-1])
    points, ways = np.concatenate(found), np.concatenate(toward)
    return points, ways / np.linalg.norm(ways, axis=1, keepdims=True)


def visit(angles: tuple[int, ...], T_world_board: np.ndarray) -> tuple[Shape, CandidateViews]:
    pictures = [picture(angle, T_world_board) for angle in angles]
    points, toward = points_on_board(pictures)
    shape = Shape.from_views(points, np.full(points.shape, 0.5, np.float32), toward)
    return shape, CandidateViews(pictures, cKDTree(points), np.arange(len(points)), (1,))


def off(T: np.ndarray) -> tuple[float, float]:
    """Of a motion: metres at the board's middle, and degrees."""
    turn = (T @ inverse(MOVED))[:3, :3]
    return float(np.linalg.norm((T - MOVED)[:3, 3])), float(np.degrees(np.arccos(min(1, (np.trace(turn) - 1) / 2))))


@pytest.mark.parametrize("seen_first, seen_then, turned, within", [(FRONT, BACK, 0, 0.015), (FRONT, FRONT, 5, 0.004)])
def test_a_board_is_as_thick_as_it_is_whichever_side_was_seen(
    seen_first: tuple[int, ...], seen_then: tuple[int, ...], turned: float, within: float
) -> None:
    old, new = visit(seen_first, np.eye(4)), visit(seen_then, MOVED)
    start = MOVED.copy()
    start[:3, 3] += MOVED[:3, :3] @ [0.01, 2 * HALF[1], 0]  # its front laid upon its back
    start = start @ se3_exp(np.array([0, 0, 0, 0, 0, np.radians(turned)]))
    shift, turn = off(PoseRefinement(old[0], new[0], (old[1], new[1])).place(start, UP))
    assert shift < within and turn < 1.5


def test_faces_that_are_laid_upon_the_other_sides_are_where_they_cannot_be() -> None:
    old, new = visit(FRONT, np.eye(4)), visit(BACK, MOVED)
    placing = PoseRefinement(old[0], new[0], (old[1], new[1]))
    wrong = MOVED.copy()
    wrong[:3, 3] += MOVED[:3, :3] @ [0, 2 * HALF[1], 0]
    assert placing.cost(MOVED) < 0.3 * placing.cost(wrong)


def test_a_face_is_not_where_it_would_be_seen_from_behind() -> None:
    (front, _), (_, views) = visit((-90,), np.eye(4)), visit((90,), np.eye(4))
    upon = np.eye(4)
    upon[1, 3] = 2 * HALF[1]
    assert np.median(views.residuals(front).off) == 0
    assert np.median(views.residuals(front.move(upon)).off) > 0.005


def test_what_tilts_a_little_stands_upright() -> None:
    old, new = visit(FRONT, np.eye(4)), visit(FRONT, MOVED)
    leaning = MOVED @ se3_exp(np.array([0, 0, 0, np.radians(4), 0, 0]))
    T = PoseRefinement(old[0], new[0], (old[1], new[1])).place(leaning, UP)
    assert T[2, 2] > 1 - 1e-9 and off(T)[0] < 0.004


def test_it_is_placed_near_by_or_not_at_all() -> None:
    """The pictures agree most 12 cm away."""
    old, new = visit(FRONT, np.eye(4)), visit(FRONT, MOVED)
    start = MOVED.copy()
    start[0, 3] += 0.12
    T = PoseRefinement(old[0], new[0], (old[1], new[1])).place(start, UP)
    assert np.linalg.norm((T - start)[:3, 3]) < 0.08


def test_what_no_picture_shows_stays_where_it_was_found() -> None:
    old, new = visit(FRONT, np.eye(4)), visit(BACK, MOVED)
    none = CandidateViews([], cKDTree(new[0].points), np.arange(len(new[0])), (1,))
    assert np.array_equal(PoseRefinement(old[0], new[0], (old[1], none)).place(MOVED, UP), MOVED)
    assert len(old[1]) == len(FRONT) and not len(none)


@pytest.mark.parametrize("shift", [(0.02, 0, 0.01), (0, 0.06, 0), (0, -0.01, 0)])
def test_residuals_grow_as_they_say(shift: tuple[float, float, float]) -> None:
    """Of faces before and behind where they were measured, and of what reaches beyond the outline."""
    shape, views = visit(FRONT, np.eye(4))
    T, further = np.eye(4), np.eye(4)
    T[:3, 3] = shift
    step = 1e-5 * np.array([0.6, -0.7, 0.4])
    further[:3, 3] = T[:3, 3] + step
    one, other = views.residuals(shape.move(T)), views.residuals(shape.move(further))
    assert len(one.off) == len(other.off) and np.abs(one.off).max() > 0.005
    grown, told = other.off - one.off, one.along @ step
    moving = (one.off != 0) & (other.off != 0)
    assert np.mean(np.abs(grown - told)[moving] < 2e-7) > 0.9
