# SPDX-License-Identifier: Apache-2.0
"""The CUDA rasterizer's own kernels, run on the CPU by an emulation of CUDA, against the CPU rasterizer."""

from __future__ import annotations

import dataclasses
from concurrent.futures import ThreadPoolExecutor

import numpy as np
import pytest
import torch
from cuda_contract import (
    CAMERA,
    POSE,
    check_against_cpu,
    check_against_reference,
    crowded_scene,
    emulated_rasterizer,
    run,
)
from rendering_scenes import make_image_gradients, make_scene, relative_error
from test_cpu_rules import bad_rows

from ggslam.cuda.memory import GrowingMemory
from ggslam.errors import RenderError
from ggslam.rendering.autograd import render_cpu
from ggslam.rendering.cuda.autograd import render_cuda
from ggslam.rendering.cuda.rasterizer import CudaRasterizer
from ggslam.rendering.types import PARAMETERS, GaussianTensors
from ggslam.scene.camera import Camera


@pytest.fixture
def rasterizer() -> CudaRasterizer:
    return emulated_rasterizer()


@pytest.mark.parametrize("features", [0, 1, 2, 3, 5, 8, 9, 12, 16, 17, 33, 40])
def test_every_number_of_channels(rasterizer: CudaRasterizer, features: int) -> None:
    check_against_cpu(rasterizer, make_scene(features=features), median_depth=True)


@pytest.mark.parametrize(("features", "coefficients"), [(0, 1), (16, 9)])
def test_gradients_of_the_reference(rasterizer: CudaRasterizer, features: int, coefficients: int) -> None:
    check_against_reference(rasterizer, make_scene(150, features, coefficients), 1e-5)


@pytest.mark.parametrize("coefficients", [4, 9, 16])
def test_spherical_harmonics(rasterizer: CudaRasterizer, coefficients: int) -> None:
    check_against_cpu(rasterizer, make_scene(coefficients=coefficients))


@pytest.mark.parametrize("coefficients", [1, 9])
def test_colours_end_at_black(rasterizer: CudaRasterizer, coefficients: int) -> None:
    scene = make_scene(coefficients=coefficients)
    scene.sh[:, 0] = 3 * scene.sh[:, 0] - 1.8
    found = check_against_cpu(rasterizer, scene)
    assert found["rendered_image"].min() >= 0 and (found["sh"][:, 0] < 0).any()


@pytest.mark.parametrize("active", [0, 1, 2])
def test_lower_active_degree_leaves_the_other_coefficients_alone(rasterizer: CudaRasterizer, active: int) -> None:
    found = check_against_cpu(rasterizer, make_scene(coefficients=16), active_sh_degree=active)
    assert not found["sh"][:, (active + 1) ** 2 :].any()


@pytest.mark.parametrize("size", [(1, 1), (16, 16), (17, 5), (64, 33)])
def test_image_sizes(rasterizer: CudaRasterizer, size: tuple[int, int]) -> None:
    camera = Camera(*size, 30.0, 31.0, size[0] / 2 - 0.6, size[1] / 2 - 0.2)
    check_against_cpu(rasterizer, make_scene(features=3), camera)


@pytest.mark.parametrize("features", [0, 16])
def test_crowded_and_saturated_tiles(rasterizer: CudaRasterizer, features: int) -> None:
    check_against_cpu(rasterizer, crowded_scene(features), tolerance=3e-5, median_depth=True)


def test_order_of_threads_does_not_matter(other_order: None) -> None:
    check_against_cpu(emulated_rasterizer(), crowded_scene(5), tolerance=3e-5, median_depth=True)


def test_large_gaussians_cover_many_tiles(rasterizer: CudaRasterizer) -> None:
    scene = make_scene(60)
    scene.log_scales[::2] += 2.5
    camera = CAMERA.resize(150, 110)
    check_against_cpu(rasterizer, scene, camera, tolerance=3e-5)
    assert rasterizer.statistics()["pairs"] > 60 * 10


def test_near_plane_and_low_pass() -> None:
    scene = make_scene(100)
    scene.means[:, 2] = torch.linspace(0.2, 1.2, 100)
    found = check_against_cpu(emulated_rasterizer(near_plane=0.7, low_pass=0.3), scene, pose=np.eye(4))
    assert not found["touched"][scene.means[:, 2] < 0.7].any()


def test_alpha_limit_passes_no_gradient(rasterizer: CudaRasterizer) -> None:
    scene = make_scene(20)
    scene.opacity_logits[:] = 9.0
    assert check_against_cpu(rasterizer, scene)["touched"].any()


def test_features_left_out_or_detached(rasterizer: CudaRasterizer) -> None:
    scene = make_scene(features=20)
    check_against_cpu(rasterizer, scene, features=False)
    check_against_cpu(rasterizer, scene, detach_features=True)


def test_only_some_image_gradients(rasterizer: CudaRasterizer) -> None:
    gradients = make_image_gradients(CAMERA, 2)
    rasterizer.forward(make_scene(features=2), CAMERA, POSE)
    depth_only = rasterizer.backward(None, gradients.depth)
    zero = torch.zeros_like
    spelled_out = rasterizer.backward(
        zero(gradients.image),
        gradients.depth,
        zero(gradients.alpha),
        zero(gradients.features),  # type: ignore[arg-type]
    )
    assert depth_only.means.any()
    for name in PARAMETERS:
        assert torch.equal(getattr(depth_only, name), getattr(spelled_out, name))


def test_pose_gradient_is_that_of_backward(rasterizer: CudaRasterizer) -> None:
    rasterizer.forward(make_scene(), CAMERA, POSE)
    arguments = make_image_gradients(CAMERA, 0).arguments()
    assert torch.equal(rasterizer.pose_gradient(*arguments), rasterizer.backward(*arguments).twist)


@pytest.mark.parametrize("count", [0, 50])
def test_nothing_in_view(rasterizer: CudaRasterizer, count: int) -> None:
    scene = make_scene(count, 2)
    scene.means[:, 2] -= 100
    found = run(rasterizer, scene, CAMERA, POSE, make_image_gradients(CAMERA, 2), median_depth=True)
    assert not any(value.any() for value in found.values())
    assert rasterizer.statistics() == {"visible": 0, "pairs": 0}


def test_degenerate_gaussians_are_skipped(rasterizer: CudaRasterizer) -> None:
    scene = make_scene(150, 3, 4)
    bad = bad_rows(scene)
    gradients = make_image_gradients(CAMERA, 3)
    found = run(rasterizer, scene, CAMERA, POSE, gradients)
    without = GaussianTensors(**{f.name: getattr(scene, f.name)[~bad] for f in dataclasses.fields(scene)})
    expected = run(rasterizer, without, CAMERA, POSE, gradients)
    for name, value in found.items():
        if name.startswith("rendered_"):
            assert torch.equal(value, expected[name]), name
        elif name != "twist":
            assert not value[bad].any(), name
            assert torch.isfinite(value).all(), name
    assert np.allclose(found["twist"], expected["twist"], rtol=1e-4)


def test_extreme_but_valid_gaussians(rasterizer: CudaRasterizer) -> None:
    scene = make_scene(64)
    scene.means[:16, 2] = torch.linspace(-0.2, 0.3, 16)  # about the camera and its near plane
    scene.log_scales[16:32] = torch.linspace(-23, 9.9, 16)[:, None]
    scene.log_scales[32:48, 0] = torch.linspace(-20, 9, 16)  # needles
    scene.opacity_logits[48:] = torch.linspace(5, 1e4, 16)
    found = run(rasterizer, scene, CAMERA, np.eye(4), make_image_gradients(CAMERA, 0))
    assert all(torch.isfinite(value).all() for value in found.values())


def test_too_little_room_for_pairs_is_made_good(rasterizer: CudaRasterizer) -> None:
    few, many = make_scene(5), make_scene(3000, seed=2)
    gradients = make_image_gradients(CAMERA, 0)
    expected = run(emulated_rasterizer(), many, CAMERA, POSE, gradients)
    rasterizer.forward(few, CAMERA, POSE)
    rasterizer.counter.expected_pairs = 100  # the next rendering starts with room for so many
    found = run(rasterizer, many, CAMERA, POSE, gradients)
    assert all(torch.equal(found[name], expected[name]) for name in expected)
    again = run(rasterizer, many, CAMERA, POSE, gradients)  # now with more room than there are pairs
    assert all(torch.equal(again[name], expected[name]) for name in expected)


class GuardedMemory(GrowingMemory):
    """Blocks of just the size asked for, filled with one value, between margins that nobody may write to."""

    MARGIN = 4096

    def __init__(self, value: int) -> None:
        super().__init__(torch.device("cpu"))
        self._value = value
        self._buffers: list[torch.Tensor] = []

    def block(self, name: str, size: int) -> torch.Tensor:
        self._buffers.append(torch.full((size + 2 * self.MARGIN,), self._value, dtype=torch.uint8))
        return self._buffers[-1][self.MARGIN : self.MARGIN + size]

    def untouched(self) -> bool:
        margins = [torch.cat([b[: self.MARGIN], b[len(b) - self.MARGIN :]]) for b in self._buffers]
        return bool(margins) and all(bool((margin == self._value).all()) for margin in margins)


@pytest.mark.parametrize("features", [0, 5, 16])
def test_what_was_in_memory_before_does_not_matter(rasterizer: CudaRasterizer, features: int) -> None:
    found = []
    for value in (0, 255):  # 255: NaN, or numbers far out of range
        rasterizer.memory = memory = GuardedMemory(value)
        rasterizer.counter.expected_pairs = 2000  # more than there are
        scene, gradients = make_scene(300, features), make_image_gradients(CAMERA, features)
        found.append(run(rasterizer, scene, CAMERA, POSE, gradients, median_depth=True))
        assert memory.untouched()
    assert all(torch.equal(found[0][name], found[1][name]) for name in found[0])


def leaves(scene: GaussianTensors) -> GaussianTensors:
    return GaussianTensors(**{name: getattr(scene, name).clone().requires_grad_() for name in PARAMETERS})


def test_autograd_keeps_several_renderings_apart(rasterizer: CudaRasterizer) -> None:
    options = {"near_plane": 0.05, "low_pass": 0.1}
    pose = torch.as_tensor(np.linalg.inv(POSE))
    results = []
    for render in (lambda *a: render_cuda(*a, rasterizer=rasterizer, **options), lambda *a: render_cpu(*a, **options)):
        first, second = leaves(make_scene(100, 2)), leaves(make_scene(80, seed=3))
        moving = pose.clone().requires_grad_()
        images = render(first, CAMERA, moving), render(second, CAMERA, moving)
        (images[0].image.sum() + images[0].features.sum() + 2 * images[1].depth.sum()).backward()
        results.append([first.means.grad, first.features.grad, second.log_scales.grad, moving.grad])
    for found, expected in zip(*results, strict=True):
        assert relative_error(found, expected) < 1e-5


def test_wrong_calls_are_refused(rasterizer: CudaRasterizer) -> None:
    scene, gradient = make_scene(5), torch.zeros(3, CAMERA.height, CAMERA.width)
    with pytest.raises(RenderError, match="forward"):
        rasterizer.backward(gradient)
    with pytest.raises(RenderError, match="4x4"):
        rasterizer.forward(scene, CAMERA, np.eye(3))
    with pytest.raises(RenderError, match="log_scales: .*contiguous"):
        rasterizer.forward(dataclasses.replace(scene, log_scales=torch.zeros(3, 5).T), CAMERA, POSE)
    rasterizer.forward(scene, CAMERA, POSE)
    with pytest.raises(RenderError, match="grad_image"):
        rasterizer.backward(gradient[:2])
    with pytest.raises(RenderError, match="features"):
        rasterizer.backward(gradient, grad_features=gradient)
    with pytest.raises(RenderError, match="near_plane"):
        emulated_rasterizer(near_plane=0.0)


def test_the_current_device_stays_what_it_was(rasterizer: CudaRasterizer) -> None:
    exchange = rasterizer.library.functions.ggslam_emulation_device
    exchange(3)
    try:
        rasterizer.forward(make_scene(20, 0), CAMERA, POSE)
    finally:
        assert exchange(0) == 3


def test_emulated_kernels_may_be_called_by_several_threads(rasterizer: CudaRasterizer) -> None:
    scene = make_scene(100, 4)
    expected = rasterizer.forward(scene, CAMERA, POSE).image.clone()

    def render(_: int) -> torch.Tensor:
        return CudaRasterizer(library=rasterizer.library).forward(scene, CAMERA, POSE).image

    with ThreadPoolExecutor(4) as pool:
        assert all(torch.equal(image, expected) for image in pool.map(render, range(8)))
