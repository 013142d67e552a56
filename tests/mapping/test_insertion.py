# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

import cv2
import numpy as np
import pytest
from insertion_reference import grid_selection, surface_normals
from insertion_reference import new_gaussians as reference

from ggslam.errors import InputError
from ggslam.mapping.cpu.insertion import find_unexplained, new_gaussians
from ggslam.mapping.settings import InsertionSettings
from ggslam.native.loader import NativeContext, available_instruction_sets
from ggslam.scene.camera import Camera
from ggslam.scene.poses import quaternion_to_matrix, se3_exp

CAMERA = Camera(64, 48, 60.0, 60.0, 31.5, 23.5)


def plane_depth(normal: np.ndarray, distance: float) -> np.ndarray:
    """Depth of the plane n.x = -distance seen by CAMERA."""
    return (-distance / (CAMERA.rays() @ normal)).astype(np.float32)


def normals_of(depth: np.ndarray) -> np.ndarray:
    return surface_normals(depth, CAMERA, np.arange(depth.size)).reshape(*depth.shape, 3)


@pytest.mark.parametrize("tilt", [0.0, 0.5, 1.0])
def test_discs_lie_in_the_surface(tilt: float) -> None:
    normal = np.array([0.0, -np.sin(tilt), -np.cos(tilt)])
    depth = plane_depth(normal, 2.0)
    inner = normals_of(depth)[6:-6, 6:-6].reshape(-1, 3)
    assert np.abs(inner - normal).max() < 1e-3
    T = se3_exp(np.array([0.3, -0.2, 0.5, 0.2, 0.4, -0.3]))
    where = np.zeros((48, 64), bool)
    where[10:30, 10:40] = True
    s = InsertionSettings(flatness=0.2, adaptive_stride=False)
    new = new_gaussians(np.full((48, 64, 3), 128, np.uint8), depth, CAMERA, T, where, s)
    assert len(new.means) == where.sum()
    R = quaternion_to_matrix(new.quaternions.astype(float))
    smallest = np.argmin(new.log_scales, 1)
    axis = R[np.arange(len(R)), :, smallest]
    assert np.abs(np.abs(axis @ (T[:3, :3] @ normal)) - 1).max() < 1e-3
    # means lie on the plane, in world coordinates
    in_camera = (new.means - T[:3, 3]) @ T[:3, :3]
    assert np.abs(in_camera @ normal + 2.0).max() < 1e-5
    # the footprint is stretched along the slope and nowhere else
    scales = np.sort(np.exp(new.log_scales), 1)
    footprint = s.scale_pixels * in_camera[:, 2] / 60.0
    assert np.allclose(scales[:, 1], footprint, rtol=1e-4) and np.all(scales[:, 2] <= s.max_slope * footprint * 1.001)
    assert np.allclose(scales[:, 0], 0.2 * footprint, rtol=1e-4)


def test_no_gaussian_without_depth_and_none_at_jumps_has_a_false_normal() -> None:
    depth = np.full((48, 64), 1.0, np.float32)
    depth[:, 32:] = 3.0
    depth[:5] = 0
    normals = normals_of(depth)
    assert np.abs(normals[20, 31:33]).max() == 0  # at the jump
    new = new_gaussians(
        np.zeros((48, 64, 3), np.uint8), depth, CAMERA, np.eye(4), np.ones((48, 64), bool), InsertionSettings()
    )
    assert len(new.means) and np.isfinite(new.means).all() and np.isfinite(new.quaternions).all()
    assert np.all(new.pixels >= 5 * 64)


def test_unexplained_is_alpha_or_something_in_front() -> None:
    s = InsertionSettings(alpha_threshold=0.5, depth_tolerance_m=0.05, depth_tolerance_relative=0.03)
    depth = np.array([[1.0, 1.0, 1.0, 1.0]], np.float32)
    alpha = np.array([[0.2, 1.0, 1.0, 1.0]], np.float32)
    rendered = np.array([[1.0, 1.0, 1.2, 0.5]], np.float32)
    assert find_unexplained(depth, alpha, rendered, s).tolist() == [[True, False, True, False]]


def test_adaptive_stride_thins_flat_regions_only() -> None:
    rng = np.random.default_rng(0)
    color = np.full((48, 64, 3), 100, np.uint8)
    color[:, 32:] = rng.integers(0, 255, (48, 32, 3))
    depth = np.ones((48, 64), np.float32)
    chosen, stride = grid_selection(color, depth, InsertionSettings(adaptive_stride=True))
    assert chosen[8:40, 40:56].all() and (stride[8:40, 40:56] == 1).all()
    assert chosen[8:40, 4:24].mean() == 0.25 and (stride[8:40, 4:24] == 2).all()
    new = new_gaussians(color, depth, CAMERA, np.eye(4), None, InsertionSettings(adaptive_stride=True))
    assert np.array_equal(new.pixels, np.flatnonzero(chosen))


# --- the compiled core against the reference --------------------------------------------------------------------------

POSE = se3_exp(np.array([0.3, -0.2, 0.5, 0.2, 0.4, -0.3]))
SIZES = [(37, 53), (48, 64), (1, 20), (20, 1), (2, 2), (1, 1), (2, 19), (3, 70), (5, 5), (120, 161)]


def make_images(height: int, width: int, holes: float = 0.02) -> tuple[np.ndarray, np.ndarray, np.ndarray, Camera]:
    """Colour, depth, where to insert, and the camera of a sloped floor with a box in front of it, textured on half of
    it, with holes large and small."""
    rng = np.random.default_rng(height * 1000 + width)
    v, u = np.mgrid[0:height, 0:width].astype(np.float32)
    depth = 1.5 + 0.01 * u + 0.6 * v / height + rng.normal(0, 5e-4, (height, width)).astype(np.float32)
    depth[height // 3 : height // 2, width // 4 : width // 2] = 0.9
    depth[rng.random((height, width)) < holes] = 0
    depth[2 * height // 3 : 2 * height // 3 + 9, width // 2 : width // 2 + 14] = 0
    depth[:, -1] = 30  # too far away
    color = np.full((height, width, 3), 120, np.uint8)
    color[:, width // 2 :] = rng.integers(0, 256, (height, width - width // 2, 3))
    color = cv2.blur(color, (3, 3))
    camera = Camera(width, height, 60.0, 61.5, 0.5 * width - 0.3, 0.5 * height + 0.2)
    return color, depth.astype(np.float32), rng.random((height, width)) < 0.8, camera


def check_same(color: np.ndarray, depth: np.ndarray, where: np.ndarray, camera: Camera, s: InsertionSettings,
               context: NativeContext | None = None) -> int:  # fmt: skip
    found = new_gaussians(color, depth, camera, POSE, where, s, context)
    expected = reference(color, depth, camera, POSE, where, s)
    assert np.array_equal(found.pixels, expected.pixels)
    for name, tolerance in (("means", 2e-6), ("log_scales", 2e-5), ("rgb", 1e-7)):
        assert np.allclose(getattr(found, name), getattr(expected, name), rtol=0, atol=tolerance), name
    apart = 1 - np.abs(np.einsum("ni,ni->n", found.quaternions.astype(float), expected.quaternions.astype(float)))
    assert np.abs(np.linalg.norm(found.quaternions, axis=1) - 1).max(initial=0) < 1e-6
    assert apart.max(initial=0) < 1e-6
    return len(found)


@pytest.mark.parametrize("size", SIZES)
@pytest.mark.parametrize("adaptive", [False, True])
def test_the_core_gives_what_the_reference_gives(size: tuple[int, int], adaptive: bool) -> None:
    s = InsertionSettings(adaptive_stride=adaptive, flatness=0.3)
    made = check_same(*make_images(*size), s)
    assert made or min(size) <= 3


@pytest.mark.parametrize("instruction_set", available_instruction_sets())
def test_every_instruction_set_gives_the_same(instruction_set: str) -> None:
    assert check_same(*make_images(53, 75), InsertionSettings(), NativeContext(2, instruction_set)) > 500


def test_any_number_of_threads_gives_the_same_bits() -> None:
    color, depth, where, camera = make_images(120, 161)
    one, three = (
        new_gaussians(color, depth, camera, POSE, where, InsertionSettings(), NativeContext(n)) for n in (1, 3)
    )
    for name in ("means", "quaternions", "log_scales", "rgb", "pixels"):
        assert getattr(one, name).tobytes() == getattr(three, name).tobytes(), name


def test_nothing_selected_makes_nothing() -> None:
    color, depth, where, camera = make_images(37, 53)
    for images in ((color, depth, np.zeros_like(where)), (color, np.zeros_like(depth), where)):
        new = new_gaussians(*images[:2], camera, POSE, images[2], InsertionSettings())
        assert [len(a) for a in (new.means, new.quaternions, new.log_scales, new.rgb, new.pixels)] == [0] * 5


@pytest.mark.parametrize("bad", [np.nan, np.inf, -1.0])
def test_depth_that_is_none_makes_nothing_and_spoils_nothing(bad: float) -> None:
    color, depth, _, camera = make_images(48, 64)
    spoilt = depth.copy()
    spoilt[10:14, 20:24] = bad
    new = new_gaussians(color, spoilt, camera, POSE, None, InsertionSettings())
    assert not np.isin(np.ravel_multi_index(np.mgrid[10:14, 20:24], depth.shape), new.pixels).any()
    for array in (new.means, new.quaternions, new.log_scales):
        assert np.isfinite(array).all()
    holes = np.where(np.isfinite(spoilt) & (spoilt > 0), spoilt, np.float32(0))
    expected = reference(color, holes, camera, POSE, np.ones(depth.shape, bool), InsertionSettings())
    near = np.zeros(depth.shape, bool)
    near[6:18, 16:28] = True  # beside what is none the grid may be finer
    far = [a.pixels[~near.reshape(-1)[a.pixels]] for a in (new, expected)]
    assert np.array_equal(*far)


def test_images_of_another_kind_are_refused() -> None:
    color, depth, where, camera = make_images(37, 53)
    for images in ((color[1:], depth, where), (color, depth.astype(float), where), (color, depth, where.astype(int))):
        with pytest.raises(InputError, match="insertion"):
            new_gaussians(*images[:2], camera, POSE, images[2], InsertionSettings())
