# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

import ctypes

import gicp_reference as reference
import numpy as np
import pytest

from ggslam.abi.arrays import address
from ggslam.native.loader import NativeContext, available_instruction_sets, load_library
from ggslam.scene.camera import Camera
from ggslam.scene.poses import inverse, se3_exp, se3_log
from ggslam.tracking.gicp import AlignmentStatus, GicpTarget, GicpTuning, align, native_align_settings, native_points
from ggslam.tracking.observability import about_point
from ggslam.tracking.points import FramePoints, extract_points, grid_stride
from ggslam.tracking.settings import AlignSettings, DepthNoise, PointSettings, TargetSettings
from ggslam.tracking.surface import quaternions_from_normals

CAMERA = Camera(160, 120, 130.0, 130.0, 79.5, 59.5)
NOISE = DepthNoise()
SETTINGS = AlignSettings()


def room_depth(T_world_camera: np.ndarray, planes: tuple[float, float, float] = (1.5, 1.0, 3.0)) -> np.ndarray:
    """Depth of the inside of a corner (planes x, y, z = const) with a ball in it."""
    rays = CAMERA.rays().astype(float) @ T_world_camera[:3, :3].T
    origin = T_world_camera[:3, 3]
    depth = ((np.array(planes) - origin) / np.where(rays > 1e-9, rays, 1e-9)).min(-1)
    offset = origin - np.array([-0.4, 0.3, 2.2])
    a, b, c = (rays**2).sum(-1), rays @ offset, offset @ offset - 0.4**2
    root = b * b - a * c
    ball = np.where(root > 0, (-b - np.sqrt(np.maximum(root, 0))) / a, np.inf)
    return np.minimum(depth, ball).astype(np.float32)


def discs(points: FramePoints, T: np.ndarray, size: float = 0.006) -> tuple[np.ndarray, ...]:
    """Points as Gaussians of the map: means, quaternions, log scales, opacity logits."""
    normals = points.normals @ T[:3, :3].T
    means = points.points @ T[:3, :3].T + T[:3, 3]
    scales = np.log(np.tile([size, size, 0.2 * size], (len(points), 1)))
    arrays = (means, quaternions_from_normals(normals), scales, np.full(len(points), 2.0))
    return tuple(np.ascontiguousarray(a, np.float32) for a in arrays)


def room_target(context: NativeContext) -> GicpTarget:
    T = np.eye(4)
    points = extract_points(room_depth(T), CAMERA, PointSettings(count=19200), NOISE, context)
    return GicpTarget.from_arrays(*discs(points, T), TargetSettings(), context)


def room_points(T: np.ndarray, context: NativeContext) -> FramePoints:
    return extract_points(room_depth(T), CAMERA, PointSettings(), NOISE, context)


@pytest.fixture(scope="module")
def context() -> NativeContext:
    return NativeContext(2)


# --- linearisation ---------------------------------------------------------------------------------------------------


def kernel_linearization(
    points: FramePoints, target: GicpTarget, T: np.ndarray, context: NativeContext
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """H, b, matches of the fine level."""
    H, b = np.empty((6, 6)), np.empty(6)
    match, squared = np.empty(len(points), np.int32), np.empty(len(points), np.float32)
    pose = np.ascontiguousarray(T)
    load_library().ggslam_gicp_linearize(
        context.handle, target.handle, native_points(points), ctypes.byref(native_align_settings(SETTINGS, NOISE)), 0,
        *(address(a) for a in (pose, match, squared, H, b)),
    )  # fmt: skip
    return H, b, match


def test_normal_equations_agree_with_numpy_and_finite_differences(context: NativeContext) -> None:
    target, truth = room_target(context), se3_exp(np.array([0.05, -0.02, 0.03, 0.02, 0.01, -0.02]))
    points = room_points(truth, context)
    T = se3_exp(np.array([0.01, 0.005, -0.01, 0.004, -0.005, 0.003])) @ truth
    H, b, match = kernel_linearization(points, target, T, context)
    voxels, used = target.voxels(), match >= 0
    assert used.mean() > 0.6
    M = reference.match_precisions(
        reference.unpack(points.covariances.astype(float))[used],
        reference.unpack(voxels["covariances"].astype(float))[match[used]], T[:3, :3],
    )  # fmt: skip
    given = (points.points[used].astype(float), points.weights[used].astype(float), voxels["means"][match[used]], M)
    H_reference, b_reference = reference.normal_equations(*given, T, SETTINGS, NOISE, GicpTuning.plane_variance)
    assert np.allclose(H, H_reference, rtol=1e-3, atol=1e-3 * np.abs(H_reference).max())
    assert np.allclose(b, b_reference, rtol=1e-3, atol=1e-3 * np.abs(b_reference).max())
    centre, gradient = T[:3, 3], np.zeros(6)
    for k in range(6):
        values = []
        for step in (1e-6, -1e-6):
            twist = np.zeros(6)
            twist[k] = step
            moved = se3_exp(np.r_[np.zeros(3), twist[3:]]) @ T
            moved[:3, 3] = centre + twist[:3]
            values.append(reference.cost(*given, moved, SETTINGS, NOISE, GicpTuning.plane_variance))
        gradient[k] = (values[0] - values[1]) / 2e-6
    assert np.allclose(-2 * b, gradient, rtol=2e-3, atol=2e-3 * np.abs(gradient).max())


def test_matches_are_the_nearest_voxels_with_a_like_normal(context: NativeContext) -> None:
    target, T = room_target(context), se3_exp(np.array([0.02, 0.01, 0, 0.01, 0, 0.02]))
    points = room_points(T, context)
    _, _, match = kernel_linearization(points, target, T, context)
    voxels = target.voxels()
    world, normals = points.points @ T[:3, :3].T + T[:3, 3], points.normals @ T[:3, :3].T
    some = slice(None, None, 20)
    expected = reference.nearest_voxels(
        world[some], normals[some], voxels["means"], voxels["normals"], target.voxel, SETTINGS.min_normal_dot
    )
    assert (match[some] == expected).mean() > 0.995  # ties within rounding


# --- alignment -------------------------------------------------------------------------------------------------------


def test_align_finds_the_pose_from_ten_centimetres_and_five_degrees(context: NativeContext) -> None:
    target, truth = room_target(context), se3_exp(np.array([0.05, -0.02, 0.03, 0.02, 0.01, -0.02]))
    guess = se3_exp(np.array([0.06, -0.05, 0.04, 0.05, -0.04, 0.05])) @ truth
    found = align(room_points(truth, context), target, guess, SETTINGS, NOISE, context)
    error = se3_log(inverse(truth) @ found.T_world_camera)
    assert found.status is AlignmentStatus.OK
    assert np.linalg.norm(error[:3]) < 1e-3
    assert np.linalg.norm(error[3:]) < 1e-3
    assert found.overlap > 0.9
    assert found.rmse < 2e-3
    assert (found.matches.read().voxels >= 0).mean() > 0.9


def test_the_result_is_the_same_for_any_number_of_threads() -> None:
    truth = se3_exp(np.array([0.05, -0.02, 0.03, 0.02, 0.01, -0.02]))
    results = []
    for threads in (1, 2, 3):
        context = NativeContext(threads)
        found = align(room_points(truth, context), room_target(context), np.eye(4), SETTINGS, NOISE, context)
        matches = found.matches.read()
        results.append((found.T_world_camera, found.information, matches.voxels, matches.squared_distances))
    for other in results[1:]:
        assert all(np.array_equal(a, b) for a, b in zip(results[0], other, strict=True))


@pytest.mark.parametrize("name", available_instruction_sets())
def test_every_instruction_set_finds_the_same_pose(name: str) -> None:
    truth = se3_exp(np.array([0.05, -0.02, 0.03, 0.02, 0.01, -0.02]))
    context = NativeContext(2, name)
    found = align(room_points(truth, context), room_target(context), np.eye(4), SETTINGS, NOISE, context)
    assert np.allclose(found.T_world_camera, truth, atol=1e-3)


def test_a_bare_wall_is_degenerate_and_a_corner_is_not(context: NativeContext) -> None:
    wall = np.full((CAMERA.height, CAMERA.width), 2.0, np.float32)
    points = extract_points(wall, CAMERA, PointSettings(count=19200), NOISE, context)
    target = GicpTarget.from_arrays(*discs(points, np.eye(4)), TargetSettings(), context)
    found = align(points, target, np.eye(4), SETTINGS, NOISE, context)
    assert found.status is AlignmentStatus.DEGENERATE
    assert found.degenerate
    assert len(found.weak_directions) == 3  # both shifts in the plane and the turn about its normal
    assert np.abs(found.weak_directions[:, [2, 3, 4]]).max() < 0.1
    assert not align(
        room_points(np.eye(4), context), room_target(context), np.eye(4), SETTINGS, NOISE, context
    ).degenerate


def test_information_moves_to_another_centre() -> None:
    rng = np.random.default_rng(0)
    centre = rng.normal(size=3)
    A = rng.normal(size=(6, 6))
    information = A @ A.T
    twist = rng.normal(size=6) * 1e-3  # about the origin
    at_centre = np.r_[twist[:3] + np.cross(twist[3:], centre), twist[3:]]
    assert np.isclose(twist @ about_point(information, centre) @ twist, at_centre @ information @ at_centre)


@pytest.mark.parametrize("depth", [0.0, np.nan])
def test_without_points_the_alignment_is_lost(context: NativeContext, depth: float) -> None:
    empty = np.full((CAMERA.height, CAMERA.width), depth, np.float32)
    points = extract_points(empty, CAMERA, PointSettings(), NOISE, context)
    assert len(points) == 0
    found = align(points, room_target(context), np.eye(4), SETTINGS, NOISE, context)
    assert found.status is AlignmentStatus.LOST
    assert np.array_equal(found.T_world_camera, np.eye(4))


def test_far_away_the_alignment_is_lost(context: NativeContext) -> None:
    away = se3_exp(np.array([50.0, 0, 0, 0, 0, 0]))
    found = align(room_points(np.eye(4), context), room_target(context), away, SETTINGS, NOISE, context)
    assert found.status is AlignmentStatus.LOST
    assert found.overlap == 0.0


# --- points ----------------------------------------------------------------------------------------------------------


def test_points_have_the_shape_of_their_neighbours(context: NativeContext) -> None:
    depth = room_depth(np.eye(4)) + np.random.default_rng(0).normal(0, 2e-3, (120, 160)).astype(np.float32)
    found = extract_points(depth, CAMERA, PointSettings(), NOISE, context)
    compared = 0
    for i in range(0, len(found), 37):
        u, v = (int(x) for x in found.pixels[i])
        expected = reference.point_shape(depth, CAMERA, (u, v), PointSettings(), NOISE)
        assert expected is not None
        values = np.linalg.eigvalsh(expected[1])
        if values[1] < 3 * values[0]:
            continue  # no clear normal
        compared += 1
        assert np.allclose(found.normals[i], expected[0], atol=2e-3)
        assert np.allclose(reference.unpack(found.covariances[i : i + 1])[0], expected[1], atol=0.02)
    assert compared > 50


def test_neighbours_across_an_edge_do_not_bend_the_normal(context: NativeContext) -> None:
    depth = np.full((120, 160), 2.0, np.float32)
    depth[:, 80:] = 3.0
    found = extract_points(depth, CAMERA, PointSettings(count=19200), NOISE, context)
    assert (np.abs(found.pixels[:, 0] - 79.5) < 2).any()
    assert np.allclose(found.normals, [0, 0, -1], atol=1e-3)


def test_the_number_of_points_depends_neither_on_resolution_nor_on_holes(context: NativeContext) -> None:
    counts = []
    for scale in (2, 4, 8):
        for known in (1.0, 0.3):  # share of the image with depth
            camera = CAMERA.scale(scale)
            depth = np.full((camera.height, camera.width), 2.0, np.float32)
            depth[:, round(known * camera.width) :] = 0
            counts.append(len(extract_points(depth, camera, PointSettings(count=5000), NOISE, context)))
    assert min(counts) > 3900
    assert max(counts) < 6100
    assert grid_stride(320 * 240, 5000) == 4


def test_depth_of_another_size_is_refused(context: NativeContext) -> None:
    with pytest.raises(ValueError, match=r"\(10, 10\).*\(120, 160\)"):
        extract_points(np.ones((10, 10), np.float32), CAMERA, PointSettings(), NOISE, context)


# --- target ----------------------------------------------------------------------------------------------------------


def test_voxel_means_are_weighted_by_opacity_and_size(context: NativeContext) -> None:
    rng = np.random.default_rng(3)
    n, settings = 3000, TargetSettings()
    means = np.float32(rng.uniform(-0.2, 0.2, (n, 3)))
    quaternions = np.tile(np.float32([1, 0, 0, 0]), (n, 1))
    log_scales = np.log(np.float32(rng.uniform([4e-3, 4e-3, 5e-4], [9e-3, 9e-3, 1e-3], (n, 3))))
    logits = np.float32(rng.uniform(-4, 4, n))
    target = GicpTarget.from_arrays(means, quaternions, log_scales, logits, settings, context)
    expected = reference.voxel_means(means, log_scales, logits, settings.voxel, settings.min_opacity)
    found = target.voxels()["means"]
    assert len(found) == len(expected)
    cells = [tuple(c) for c in np.floor(found / settings.voxel).astype(int)]
    assert np.allclose(found, [expected[c] for c in cells], atol=1e-5)


@pytest.mark.parametrize("trained", [False, True])
def test_plane_like_gaussians_stay_plane_like(context: NativeContext, trained: bool) -> None:
    """The public G-ICP Gaussian SLAM makes a sphere of every Gaussian smaller than 3.2 cm; these are 6 mm."""
    points = extract_points(np.full((120, 160), 2.0, np.float32), CAMERA, PointSettings(count=19200), NOISE, context)
    means, quaternions, log_scales, logits = discs(points, np.eye(4))
    if trained:
        rng = np.random.default_rng(0)
        means = means + np.float32(rng.normal(0, [1.5e-3, 1.5e-3, 0.5e-3], means.shape))
        quaternions = quaternions + np.float32(rng.normal(0, np.radians(3) / 2, quaternions.shape))
        log_scales = log_scales + np.float32(rng.normal(0, 0.3, log_scales.shape))
    target = GicpTarget.from_arrays(means, quaternions, log_scales, logits, TargetSettings(), context)
    for level in (0, 1):
        voxels = target.voxels(level)
        values = np.linalg.eigvalsh(reference.unpack(voxels["covariances"].astype(float)))
        assert np.allclose(values[:, 1], 1, atol=1e-3)
        assert values[:, 0].max() < 0.02  # thickness, of a median of 1
        assert values[:, 2].max() <= 4.01
        assert (voxels["normals"][:, 2] < -0.99).mean() > 0.98


def test_shapes_of_gaussians_keep_thickness_and_elongation_in_bounds() -> None:
    rng = np.random.default_rng(0)
    quaternions = rng.normal(size=(100, 4))
    log_scales = rng.uniform(np.log(1e-5), np.log(0.1), (100, 3))
    _, shapes = reference.gaussian_shapes(quaternions, log_scales, TargetSettings())
    values = np.linalg.eigvalsh(shapes)
    assert values.min() >= 0.01 - 1e-6
    assert values.max() <= 4 + 1e-6


def test_normals_turn_to_the_camera_that_saw_them(context: NativeContext) -> None:
    points = extract_points(np.full((120, 160), 2.0, np.float32), CAMERA, PointSettings(), NOISE, context)
    means, quaternions, log_scales, logits = discs(points, np.eye(4))
    away = np.float32(quaternions_from_normals(-points.normals))
    birth = np.zeros(len(means), np.int32)
    target = GicpTarget.from_arrays(
        means, away, log_scales, logits, TargetSettings(), context, birth, np.zeros((1, 3), np.float32)
    )
    assert (target.voxels()["normals"][:, 2] < -0.99).all()


def test_transparent_distant_and_broken_gaussians_take_no_part(context: NativeContext) -> None:
    broken = [[np.nan, 0, 1], [0, np.inf, 1], [0, 0, np.nan], [1e9, 0, 0]]
    means = np.float32([[0, 0, 1], [0, 0, 2], *broken, [0, 0, 3], [0, 0, 3], [0, 0, 3]])
    n = len(means)
    quaternions, log_scales = np.tile(np.float32([1, 0, 0, 0]), (n, 1)), np.full((n, 3), -5, np.float32)
    quaternions[6], quaternions[7], log_scales[8, 1] = np.nan, 0, np.inf
    logits = np.full(n, 3, np.float32)
    logits[1] = -9
    target = GicpTarget.from_arrays(means, quaternions, log_scales, logits, TargetSettings(), context)
    assert len(target) == 1
    assert np.allclose(target.voxels()["means"], [[0, 0, 1]])
