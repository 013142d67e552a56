# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

import numpy as np
import pytest

from ggslam.errors import FormatError
from ggslam.native.loader import NativeContext
from ggslam.scene.camera import Camera
from ggslam.scene.poses import quaternion_to_matrix, se3_exp
from ggslam.tracking.gicp import GicpTarget, align
from ggslam.tracking.points import extract_points
from ggslam.tracking.settings import DepthNoise, TrackerSettings
from ggslam.tracking.surface import MeasuredSurface, quaternions_from_normals

CAMERA = Camera(160, 120, 130.0, 130.0, 79.5, 59.5)


def corner_depth(T_world_camera: np.ndarray) -> np.ndarray:
    """Depth of the inside of a corner (planes x = 1.5, y = 1, z = 3) seen from a pose."""
    rays = CAMERA.rays().astype(float) @ T_world_camera[:3, :3].T
    origin = T_world_camera[:3, 3]
    distances = (np.array([1.5, 1.0, 3.0]) - origin) / np.where(rays > 1e-9, rays, 1e-9)
    return distances.min(-1).astype(np.float32)


def test_quaternions_turn_z_to_the_normal() -> None:
    normals = np.random.default_rng(0).normal(size=(50, 3))
    normals = np.concatenate([normals / np.linalg.norm(normals, axis=1, keepdims=True), [[0, 0, -1.0], [0, 0, 1.0]]])
    assert np.allclose(quaternion_to_matrix(quaternions_from_normals(normals))[:, :, 2], normals, atol=1e-6)


def test_gathering_in_steps_is_gathering_at_once() -> None:
    rng = np.random.default_rng(1)
    settings, context = TrackerSettings().target, NativeContext(2)
    means = np.float32(rng.uniform(-1, 1, (6000, 3)) * [1, 1, 0.01])
    quaternions = np.tile(np.float32([1, 0, 0, 0]), (6000, 1))
    scales = np.tile(np.log(np.float32([0.01, 0.01, 0.001])), (6000, 1))
    logits = np.full(6000, 3, np.float32)
    arrays = (means, quaternions, scales, logits)
    together = GicpTarget.from_arrays(*arrays, settings, context)
    first = GicpTarget.from_arrays(*(a[:2500].copy() for a in arrays), settings, context)
    size_of_first = len(first)
    both = GicpTarget.from_arrays(*(a[2500:].copy() for a in arrays), settings, context, base=first)
    assert len(first) == size_of_first < len(both) == len(together)  # the earlier target is as it was
    for level in (0, 1):
        a, b = (target.voxels(level) for target in (both, together))
        order_a, order_b = (np.lexsort(np.round(v["means"], 4).T) for v in (a, b))
        for name in ("means", "weights", "normals", "covariances"):
            assert np.allclose(a[name][order_a], b[name][order_b], rtol=1e-3, atol=2e-4), name


@pytest.mark.parametrize("threads", [1, 3])
def test_shapes_taken_over_are_those_computed(threads: int) -> None:
    rng = np.random.default_rng(2)
    settings, context = TrackerSettings().target, NativeContext(threads)
    means = np.float32(rng.uniform(-1, 1, (9000, 3)) * [1, 1, 0.05])
    quaternions = np.tile(np.float32([1, 0, 0, 0]), (9000, 1))
    scales = np.tile(np.log(np.float32([0.01, 0.01, 0.001])), (9000, 1))
    arrays = (means, quaternions, scales, np.full(9000, 3, np.float32))
    chosen = means[:, 0] < rng.choice([0.5, 0.6], 9000)
    for rows, others in ((slice(None), chosen), (chosen, slice(None)), (chosen, means[:, 1] > 0)):
        alone, like = (GicpTarget.from_arrays(*(np.ascontiguousarray(a[part]) for a in arrays), settings, context)
                       for part in (rows, others))  # fmt: skip
        given = [np.ascontiguousarray(a[rows]) for a in arrays]
        found = GicpTarget.from_arrays(*given, settings, context, like=like)
        for level in (0, 1):
            for name, values in alone.voxels(level).items():
                assert np.array_equal(found.voxels(level)[name], values), name


@pytest.mark.parametrize("threads", [1, 3])
def test_a_new_view_of_a_measured_corner_is_located(threads: int) -> None:
    settings, context = TrackerSettings(), NativeContext(threads)
    surface = MeasuredSurface(settings.target, context)
    for twist in ([0, 0, 0, 0, 0, 0], [0.1, 0.05, 0, 0.02, 0.1, 0]):
        T = se3_exp(np.array(twist, float))
        surface.add(extract_points(corner_depth(T), CAMERA, settings.points, DepthNoise(), context), T)
    assert surface.target is not None
    truth = se3_exp(np.array([0.08, -0.05, 0.1, 0.05, 0.05, -0.03]))
    points = extract_points(corner_depth(truth), CAMERA, settings.points, DepthNoise(), context)
    guess = se3_exp(np.array([0.03, 0.02, -0.02, 0.02, -0.02, 0.01])) @ truth
    found = align(points, surface.target, guess, settings.align, DepthNoise(), context)
    assert np.linalg.norm(found.T_world_camera[:3, 3] - truth[:3, 3]) < 1e-3
    assert found.overlap > 0.8


def test_keyframes_can_be_moved_and_put_aside() -> None:
    settings, context = TrackerSettings(), NativeContext(2)
    poses = [se3_exp(np.array(t, float)) for t in ([0] * 6, [0.1, 0, 0, 0, 0.1, 0], [0, 0.1, 0, 0.1, 0, 0])]
    points = [extract_points(corner_depth(T), CAMERA, settings.points, DepthNoise(), context) for T in poses]
    surface, moved = (MeasuredSurface(settings.target, context) for _ in range(2))
    shift = se3_exp(np.array([0.5, -0.2, 0.1, 0.3, 0.0, 0.2]))
    for T, p in zip(poses, points, strict=True):
        surface.add(p, T)
        moved.add(p, shift @ T)
    two = surface.arrange({0, 2})
    only = MeasuredSurface(settings.target, context)
    only.add(points[0], poses[0])
    assert len(two) == len(only.add(points[2], poses[2])) and surface.active == {0, 2}
    assert len(two) == len(moved.of([0, 2])) or abs(len(two) - len(moved.of([0, 2]))) < 0.1 * len(two)
    np.testing.assert_array_equal(surface.points([0, 1]).shape, (len(points[0]) + len(points[1]), 3))
    again = surface.arrange({0, 1, 2}, np.stack([shift @ T for T in poses]))
    assert moved.target is not None
    a, b = (np.sort(target.voxels()["means"], axis=0) for target in (again, moved.target))
    np.testing.assert_allclose(a, b, atol=1e-4)


def test_what_was_begun_is_what_is_added() -> None:
    settings, context = TrackerSettings(), NativeContext(2)
    poses = [se3_exp(np.array(t, float)) for t in ([0] * 6, [0.1, 0, 0, 0, 0.1, 0], [0, 0.1, 0, 0.1, 0, 0])]
    points = [extract_points(corner_depth(T), CAMERA, settings.points, DepthNoise(), context) for T in poses]
    plain, begun, misled = (MeasuredSurface(settings.target, context) for _ in range(3))
    for number, (T, p) in enumerate(zip(poses, points, strict=True)):
        plain.add(p, T)
        begun.begin(p, T)
        begun.add(p, T)
        misled.begin(points[0], poses[2])  # something else is added then...
        misled.add(p, T)
        misled.begin(p, T)
        misled.arrange(set(range(number)))  # ...or to something else
        misled.arrange(set(range(number + 1)))
    for surface in (begun, misled):
        assert surface.target is not None and plain.target is not None and surface.active == plain.active
        assert len(surface) == 3 and len(surface.target) == len(plain.target)
    for level in (0, 1):
        a, b = begun.target.voxels(level), plain.target.voxels(level)
        assert all(a[name].tobytes() == b[name].tobytes() for name in a)
    begun.gather_again()
    assert begun.target.voxels()["means"].tobytes() == plain.target.voxels()["means"].tobytes()


def test_a_surface_comes_back_from_its_arrays() -> None:
    settings, context = TrackerSettings(), NativeContext(2)
    surface, again = (MeasuredSurface(settings.target, context) for _ in range(2))
    for twist in ([0.0] * 6, [0.1, 0.05, 0, 0.02, 0.1, 0]):
        T = se3_exp(np.array(twist))
        surface.add(extract_points(corner_depth(T), CAMERA, settings.points, DepthNoise(), context), T)
    again.load(surface.to_arrays())
    assert again.target is not None and surface.target is not None and again.active == {0, 1}
    np.testing.assert_allclose(again.points([0, 1]), surface.points([0, 1]), atol=2e-4)
    truth = se3_exp(np.array([0.08, -0.05, 0.1, 0.05, 0.05, -0.03]))
    points = extract_points(corner_depth(truth), CAMERA, settings.points, DepthNoise(), context)
    found = align(points, again.target, truth, settings.align, DepthNoise(), context)
    assert np.linalg.norm(found.T_world_camera[:3, 3] - truth[:3, 3]) < 1e-3 and found.overlap > 0.8
    with pytest.raises(FormatError, match=r"'normals': .*int8 \[points, 3\]"):
        again.load({**surface.to_arrays(), "normals": np.zeros((3, 3), np.int8)})
