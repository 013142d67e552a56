# SPDX-License-Identifier: Apache-2.0
"""Renderings and steps that the host does not wait for: poses on the device, room for pairs that is guessed."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from cuda_contract import moved, on_cpu
from cuda_emulation import emulated_library
from rendering_scenes import CAMERA, POSE, make_image_gradients, make_scene
from test_cuda_training import on_device
from test_fused_adam import SETTINGS as ADAM
from test_fused_adam import make_map

from ggslam.cuda.library import CudaLibrary
from ggslam.errors import RenderError
from ggslam.rendering.cuda.rasterizer import CudaRasterizer
from ggslam.rendering.types import GaussianTensors
from ggslam.scene.poses import se3_exp

BEHIND = se3_exp(np.array([0.0, 0.0, -50.0, 0.0, 0.0, 0.0]))
"""Nothing is in view."""
FAR = se3_exp(np.array([0.0, 0.0, 40.0, 0.0, 0.0, 0.0]))
"""All of a scene lies in few tiles."""


def device_pose(T_camera_world: np.ndarray, device: torch.device) -> torch.Tensor:
    return torch.from_numpy(T_camera_world[:3].astype(np.float32).reshape(12)).to(device)


def dense_scene() -> GaussianTensors:
    """More pairs than the least room there is, when seen from near."""
    scene = make_scene(3000, seed=2)
    scene.log_scales += 1.0
    scene.opacity_logits -= 2.0
    return scene


def render_and_differentiate(
    rasterizer: CudaRasterizer, scene: GaussianTensors, pose: np.ndarray | torch.Tensor
) -> dict[str, torch.Tensor]:
    channels = scene.features.shape[1]
    rendered = rasterizer.forward(moved(scene, rasterizer.device), CAMERA, pose, median_depth=True)
    images = {f"rendered_{name}": value for name, value in on_cpu(rendered).items()}
    gradients = moved(make_image_gradients(CAMERA, channels), rasterizer.device)
    return images | on_cpu(rasterizer.backward(*gradients.arguments()))


def assert_same(found: dict[str, torch.Tensor], expected: dict[str, torch.Tensor], device: torch.device) -> None:
    """Bit for bit; gradients on a GPU only but for the order of their sums."""
    assert found.keys() == expected.keys()
    for name, value in expected.items():
        if device.type == "cpu" or name.startswith("rendered_") or name == "touched":
            assert torch.equal(found[name], value), name
        else:
            assert torch.allclose(found[name], value, rtol=1e-3, atol=1e-4 * float(value.abs().max())), name


# --- poses on the device ---------------------------------------------------------------------------------------------


@pytest.mark.parametrize(("features", "coefficients"), [(0, 1), (3, 9)])
def test_a_pose_on_the_device_is_the_same_pose(cuda_library: CudaLibrary, features: int, coefficients: int) -> None:
    rasterizer, scene = CudaRasterizer(library=cuda_library), make_scene(150, features, coefficients)
    rounded = POSE.astype(np.float32).astype(float)
    expected = render_and_differentiate(rasterizer, scene, rounded)
    found = render_and_differentiate(rasterizer, scene, device_pose(POSE, rasterizer.device))
    assert expected["touched"].any() and expected["twist"].any()
    assert_same(found, expected, rasterizer.device)


def test_a_pose_on_the_device_may_change_between_renderings(cuda_library: CudaLibrary) -> None:
    rasterizer, scene = CudaRasterizer(library=cuda_library), make_scene(100)
    pose = device_pose(BEHIND, rasterizer.device)
    assert not render_and_differentiate(rasterizer, scene, pose)["touched"].any()
    pose.copy_(device_pose(POSE, rasterizer.device))
    expected = render_and_differentiate(rasterizer, scene, POSE.astype(np.float32).astype(float))
    assert_same(render_and_differentiate(rasterizer, scene, pose), expected, rasterizer.device)


def test_with_a_pose_that_is_not_finite_nothing_is_in_view(cuda_library: CudaLibrary) -> None:
    rasterizer = CudaRasterizer(library=cuda_library)
    for value in (np.nan, np.inf):
        pose = torch.full((12,), value, device=rasterizer.device)
        found = render_and_differentiate(rasterizer, make_scene(50), pose)
        assert not any(tensor.any() for tensor in found.values())


def test_wrong_poses_on_the_device_are_refused() -> None:
    rasterizer, scene = CudaRasterizer(library=emulated_library()), make_scene(5)
    pose = device_pose(POSE, rasterizer.device)
    for wrong, message in (
        (pose.double(), "expected float32"), (pose.view(3, 4), "expected shape"), (pose[:8], "expected shape"),
        (torch.zeros(24)[::2], "contiguous"), (pose.to("meta"), "on meta"),
    ):  # fmt: skip
        with pytest.raises(RenderError, match=f"T_camera_world: .*{message}"):
            rasterizer.forward(scene, CAMERA, wrong)


# --- not waiting -----------------------------------------------------------------------------------------------------


def test_without_waiting_the_results_are_the_same(cuda_library: CudaLibrary) -> None:
    scene = make_scene(300, 4)
    waiting, hurried = CudaRasterizer(library=cuda_library), CudaRasterizer(library=cuda_library, waits=False)
    for step in range(6):
        pose = se3_exp(np.array([0.1 * step, 0.0, 0.3 * step, 0.0, 0.05 * step, 0.0]))
        given = device_pose(pose, hurried.device)
        expected = render_and_differentiate(waiting, scene, pose.astype(np.float32).astype(float))
        assert_same(render_and_differentiate(hurried, scene, given), expected, hurried.device)
        hurried.forward(moved(scene, hurried.device), CAMERA, given)
        waiting.forward(moved(scene, hurried.device), CAMERA, given)
        assert hurried.statistics() == waiting.statistics() and hurried.statistics()["pairs"] > 0
    assert hurried.overflows.item() == 0 and hurried.last_overflowed.item() == 0


def test_only_what_was_never_seen_is_waited_for(cuda_library: CudaLibrary, monkeypatch: pytest.MonkeyPatch) -> None:
    rasterizer, waited = CudaRasterizer(library=cuda_library, waits=False), []
    wait = rasterizer.counter.wait
    monkeypatch.setattr(rasterizer.counter, "wait", lambda: waited.append(1) or wait())
    scene = moved(make_scene(100), rasterizer.device)
    for pose, expected in ((BEHIND, 1), (POSE, 2), (POSE, 2), (BEHIND, 2), (POSE, 2)):
        rasterizer.forward(scene, CAMERA, pose)
        rasterizer.overflows.cpu()  # what was started is done now
        assert len(waited) == expected


def tight_rasterizer(library: CudaLibrary) -> CudaRasterizer:
    """One that has seen little, and makes no more room than a quarter above that and up to a whole step."""
    rasterizer = CudaRasterizer(library=library, waits=False)
    rasterizer.counter.spare_pairs = 0
    return rasterizer


def test_a_rendering_that_runs_out_of_room_changes_nothing(cuda_library: CudaLibrary) -> None:
    scene, features = dense_scene(), 3
    rasterizer = tight_rasterizer(cuda_library)
    gaussians = on_device(make_map(1, features), rasterizer.device)
    rows = gaussians.take(torch.arange(len(gaussians), device=rasterizer.device).repeat(16)[:3000])
    gaussians.append(rows)
    for name in ("means", "quaternions", "log_scales", "opacity_logits"):
        getattr(gaussians, name)[-3000:] = getattr(scene, name).to(rasterizer.device)
    given = moved(make_image_gradients(CAMERA, features), rasterizer.device).arguments()
    rasterizer.forward(gaussians, CAMERA, FAR)
    rasterizer.backward_step(gaussians, *given, optimizer=ADAM)

    def everything() -> dict[str, torch.Tensor]:
        return gaussians.take(torch.arange(len(gaussians), device=rasterizer.device))

    before = everything()
    rasterizer.forward(gaussians, CAMERA, POSE)
    assert rasterizer.statistics()["pairs"] > 4096
    result = rasterizer.backward_step(gaussians, *given, optimizer=ADAM)
    assert rasterizer.last_overflowed.tolist() == [1] and rasterizer.overflows.tolist() == [1]
    assert not result.touched.any() and not result.twist.any()
    assert all(torch.equal(value, before[name]) for name, value in everything().items())

    rasterizer.forward(gaussians, CAMERA, POSE)
    result = rasterizer.backward_step(gaussians, *given, optimizer=ADAM)
    assert rasterizer.last_overflowed.tolist() == [0] and rasterizer.overflows.tolist() == [1]
    assert result.touched.any() and result.twist.any()


def test_gradients_of_a_rendering_that_ran_out_of_room_are_zero(cuda_library: CudaLibrary) -> None:
    rasterizer, scene = tight_rasterizer(cuda_library), dense_scene()
    expected = render_and_differentiate(CudaRasterizer(library=cuda_library), scene, POSE)
    render_and_differentiate(rasterizer, scene, FAR)
    found = render_and_differentiate(rasterizer, scene, POSE)
    for name, value in found.items():
        assert name.startswith("rendered_") or not value.any(), name
    # What is near is there all the same.
    assert found["rendered_alpha"].mean() > 0.5 * expected["rendered_alpha"].mean()
    assert_same(render_and_differentiate(rasterizer, scene, POSE), expected, rasterizer.device)
    assert rasterizer.overflows.tolist() == [1]


def test_one_may_wait_for_a_rendering_that_has_to_be_complete(cuda_library: CudaLibrary) -> None:
    rasterizer, scene = tight_rasterizer(cuda_library), dense_scene()
    expected = render_and_differentiate(CudaRasterizer(library=cuda_library), scene, POSE)
    render_and_differentiate(rasterizer, scene, FAR)
    rasterizer.waits = True
    assert_same(render_and_differentiate(rasterizer, scene, POSE), expected, rasterizer.device)
    assert rasterizer.last_overflowed.tolist() == [0] and rasterizer.overflows.tolist() == [0]
    rasterizer.waits = False
    assert_same(render_and_differentiate(rasterizer, scene, POSE), expected, rasterizer.device)
    assert rasterizer.last_overflowed.tolist() == [0] and rasterizer.overflows.tolist() == [0]


def test_room_is_given_back_slowly(cuda_library: CudaLibrary) -> None:
    rasterizer = tight_rasterizer(cuda_library)
    scene = moved(dense_scene(), rasterizer.device)
    rasterizer.forward(scene, CAMERA, POSE)
    pairs = rasterizer.statistics()["pairs"]
    few = GaussianTensors(**{name: value[:5] for name, value in vars(scene).items()})
    rooms = []
    for _ in range(500):
        rasterizer.forward(few, CAMERA, FAR)
        rasterizer.overflows.cpu()
        rooms.append(rasterizer.counter.room_without_waiting())
    assert min(rooms[:60]) >= 1.25 * pairs - 1
    assert rooms[-1] == 4096 and max(a - b for a, b in zip(rooms, rooms[1:], strict=False)) == 4096
