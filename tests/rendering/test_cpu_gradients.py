# SPDX-License-Identifier: Apache-2.0
"""The CPU rasterizer against the float64 reference: images and gradients of every input."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from rendering_scenes import (
    CAMERA,
    POSE,
    assert_gradients_agree,
    make_image_gradients,
    make_scene,
    reference_gradients,
    relative_error,
)

from ggslam.errors import RenderError
from ggslam.native.loader import available_instruction_sets
from ggslam.rendering.cpu import CpuRasterizer
from ggslam.scene.camera import Camera

TOLERANCE = 1e-5
INSTRUCTION_SETS = available_instruction_sets()


def check(scene, rasterizer, camera=CAMERA, pose=POSE, tolerance=TOLERANCE, **options):  # type: ignore[no-untyped-def]
    channels = scene.features.shape[1]
    gradients = make_image_gradients(camera, channels)
    expected, expected_gradients = reference_gradients(
        scene, camera, pose, gradients, near_plane=rasterizer.near_plane, low_pass=rasterizer.low_pass, **options
    )
    rendered = rasterizer.forward(scene, camera, pose, **options)
    for name in ("image", "depth", "alpha", *(["features"] if channels else [])):
        assert relative_error(getattr(rendered, name), getattr(expected, name)) < tolerance, name
    found = rasterizer.backward(*gradients.arguments())
    assert_gradients_agree(found, expected_gradients, tolerance)
    return found


@pytest.mark.parametrize("instruction_set", INSTRUCTION_SETS)
@pytest.mark.parametrize("features", [0, 1, 2, 3, 5, 8, 9, 16, 17, 33, 40])
def test_every_number_of_channels(instruction_set: str, features: int) -> None:
    check(make_scene(features=features), CpuRasterizer(2, instruction_set))


@pytest.mark.parametrize("instruction_set", INSTRUCTION_SETS)
@pytest.mark.parametrize("coefficients", [4, 9, 16])
def test_spherical_harmonics(instruction_set: str, coefficients: int) -> None:
    check(make_scene(coefficients=coefficients), CpuRasterizer(1, instruction_set))


@pytest.mark.parametrize("active", [0, 1, 2])
def test_lower_active_degree_leaves_the_other_coefficients_alone(active: int) -> None:
    found = check(make_scene(coefficients=16), CpuRasterizer(1), active_sh_degree=active)
    assert not found.sh[:, (active + 1) ** 2 :].any()


@pytest.mark.parametrize("instruction_set", INSTRUCTION_SETS)
@pytest.mark.parametrize("size", [(1, 1), (16, 16), (17, 5), (64, 33)])
def test_image_sizes(instruction_set: str, size: tuple[int, int]) -> None:
    camera = Camera(*size, 30.0, 31.0, size[0] / 2 - 0.7, size[1] / 2 - 0.2)
    check(make_scene(features=3), CpuRasterizer(2, instruction_set), camera)


@pytest.mark.parametrize("low_pass", [0.02, 0.3])
def test_low_pass(low_pass: float) -> None:
    check(make_scene(), CpuRasterizer(1, low_pass=low_pass))


def test_more_gaussians_than_one_chunk_and_saturated_pixels() -> None:
    scene = make_scene(3000)
    scene.opacity_logits += 1.0
    check(scene, CpuRasterizer(2), tolerance=3e-5)


@pytest.mark.parametrize("instruction_set", INSTRUCTION_SETS)
@pytest.mark.parametrize(("close_below", "features"), [(1e-3, 0), (0.02, 5), (0.3, 0)])
def test_pixels_closed_early(instruction_set: str, close_below: float, features: int) -> None:
    scene, rasterizer = make_scene(600, features), CpuRasterizer(2, instruction_set)
    scene.opacity_logits += 1.0
    check(scene, rasterizer, tolerance=3e-5, close_below=close_below)
    alpha = rasterizer.forward(scene, CAMERA, POSE, close_below=close_below).alpha
    assert ((alpha > 0.998) | (alpha <= 1 - close_below)).all() and (alpha > 0.998).sum() > 100


def test_closing_pixels_passes_over_most_of_what_is_hidden() -> None:
    """What lies behind the Gaussian that closes all pixels is not touched."""
    scene, rasterizer = make_scene(600), CpuRasterizer(1)
    scene.opacity_logits += 1.0
    touched = []
    for close_below in (0.0, 0.05):
        view = rasterizer.forward(scene, CAMERA, POSE, close_below=close_below)
        touched.append(int(rasterizer.backward(torch.ones_like(view.image)).touched.sum()))
    assert touched[1] < 0.8 * touched[0]


def test_alpha_limit_passes_no_gradient() -> None:
    scene = make_scene(20)
    scene.opacity_logits[:] = 9.0
    found = check(scene, CpuRasterizer(1))
    assert found.touched.any()


def test_only_some_image_gradients() -> None:
    scene = make_scene(features=2)
    gradients = make_image_gradients(CAMERA, 2)
    gradients.image.zero_()
    gradients.alpha.zero_()
    gradients.features.zero_()  # type: ignore[union-attr]
    _, expected = reference_gradients(scene, CAMERA, POSE, gradients)
    rasterizer = CpuRasterizer(1)
    rasterizer.forward(scene, CAMERA, POSE)
    assert_gradients_agree(rasterizer.backward(None, gradients.depth), expected, TOLERANCE)


def test_features_left_out() -> None:
    scene = make_scene(features=5)
    rasterizer = CpuRasterizer(1)
    rendered = rasterizer.forward(scene, CAMERA, POSE, features=False)
    assert rendered.features is None
    gradients = make_image_gradients(CAMERA, 0)
    _, expected = reference_gradients(scene, CAMERA, POSE, gradients, features=False)
    found = rasterizer.backward(*gradients.arguments())
    assert found.features is None
    assert_gradients_agree(found, expected, TOLERANCE)


def test_detached_features_reach_only_the_features() -> None:
    scene = make_scene(features=6)
    gradients = make_image_gradients(CAMERA, 6)
    rasterizer = CpuRasterizer(1)
    rasterizer.forward(scene, CAMERA, POSE)
    attached = rasterizer.backward(*gradients.arguments())
    detached = rasterizer.backward(*gradients.arguments(), detach_features=True)
    colour_only = rasterizer.backward(gradients.image, gradients.depth, gradients.alpha)
    assert torch.equal(detached.features, attached.features)  # type: ignore[arg-type]
    for name in ("means", "quaternions", "log_scales", "opacity_logits", "sh"):
        assert relative_error(getattr(detached, name), getattr(colour_only, name)) < 1e-6
        assert name == "sh" or relative_error(getattr(attached, name), getattr(colour_only, name)) > 1e-2


def test_pose_gradient_is_that_of_backward() -> None:
    rasterizer = CpuRasterizer(2)
    rasterizer.forward(make_scene(), CAMERA, POSE)
    gradients = make_image_gradients(CAMERA, 0)
    expected = rasterizer.backward(*gradients.arguments()).twist
    assert np.array_equal(rasterizer.pose_gradient(*gradients.arguments()), expected)
    assert np.abs(expected).min() > 0


@pytest.mark.parametrize(
    "options", [{"close_below": 0.6}, {"close_below": -0.1}, {"median_depth": True}, {"as_3dgs": True}]
)
def test_closing_pixels_in_vain_is_refused(options: dict[str, float]) -> None:
    with pytest.raises(RenderError, match="close_below"):
        CpuRasterizer(1).forward(make_scene(), CAMERA, POSE, **{"close_below": 0.01, **options})
