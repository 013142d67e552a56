# SPDX-License-Identifier: Apache-2.0
"""The high-level `render`: autograd through every backend, and their agreement."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest
import torch
from rendering_scenes import CAMERA, POSE, make_image_gradients, make_scene, relative_error, twist_matrix

from ggslam.errors import MissingDependency, RenderError
from ggslam.rendering import backends, register_backend, render
from ggslam.rendering.types import PARAMETERS, GaussianTensors

POSE_WORLD_CAMERA = np.linalg.inv(POSE)


def leaves(scene: GaussianTensors, dtype: torch.dtype = torch.float32, device: str = "cpu") -> GaussianTensors:
    fields = dataclasses.fields(scene)
    return GaussianTensors(
        **{f.name: getattr(scene, f.name).clone().to(device, dtype).detach().requires_grad_() for f in fields}
    )


def gradients_of(backend: str, scene: GaussianTensors, dtype: torch.dtype, device: str = "cpu"):  # type: ignore[no-untyped-def]
    """Images and gradients of the parameters and of a twist on the right of T_world_camera."""
    inputs = leaves(scene, dtype, device)
    twist = torch.zeros(6, dtype=torch.float64, requires_grad=True)
    pose = torch.as_tensor(POSE_WORLD_CAMERA) @ twist_matrix(twist)
    rendered = render(inputs, CAMERA, T_world_camera=pose.to(device), backend=backend)
    gradients = make_image_gradients(CAMERA, scene.features.shape[1])
    moved = dataclasses.replace(gradients, **{k: v.to(device) for k, v in vars(gradients).items() if v is not None})
    moved.loss(rendered).backward()
    found = {name: getattr(inputs, name).grad for name in PARAMETERS} | {"twist": twist.grad}
    return rendered, {name: value.cpu() for name, value in found.items() if value is not None}


@pytest.mark.parametrize(("features", "coefficients"), [(0, 1), (5, 9)])
def test_cpu_agrees_with_the_reference(features: int, coefficients: int) -> None:
    scene = make_scene(150, features, coefficients)
    rendered, found = gradients_of("cpu", scene, torch.float32)
    expected, expected_gradients = gradients_of("reference", scene, torch.float64)
    assert relative_error(rendered.image.detach(), expected.image) < 1e-5
    for name, gradient in expected_gradients.items():
        if gradient.numel():
            assert relative_error(found[name], gradient) < 1e-5, name


def test_two_renderings_before_one_backward() -> None:
    scene = leaves(make_scene(100))
    first = render(scene, CAMERA, T_world_camera=POSE_WORLD_CAMERA)
    second = render(scene, CAMERA, T_world_camera=np.linalg.inv(POSE) @ np.diag([1.0, 1, 1, 1]), median_depth=True)
    assert second.median_depth is not None and not second.median_depth.requires_grad
    (first.image.sum() + 2 * second.image.sum()).backward()
    once = leaves(make_scene(100))
    (3 * render(once, CAMERA, T_world_camera=POSE_WORLD_CAMERA).image.sum()).backward()
    assert scene.means.grad is not None and once.means.grad is not None
    assert relative_error(scene.means.grad, once.means.grad) < 1e-5


def test_images_are_the_callers_own() -> None:
    first = render(make_scene(50), CAMERA, T_world_camera=POSE_WORLD_CAMERA)
    kept = first.image.clone()
    render(make_scene(60, seed=3), CAMERA, T_world_camera=POSE_WORLD_CAMERA)
    assert torch.equal(first.image, kept)


def test_backends_by_name() -> None:
    assert {"cpu", "cuda", "reference", "gsplat"} <= set(backends())
    with pytest.raises(RenderError, match="'opengl'.*cpu"):
        render(make_scene(1), CAMERA, T_world_camera=np.eye(4), backend="opengl")
    with pytest.raises(RenderError, match="4x4"):
        render(make_scene(1), CAMERA, T_world_camera=np.eye(3))
    register_backend("twice", lambda *a, **k: render(a[0], a[1], T_world_camera=a[2], **k))
    assert "twice" in backends()
    view = render(make_scene(1), CAMERA, T_world_camera=np.eye(4), backend="twice")
    assert view.image.shape == (3, CAMERA.height, CAMERA.width)


def test_gsplat_absent_is_said_plainly() -> None:
    try:
        import gsplat  # noqa: F401
    except ImportError:
        with pytest.raises(MissingDependency, match="gsplat"):
            render(make_scene(1), CAMERA, T_world_camera=np.eye(4), backend="gsplat")
    else:
        with pytest.raises(RenderError, match="CUDA"):
            render(make_scene(1), CAMERA, T_world_camera=np.eye(4), backend="gsplat")


@pytest.mark.parametrize(("features", "coefficients"), [(0, 1), (5, 9)])
def test_gsplat_agrees_with_the_reference(features: int, coefficients: int) -> None:
    pytest.importorskip("gsplat", reason="gsplat is not installed")
    if not torch.cuda.is_available():
        pytest.skip("no CUDA device")
    scene = make_scene(150, features, coefficients)
    rendered, found = gradients_of("gsplat", scene, torch.float32, "cuda")
    expected, expected_gradients = gradients_of("reference", scene, torch.float64)
    assert relative_error(rendered.image.detach().cpu(), expected.image) < 1e-3
    assert relative_error(rendered.depth.detach().cpu(), expected.depth) < 1e-3
    for name, gradient in expected_gradients.items():
        if gradient.numel():
            assert relative_error(found[name], gradient) < 2e-2, name
