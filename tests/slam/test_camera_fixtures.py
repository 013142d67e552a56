# SPDX-License-Identifier: Apache-2.0
"""What is fixed to the camera is found, left out of map and surface, and nothing else is taken for it."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from ggslam.geometry.image_parts import is_in_image_part, parts_with_seeds
from ggslam.scene.camera import Camera
from ggslam.scene.frame import Frame
from ggslam.scene.poses import inverse, se3_exp, transform_points
from ggslam.sequences import open_sequence
from ggslam.sight.fixed_to_camera import count_comparisons, shrink_depth
from ggslam.slam.config import load_config
from ggslam.slam.filters.camera_fixtures import CameraFixtures, FixtureTuning, find_fixtures
from ggslam.slam.slam import Slam

CAMERA = Camera(160, 120, 130.0, 130.0, 79.5, 59.5)
TOOL = np.zeros((120, 160), bool)
TOOL[:50, 110:] = True


def wall(T_world_camera: np.ndarray, slant: float = 0.4) -> np.ndarray:
    """Depth of a wall, 2 m in front of the first camera."""
    normal = np.array([slant, 0.0, 1.0])
    rays = CAMERA.rays().astype(float) @ T_world_camera[:3, :3].T
    return ((2 - normal @ T_world_camera[:3, 3]) / (rays @ normal)).astype(np.float32)


def sideways(k: int) -> np.ndarray:
    return se3_exp(np.array([0.12 * k, 0.03 * (k % 3), 0.0, 0.0, 0.02 * k, 0.0]))


def frame(depth: np.ndarray, index: int) -> Frame:
    return Frame(index, index, 0.1 * index, np.zeros((120, 160, 3), np.uint8), depth, CAMERA)


def with_tool(depth: np.ndarray, distance: float = 0.15) -> np.ndarray:
    return np.where(TOOL, np.float32(distance), depth)


def look(
    depth_at: Callable[[np.ndarray], np.ndarray], views: int, pose: Callable[[int], np.ndarray] = sideways
) -> CameraFixtures:
    return find_fixtures((frame(depth_at(pose(k)), k) for k in range(views)), {k: pose(k) for k in range(views)})


def test_a_tool_is_found_within_four_views() -> None:
    found = look(lambda T: with_tool(wall(T)), 4)
    assert found.mask is not None and found.mask[TOOL].mean() > 0.98
    assert found.mask[~TOOL].mean() < 0.04  # a margin about it
    assert 0.2 < found.nearest < 0.25


@pytest.mark.parametrize(("size", "found"), [(1.0, True), (6.0, True), (60.0, False)])
def test_nothing_far_is_fixed_to_the_camera(size: float, found: bool) -> None:
    """The tool 0.15, 0.9 and 9 m away, in a scene that is larger by the same factor: the last is no tool."""

    def pose(k: int) -> np.ndarray:
        T = sideways(k)
        T[:3, 3] *= size
        return T

    frames = [frame(np.float32(size) * with_tool(wall(sideways(k))), k) for k in range(12)]
    assert (find_fixtures(frames, {k: pose(k) for k in range(12)}).mask is not None) == found


@pytest.mark.parametrize("slant", [0.0, 0.4])
def test_a_wall_is_never_taken_for_it(slant: float) -> None:
    """Also one along which the camera goes, so that every pixel's depth stays the same."""
    found = look(lambda T: wall(T, slant), 30)
    assert found.mask is None and found.views == FixtureTuning.max_views and not found.notes(1)


def test_a_pillar_that_stays_ahead_of_a_turning_camera_is_of_the_world() -> None:
    def depth_at(T: np.ndarray) -> np.ndarray:
        """A pillar before a wall, met where it is."""
        rays = CAMERA.rays().astype(float) @ T[:3, :3].T
        across = T[0, 3] + rays[..., 0] / rays[..., 2] * (1 - T[2, 3])
        return np.where(np.abs(across) < 0.1, ((1 - T[2, 3]) / rays[..., 2]).astype(np.float32), wall(T, 0.0))

    # Moves to the right and turns to the left, so that the pillar stays in the middle.
    found = look(depth_at, 12, lambda k: se3_exp(np.array([0.08 * k, 0.0, 0.0, 0.0, -0.08 * k, 0.0])))
    assert found.mask is None


def test_two_views_say_what_they_see() -> None:
    T = sideways(1)
    here, there = with_tool(wall(T)), with_tool(wall(np.eye(4)))
    counts = np.zeros((3, *there.shape), np.int32)
    count_comparisons(here, T, [(there, np.eye(4))], CAMERA, counts)
    fixed, still, world = counts
    assert (still[TOOL] == 2).all()
    # The tool would be outside of the other image as one of the two sees it.
    assert fixed.max() == 1 and fixed[TOOL].mean() > 0.2 and not fixed[~TOOL].any()
    assert not world[TOOL].any() and world[~TOOL].mean() > 1
    small, camera = shrink_depth(here, CAMERA, 2)
    assert small.shape == (60, 80) and small[0, -1] == np.float32(0.15)
    ray = camera.rays()[10, 20] - CAMERA.rays()[20:22, 40:42].mean((0, 1))
    assert np.abs(ray).max() < 1e-6  # the middle of its four pixels
    assert shrink_depth(np.zeros((120, 160)), CAMERA, 4)[0].max() == 0


def test_parts_without_seeds_go() -> None:
    candidates, seeds = np.zeros((20, 20), bool), np.zeros((20, 20), bool)
    candidates[2:6, 2:6] = candidates[10:14, 10:14] = True
    seeds[3, 3] = True
    found = parts_with_seeds(seeds, candidates, 0.05)
    assert found[2:6, 2:6].all() and found.sum() == 16
    assert not parts_with_seeds(seeds, candidates, 0.5).any()


def test_frames_lose_it_and_others_stay_as_they_are() -> None:
    fixtures = look(lambda T: with_tool(wall(T)), 4)
    depth = with_tool(wall(np.eye(4)))
    depth[100, 10] = 0.16  # a flying pixel far from it
    cleaned = fixtures.clean(frame(depth, 9))
    assert not cleaned.depth[TOOL].any() and cleaned.depth[100, 10] == 0 and cleaned.depth[100, 20] > 1
    assert cleaned.valid is not None and not cleaned.valid[TOOL].any() and cleaned.valid[100, 10]
    assert len(fixtures.notes(1)) == 1
    given = frame(wall(np.eye(4)), 0)
    assert CameraFixtures().clean(given) is given


def test_a_lost_camera_begins_anew() -> None:
    fixtures = CameraFixtures()
    for k in range(3):
        fixtures.clean(frame(with_tool(wall(sideways(k))), k))
        fixtures.follow(CAMERA, None if k == 1 else sideways(k))
    assert fixtures.views == 2 and fixtures.comparisons == 0 and fixtures.mask is None


def test_points_of_an_image_part() -> None:
    points = np.array([[0.1, -0.05, 0.2], [-0.1, 0.05, 0.2], [0.1, -0.05, -0.2], [9.0, -9.0, 0.2]])
    assert is_in_image_part(points, TOOL, CAMERA).tolist() == [True, False, False, False]


def test_a_run_leaves_it_out(room: Path) -> None:
    """Of the first keyframes, too, which were mapped before it was known."""
    sequence = open_sequence(room)
    part = np.zeros((sequence.camera.height, sequence.camera.width), bool)
    part[: len(part) // 3, : part.shape[1] // 3] = True
    settings = ["mapping.iterations_per_frame=1", "refine_iterations=0", "masks.source=none", "keyframes.max_gap=1"]
    slam = Slam(sequence.camera, load_config(None, settings))
    for index in range(0, 16, 2):
        given = sequence.frame(index)
        color = np.where(part[..., None], np.uint8(200), given.color)
        slam.step(dataclasses.replace(given, color=color, depth=np.where(part, np.float32(0.2), given.depth)))
    result = slam.finish()
    mask = slam.filters.get(CameraFixtures).mask
    assert mask is not None and mask[part].mean() > 0.95
    assert any("fixed to the camera" in note for note in result.notes)
    means, birth = result.gaussians.means.numpy(), result.gaussians.birth_keyframe.numpy()
    assert len(result.keyframes) > 3
    for keyframe in result.keyframes:
        assert not keyframe.depth[mask].any()
        own = transform_points(means[birth == keyframe.index], keyframe.T_camera_world)
        assert len(own) == 0 or own[:, 2].min() > 0.3
        seen = transform_points(slam.surface.points([keyframe.index]), inverse(slam.surface.poses[keyframe.index]))
        assert len(seen) and seen[:, 2].min() > 0.3
