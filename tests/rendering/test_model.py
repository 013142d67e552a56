# SPDX-License-Identifier: Apache-2.0
"""Gaussians as a torch module: gradients through `render`, states, and the way back to a map."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import torch
from rendering_scenes import CAMERA, POSE, make_image_gradients, make_scene, relative_error, twist_matrix

from ggslam.errors import RenderError
from ggslam.formats.gaussian_ply import read_gaussian_ply, write_gaussian_ply
from ggslam.rendering import CpuRasterizer, GaussianModel, render
from ggslam.rendering.types import PARAMETERS, GaussianTensors

POSE_TENSOR = torch.as_tensor(POSE)


def model_of(count: int = 80, features: int = 4, coefficients: int = 4) -> GaussianModel:
    return GaussianModel(make_scene(count, features, coefficients))


def test_shapes_of_what_is_rendered() -> None:
    view = render(model_of(), CAMERA, POSE)
    size = (CAMERA.height, CAMERA.width)
    assert view.features is not None
    found = [tuple(image.shape) for image in (view.image, view.depth, view.alpha, view.features, view.expected_depth)]
    assert found == [(3, *size), size, size, (4, *size), size]


def test_parameters_and_pose_get_the_gradients_of_the_reference() -> None:
    found: dict[str, dict[str, torch.Tensor]] = {}
    for backend, dtype in (("cpu", torch.float32), ("reference", torch.float64)):
        model = model_of().to(dtype)
        twist = torch.zeros(6, dtype=torch.float64, requires_grad=True)
        view = render(model, CAMERA, twist_matrix(twist) @ POSE_TENSOR, backend=backend)
        make_image_gradients(CAMERA, 4).loss(view).backward()
        assert twist.grad is not None
        found[backend] = {name: getattr(model, name).grad for name in PARAMETERS} | {"twist": twist.grad}
    for name, expected in found["reference"].items():
        assert expected.abs().max() > 0 and relative_error(found["cpu"][name], expected) < 1e-5, name


def test_gradients_are_finite_differences() -> None:
    model = model_of(40).double()
    inputs = [getattr(model, name).detach().clone().requires_grad_() for name in PARAMETERS]
    weights = make_image_gradients(CAMERA, 4)
    pose = torch.zeros(6, dtype=torch.float64, requires_grad=True)

    def loss(*values: torch.Tensor) -> torch.Tensor:
        view = render(GaussianTensors(*values[:6]), CAMERA, twist_matrix(values[6]) @ POSE_TENSOR, backend="reference")
        return weights.loss(view)

    gradients = torch.autograd.grad(loss(*inputs, pose), [*inputs, pose])
    random = torch.Generator().manual_seed(3)
    for number, gradient in enumerate(gradients):
        direction = torch.randn(gradient.shape, generator=random, dtype=torch.float64)
        direction /= direction.norm()
        step = [*(x.detach() for x in inputs), pose.detach()]
        ends = []
        for sign in (1, -1):
            moved = list(step)
            moved[number] = step[number] + sign * 1e-7 * direction
            ends.append(float(loss(*moved)))
        slope = (ends[0] - ends[1]) / 2e-7
        assert slope == pytest.approx(float((gradient * direction).sum()), rel=2e-3, abs=2e-3), number


def test_both_directions_of_the_pose_are_one_view() -> None:
    model, T_world_camera = model_of(), np.linalg.inv(POSE)
    one, other = render(model, CAMERA, POSE), render(model, CAMERA, T_world_camera=T_world_camera)
    assert torch.allclose(one.image, other.image, atol=1e-6)
    for wrong in ({}, {"T_camera_world": POSE, "T_world_camera": T_world_camera}):
        with pytest.raises(RenderError, match="T_camera_world.*T_world_camera"):
            render(model, CAMERA, **wrong)


def test_training_with_torch_changes_every_parameter() -> None:
    model, goal = model_of(), render(make_scene(80, 4, 4, seed=5), CAMERA, POSE)
    before = {name: getattr(model, name).detach().clone() for name in PARAMETERS}
    optimizer = torch.optim.Adam(model.parameter_groups(means=1e-3), eps=1e-15)
    losses = []
    for _ in range(8):
        optimizer.zero_grad()
        view = render(model, CAMERA, POSE)
        assert view.features is not None and goal.features is not None
        loss = (view.image - goal.image).abs().mean() + (view.features - goal.features).abs().mean()
        loss.backward()
        optimizer.step()
        losses.append(loss.item())
    assert losses[-1] < 0.9 * losses[0]
    assert all(not torch.equal(before[name], getattr(model, name)) for name in PARAMETERS)


def test_a_map_keeps_the_gradients_that_are_asked_for() -> None:
    gaussians = model_of().to_map()
    gaussians.means.requires_grad_(True)
    render(gaussians, CAMERA, POSE).image.sum().backward()
    assert gaussians.means.grad is not None and gaussians.means.grad.abs().max() > 0


def test_a_rasterizer_refuses_what_it_would_silently_ignore() -> None:
    gaussians = model_of().to_map()
    gaussians.means.requires_grad_(True)
    rasterizer = CpuRasterizer()
    with pytest.raises(RenderError, match=r"means requires gradients.*ggslam\.render"):
        rasterizer.forward(gaussians, CAMERA, POSE)
    with torch.no_grad():
        assert rasterizer.forward(gaussians, CAMERA, POSE).alpha.max() > 0


def test_there_and_back_through_a_file(tmp_path: Path) -> None:
    model = model_of()
    model.object_id[3], model.birth_keyframe[4] = 7, 2
    gaussians = model.to_map()
    write_gaussian_ply(tmp_path / "map.ply", gaussians, extra=("object_id", "identity"))
    again = GaussianModel(read_gaussian_ply(tmp_path / "map.ply"))
    for name in PARAMETERS:
        own, read = getattr(model, name).detach(), getattr(again, name).detach()
        assert torch.equal(getattr(gaussians, name), own)
        if name == "quaternions":
            own = torch.nn.functional.normalize(own, dim=1)
        assert torch.allclose(read, own, atol=1e-7), name
    assert torch.equal(again.object_id, model.object_id) and gaussians.birth_keyframe[4] == 2


def test_state_of_another_number_of_gaussians() -> None:
    large, small = model_of(80), model_of(30)
    small.object_id[2] = 9
    large.load_state_dict(small.state_dict())
    assert len(large) == 30 and large.object_id[2] == 9
    assert all(torch.equal(getattr(large, name), getattr(small, name)) for name in PARAMETERS)
    with pytest.raises(RuntimeError, match="sh: expected shape .N, 4, 3., found .30, 1, 3.; nothing was loaded"):
        large.load_state_dict(model_of(30, coefficients=1).state_dict())


def test_selected_rows() -> None:
    model = model_of(10)
    model.object_id[:] = torch.arange(10)
    chosen = model.select(model.object_id > 6)
    assert len(chosen) == 3 and chosen.object_id.tolist() == [7, 8, 9] and torch.equal(chosen.means, model.means[7:])


def test_from_points() -> None:
    points = np.stack(np.meshgrid(*3 * [np.arange(4) * 0.1], indexing="ij"), -1).reshape(-1, 3)
    colors = np.full((64, 3), 51, np.uint8)
    model = GaussianModel.from_points(points, colors, sh_degree=1, feature_channels=2)
    assert torch.allclose(model.log_scales.exp(), torch.tensor(0.05), atol=1e-5)
    assert torch.allclose(model.to_map().rgb, torch.tensor(0.2), atol=1e-6)
    assert model.sh.shape == (64, 4, 3) and model.features.shape == (64, 2)
    assert torch.allclose(torch.sigmoid(model.opacity_logits), torch.tensor(0.5))
    with pytest.raises(RenderError, match="points.*colors"):
        GaussianModel.from_points(points, colors[:5])
    with pytest.raises(RenderError, match=r"scales.*\b0\b"):
        GaussianModel.from_points(points, colors, scales=0.0)


def test_unknown_learning_rate() -> None:
    with pytest.raises(RenderError, match=r"'scales'"):
        model_of().parameter_groups(scales=0.1)
    names = [group["name"] for group in model_of(features=0).parameter_groups(quaternions=0)]
    assert names == ["means", "log_scales", "opacity_logits", "sh"]


@pytest.mark.parametrize("broken", ["missing", "shape", "count", "kind"])
@pytest.mark.parametrize("strict", [True, False])
def test_a_state_that_does_not_fit_changes_nothing(broken: str, strict: bool) -> None:
    model, state = model_of(20), dict(model_of(30).state_dict())
    before = {name: value.clone() for name, value in model.state_dict().items()}
    if broken == "missing":
        del state["sh"]
    else:
        state["sh"] = {"shape": state["sh"][:, :0], "count": state["sh"][:7], "kind": [1, 2]}[broken]
    with pytest.raises(RuntimeError, match=r"sh.*nothing was loaded"):
        model.load_state_dict(state, strict=strict)
    for name, value in model.state_dict().items():
        assert torch.equal(value, before[name]), name
    assert len(model) == 20
