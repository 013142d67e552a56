# SPDX-License-Identifier: Apache-2.0
"""Rules of rendering: determinism, near plane, degenerate Gaussians, depths, errors."""

from __future__ import annotations

import dataclasses

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
    render_and_differentiate,
)

from ggslam.errors import RenderError
from ggslam.native.loader import available_instruction_sets
from ggslam.rendering.cpu import CpuRasterizer
from ggslam.rendering.reference import render_reference
from ggslam.rendering.types import GaussianTensors

INSTRUCTION_SETS = available_instruction_sets()


@pytest.mark.parametrize("instruction_set", INSTRUCTION_SETS)
@pytest.mark.parametrize("features", [0, 9])
def test_bitwise_equal_for_any_number_of_threads(instruction_set: str, features: int) -> None:
    scene = make_scene(5000, features, 4)
    first = render_and_differentiate(CpuRasterizer(1, instruction_set), scene, median_depth=True)
    for threads in (2, 3, 4):
        rasterizer = CpuRasterizer(threads, instruction_set)
        for _ in range(2):
            again = render_and_differentiate(rasterizer, scene, median_depth=True)
            assert all(torch.equal(first[name], again[name]) for name in first)


@pytest.mark.parametrize("instruction_set", INSTRUCTION_SETS)
def test_no_gaussians(instruction_set: str) -> None:
    found = render_and_differentiate(CpuRasterizer(2, instruction_set), make_scene(0, 2), median_depth=True)
    assert not any(value.any() for value in found.values())
    assert found["means"].shape == (0, 3)


def test_nothing_in_view() -> None:
    scene = make_scene(50)
    scene.means[:, 2] -= 100
    found = render_and_differentiate(CpuRasterizer(2), scene)
    assert not any(value.any() for value in found.values())


def splat_images(position_px: np.ndarray, sigmas_px: list[float], angle: float) -> GaussianTensors:
    """One Gaussian 2 m in front of a camera at the origin, given by its picture by `CAMERA`."""
    means = [*((position_px - [CAMERA.cx, CAMERA.cy]) / [CAMERA.fx, CAMERA.fy] * 2), 2.0]
    scales = np.array([*sigmas_px, min(sigmas_px)]) * 2 / CAMERA.fx
    numbers = {
        "means": [means], "quaternions": [[np.cos(angle / 2), 0, 0, np.sin(angle / 2)]], "log_scales": [np.log(scales)],
        "opacity_logits": [1.0], "sh": [[[0.9, 0.4, -0.5]]], "features": np.zeros((1, 0)),
    }  # fmt: skip
    return GaussianTensors(**{name: torch.tensor(np.array(v), dtype=torch.float32) for name, v in numbers.items()})


@pytest.mark.parametrize("instruction_set", INSTRUCTION_SETS)
@pytest.mark.parametrize("sigmas", [[0.1, 0.1], [2.0, 1.0], [9.0, 0.2], [60.0, 0.1]])
def test_a_splat_reaches_every_pixel_that_it_covers(instruction_set: str, sigmas: list[float]) -> None:
    """Wherever it lies in its tile, however it is turned, and where its mean is beyond the image."""
    rasterizer, random, seen = CpuRasterizer(1, instruction_set), np.random.default_rng(2), 0
    for angle in np.linspace(0, np.pi, 9):
        splat = splat_images(random.uniform([-8, -8], [CAMERA.width + 8, CAMERA.height + 8]), sigmas, angle)
        found = rasterizer.forward(splat, CAMERA, np.eye(4))
        expected = render_reference(splat, CAMERA, torch.eye(4))
        differs = (found.alpha - expected.alpha).abs() > 1e-4  # a pixel may lie on the very rim, where alpha is 1/255
        assert (found.alpha[differs] - expected.alpha[differs]).abs().sum() < 1.01 / 255 and differs.sum() <= 1
        seen += int((expected.alpha > 0).any())
    assert seen >= 3


def bad_rows(scene: GaussianTensors) -> torch.Tensor:
    """Spoils the first Gaussians, each in a way of its own; returns which, bool [N]."""
    inf, nan = float("inf"), float("nan")
    spoilt = 0

    def row() -> int:
        nonlocal spoilt
        spoilt += 1
        return spoilt - 1

    for value in (nan, inf, -inf, 1e30):
        for axis in range(3):
            scene.means[row(), axis] = value
    for quaternion in ([0, 0, 0, 0], [nan, 0, 0, 1], [inf, 0, 0, 0], [1e-15, 0, 0, 0], [1e25, 0, 0, 0]):
        scene.quaternions[row()] = torch.tensor(quaternion, dtype=torch.float32)
    for value in (nan, inf, -inf, 11.0, 80.0, 1e10, -30.0, -1e10):
        scene.log_scales[row(), 1] = value
    for value in (nan, inf, -inf, -1e10, -20.0):
        scene.opacity_logits[row()] = value
    for value in (nan, inf):
        scene.sh[row(), 0, 1] = value
    rows = torch.zeros(len(scene.means), dtype=torch.bool)
    rows[:spoilt] = True
    return rows


@pytest.mark.parametrize("instruction_set", INSTRUCTION_SETS)
def test_degenerate_gaussians_are_skipped(instruction_set: str) -> None:
    scene = make_scene(150, 3, 4)
    bad = bad_rows(scene)
    rasterizer = CpuRasterizer(2, instruction_set)
    found = render_and_differentiate(rasterizer, scene)
    without = GaussianTensors(**{f.name: getattr(scene, f.name)[~bad] for f in dataclasses.fields(scene)})
    expected = render_and_differentiate(rasterizer, without)
    for name, value in found.items():
        if name.startswith("rendered_"):
            assert torch.equal(value, expected[name]), name
        elif name != "twist":
            assert not value[bad].any(), name
            assert torch.isfinite(value).all(), name
    assert np.allclose(found["twist"], expected["twist"], rtol=1e-4)


@pytest.mark.parametrize("instruction_set", INSTRUCTION_SETS)
def test_extreme_but_valid_gaussians_stay_finite(instruction_set: str) -> None:
    scene = make_scene(64)
    scene.means[:16, 2] = torch.linspace(-0.2, 0.3, 16)  # about the camera and its near plane
    scene.log_scales[16:32] = torch.linspace(-23, 9.9, 16)[:, None]
    scene.log_scales[32:48, 0] = torch.linspace(-20, 9, 16)  # needles
    scene.opacity_logits[48:] = torch.linspace(5, 1e4, 16)
    found = render_and_differentiate(CpuRasterizer(1, instruction_set), scene, pose=np.eye(4))
    assert all(torch.isfinite(value).all() for value in found.values())


def test_near_plane() -> None:
    scene = make_scene(100)
    scene.means[:, 2] = torch.linspace(0.2, 1.2, 100)
    rasterizer = CpuRasterizer(1, near_plane=0.7)
    gradients = make_image_gradients(CAMERA, 0)
    expected_image, expected = reference_gradients(scene, CAMERA, np.eye(4), gradients, near_plane=0.7)
    rendered = rasterizer.forward(scene, CAMERA, np.eye(4))
    assert relative_error(rendered.image, expected_image.image) < 1e-5
    found = rasterizer.backward(*gradients.arguments())
    assert_gradients_agree(found, expected, 1e-5)
    assert not found.touched[scene.means[:, 2] < 0.7].any()


@pytest.mark.parametrize("instruction_set", INSTRUCTION_SETS)
def test_crowded_and_equal_depths_keep_their_order(instruction_set: str) -> None:
    scene = make_scene(3000)
    scene.means[:1000, 2] = 1.5
    scene.means[1000:2000, 2] = 3.0 + 1e-6 * torch.arange(1000)
    scene.means[2000:2001, 2] = 100.0
    expected = render_reference(scene, CAMERA, torch.eye(4))
    rendered = CpuRasterizer(1, instruction_set).forward(scene, CAMERA, np.eye(4))
    assert relative_error(rendered.image, expected.image) < 1e-5


def test_median_and_expected_depth() -> None:
    scene = make_scene(400)
    rendered = CpuRasterizer(2).forward(scene, CAMERA, POSE, median_depth=True)
    scene64 = GaussianTensors(**{f.name: getattr(scene, f.name).double() for f in dataclasses.fields(scene)})
    expected = render_reference(scene64, CAMERA, torch.as_tensor(POSE), median_depth=True)
    assert rendered.median_depth is not None and expected.median_depth is not None
    assert (rendered.median_depth - expected.median_depth).abs().max() < 1e-5
    assert torch.equal(rendered.median_depth > 0, expected.alpha > 0.5)
    solid = rendered.alpha > 0.1
    assert torch.allclose(rendered.expected_depth[solid], (rendered.depth / rendered.alpha)[solid])
    assert not rendered.expected_depth[rendered.alpha < 1e-3].any()


def test_buffers_are_reused_and_sizes_may_change() -> None:
    rasterizer = CpuRasterizer(1)
    first = rasterizer.forward(make_scene(100), CAMERA, POSE)
    second = rasterizer.forward(make_scene(300, 2), CAMERA, POSE)
    assert first.image.data_ptr() == second.image.data_ptr()
    other = rasterizer.forward(make_scene(10), CAMERA.resize(100, 70), POSE)
    assert other.image.shape == (3, 70, 100)


@pytest.mark.parametrize(
    ("name", "value", "message"),
    [
        ("means", torch.zeros(5, 2), r"means: .*\[5, 3\]"),
        ("means", torch.zeros(5, 3, dtype=torch.float64), "torch.float64"),
        ("quaternions", torch.zeros(4, 4), r"quaternions: .*\[5, 4\].*\[4, 4\]"),
        ("log_scales", torch.zeros(3, 5).T, "log_scales: .*contiguous"),
        ("opacity_logits", torch.zeros(5, 1), "opacity_logits"),
        ("sh", torch.zeros(5, 2, 3), r"sh: .*\b1, 4, 9 or 16\b.*\b2\b"),
        ("features", torch.zeros(5, 3, dtype=torch.int32), "features: .*torch.float32"),
    ],
)
def test_wrong_parameters_are_refused(name: str, value: torch.Tensor, message: str) -> None:
    scene = dataclasses.replace(make_scene(5), **{name: value})
    with pytest.raises(RenderError, match=message):
        CpuRasterizer(1).forward(scene, CAMERA, POSE)


def test_wrong_calls_are_refused() -> None:
    rasterizer, scene = CpuRasterizer(1), make_scene(5)
    gradient = torch.zeros(3, CAMERA.height, CAMERA.width)
    with pytest.raises(RenderError, match="forward"):
        rasterizer.backward(gradient)
    with pytest.raises(RenderError, match="4x4"):
        rasterizer.forward(scene, CAMERA, np.eye(3))
    with pytest.raises(RenderError, match="finite"):
        rasterizer.forward(scene, CAMERA, np.full((4, 4), np.nan))
    with pytest.raises(RenderError, match="active_sh_degree 1"):
        rasterizer.forward(scene, CAMERA, POSE, active_sh_degree=1)
    rasterizer.forward(scene, CAMERA, POSE)
    with pytest.raises(RenderError, match="grad_image"):
        rasterizer.backward(gradient[:2])
    with pytest.raises(RenderError, match="grad_depth: .*float32"):
        rasterizer.backward(gradient, gradient[0].double())
    with pytest.raises(RenderError, match="features"):
        rasterizer.backward(gradient, grad_features=gradient)
    with pytest.raises(RenderError, match="near_plane"):
        CpuRasterizer(1, near_plane=0.0)
