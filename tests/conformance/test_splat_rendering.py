# SPDX-License-Identifier: Apache-2.0
"""The renderer of these tests against what can be worked out by hand, and ggslam's against it."""

from __future__ import annotations

import numpy as np
import pytest
from splat_maps import C0, Splats, small_map
from splat_rendering import Pinhole, Rules, decibels, look_at, render
from standard_pictures import standard_picture

from ggslam.rendering.cpu import CpuRasterizer
from ggslam.runs.folder import RunFolder
from ggslam.scene.camera import Camera
from ggslam.scene.gaussian_map import GaussianMap
from ggslam.scene.poses import inverse

CAMERA = Pinhole.centred(33, 25, 40.0)
OURS = Rules(near=0.05, max_alpha=0.999, draws_last=True)


def ball(depth: float, color: tuple[float, float, float], opacity: float, size: float = 0.05) -> Splats:
    """A round Gaussian on the optical axis."""
    sh = (np.array([[color]]) - 0.5) / C0
    return Splats(np.array([[0.0, 0.0, depth]]), np.full((1, 3), np.log(size)), np.array([[1.0, 0, 0, 0]]),
                  np.array([opacity]), sh)  # fmt: skip


def together(*splats: Splats) -> Splats:
    columns = ("means", "log_scales", "quaternions", "opacities", "sh")
    return Splats(*(np.concatenate([getattr(s, name) for s in splats]) for name in columns))


def test_a_round_gaussian_is_the_bell_curve_of_its_size_and_the_low_pass() -> None:
    image = render(ball(2.0, (1.0, 0.5, 0.25), 0.8), CAMERA, np.eye(4))
    variance = (40 * 0.05 / 2) ** 2 + 0.3
    x, y = np.arange(33) - 16, (np.arange(25) - 12)[:, None]
    alpha = 0.8 * np.exp(-(x * x + y * y) / (2 * variance))
    alpha[alpha < 1 / 255] = 0
    np.testing.assert_allclose(image, alpha[..., None] * [1.0, 0.5, 0.25], atol=1e-12)
    assert (image[..., 0] > 0).sum() > 30


def test_nearer_gaussians_hide_those_behind_whatever_their_order() -> None:
    near, far = ball(1.0, (1.0, 0, 0), 0.6), ball(2.0, (0, 1.0, 0), 0.5, 0.1)
    for both in (together(near, far), together(far, near)):
        np.testing.assert_allclose(render(both, CAMERA, np.eye(4))[12, 16], [0.6, 0.4 * 0.5, 0], atol=1e-12)


def test_an_opaque_gaussian_lets_a_hundredth_through_and_the_last_one_is_not_drawn() -> None:
    """At most 0.99 each; the Gaussian that would leave less than 1e-4 is left out, and all behind it."""
    stack = together(ball(1.0, (1, 0, 0), 1.0), ball(1.1, (0, 1, 0), 0.985), ball(1.2, (0, 0, 1), 1.0))
    np.testing.assert_allclose(render(stack, CAMERA, np.eye(4))[12, 16], [0.99, 0.00985, 0], atol=1e-12)
    ours = render(stack, CAMERA, np.eye(4), OURS)[12, 16]
    np.testing.assert_allclose(ours, [0.999, 0.000985, 0], atol=1e-12)  # 1.5e-5 is left: the third is hidden


def test_colours_below_zero_are_black() -> None:
    image = render(ball(2.0, (-0.5, 0.5, 2.0), 0.5), CAMERA, np.eye(4))
    np.testing.assert_allclose(image[12, 16], [0, 0.25, 1.0], atol=1e-12)


def test_what_is_too_near_or_behind_is_left_out() -> None:
    for depth in (-1.0, 0.0, 0.2):
        assert not render(ball(depth, (1, 1, 1), 0.9), CAMERA, np.eye(4)).any()


def test_a_stick_points_where_it_should() -> None:
    """Long along its own x, turned by 30 degrees about the viewing axis: y points down."""
    half = np.deg2rad(15)
    stick = Splats(np.array([[0.0, 0, 2]]), np.log([[0.2, 0.01, 0.01]]),
                   np.array([[np.cos(half), 0, 0, np.sin(half)]]), np.array([0.9]), np.ones((1, 1, 3)))  # fmt: skip
    rows, columns = np.nonzero(render(stick, CAMERA, np.eye(4))[..., 0] > 0.2)
    slope = np.polyfit(columns - 16, rows - 12, 1)[0]
    assert slope == pytest.approx(np.tan(np.deg2rad(30)), abs=0.08)


def test_harmonics_are_seen_along_the_ray() -> None:
    """The coefficient of -x: brighter on the side of the camera from which the ray runs towards negative x."""
    found = {}
    for side in (-1.0, 1.0):
        splat = ball(0.0, (0.5, 0.5, 0.5), 0.9, 0.2)
        splat = Splats(splat.means, splat.log_scales, splat.quaternions, splat.opacities, np.zeros((1, 4, 3)))
        splat.sh[0, 3] = 0.5
        found[side] = render(splat, CAMERA, look_at((2 * side, 0, 0)))[12, 16, 0]
    np.testing.assert_allclose([found[1.0], found[-1.0]], 0.9 * (0.5 + 0.5 * 0.4886025 * np.array([1, -1])), atol=1e-6)


def ours(gaussians: GaussianMap, camera: Pinhole, pose: np.ndarray) -> np.ndarray:
    image = CpuRasterizer(low_pass=0.3).forward(gaussians, Camera(**vars(camera)), pose).image
    return image.numpy().transpose(1, 2, 0).astype(float)


POSES = [look_at((0.5, -1.0, -5.0)), look_at((0.2, 0.1, 0.3), (2.0, 0.5, 1.0))]


@pytest.mark.parametrize("degree", [0, 1, 2, 3])
def test_our_rasterizer_draws_the_same_by_its_own_rules(degree: int) -> None:
    gaussians, camera = small_map(degree, 500, -1.8), Pinhole.centred()
    for pose in POSES:
        expected = render(Splats.of(gaussians), camera, pose, OURS)
        assert expected.max() > 0.5
        difference = np.abs(ours(gaussians, camera, pose) - expected)
        # A contribution at the edge, 1/255, may fall to either side.
        assert np.quantile(difference, 0.99) < 2e-5 and difference.max() < 0.01


@pytest.mark.parametrize("degree", [0, 1, 2, 3])
def test_our_rasterizer_shows_what_others_show(degree: int) -> None:
    """With their low-pass, near plane and colours; two rules of its own are left."""
    splats, camera = Splats.of(small_map(degree, 500, -1.8)), Pinhole.centred()
    images = [standard_picture(splats, Camera(**vars(camera)), pose) for pose in POSES]
    assert decibels(images, [render(splats, camera, pose) for pose in POSES]) > 90


def test_the_same_on_a_map_that_was_trained(room_run: RunFolder) -> None:
    """In the middle of a keyframe."""
    gaussians, whole = room_run.gaussians(), room_run.sequence().camera
    camera = Camera(64, 48, whole.fx, whole.fy, 31.5, 23.5)
    small, splats = Pinhole(**vars(camera)), Splats.of(gaussians)
    pose = inverse(room_run.keyframes().keyframes[0].T_world_camera)
    same = render(splats, small, pose, OURS)
    assert np.quantile(np.abs(ours(gaussians, small, pose) - same), 0.99) < 1e-4
    assert decibels([standard_picture(splats, camera, pose)], [render(splats, small, pose)]) > 45
