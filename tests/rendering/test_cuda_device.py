# SPDX-License-Identifier: Apache-2.0
"""The CUDA rasterizer on a GPU, against the CPU rasterizer. Skipped where there is none."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest
import torch
from cuda_contract import CAMERA, POSE, check_against_cpu, check_against_reference, crowded_scene, moved, run
from rendering_scenes import make_image_gradients, make_scene, relative_error
from test_cpu_rules import bad_rows

from ggslam.cuda.availability import cuda_backend_problem
from ggslam.rendering import choose_backend, render
from ggslam.rendering.cuda.rasterizer import CudaRasterizer
from ggslam.rendering.types import PARAMETERS, GaussianTensors
from ggslam.scene.camera import Camera

pytestmark = [
    pytest.mark.gpu,
    pytest.mark.skipif(not torch.cuda.is_available(), reason="torch finds no CUDA device"),
]

ON_GPU_TOLERANCE = 3e-5
"""Relative tolerance of gradients: sums in changing order, approximate division."""


@pytest.fixture(scope="module")
def rasterizer() -> CudaRasterizer:
    problem = cuda_backend_problem()
    if problem is not None:
        pytest.skip(problem)
    return CudaRasterizer()


@pytest.mark.parametrize("features", [0, 1, 2, 3, 5, 8, 9, 12, 16, 17, 33, 40])
def test_every_number_of_channels(rasterizer: CudaRasterizer, features: int) -> None:
    check_against_cpu(rasterizer, make_scene(features=features), tolerance=ON_GPU_TOLERANCE, median_depth=True)


@pytest.mark.parametrize(("features", "coefficients"), [(0, 1), (16, 9)])
def test_gradients_of_the_reference(rasterizer: CudaRasterizer, features: int, coefficients: int) -> None:
    check_against_reference(rasterizer, make_scene(150, features, coefficients), ON_GPU_TOLERANCE)


@pytest.mark.parametrize("size", [(1, 1), (17, 5), (64, 33)])
def test_image_sizes(rasterizer: CudaRasterizer, size: tuple[int, int]) -> None:
    camera = Camera(*size, 30.0, 31.0, size[0] / 2 - 0.6, size[1] / 2 - 0.2)
    check_against_cpu(rasterizer, make_scene(features=3), camera, tolerance=ON_GPU_TOLERANCE)


@pytest.mark.parametrize("features", [0, 16])
def test_crowded_and_saturated_tiles(rasterizer: CudaRasterizer, features: int) -> None:
    check_against_cpu(rasterizer, crowded_scene(features), tolerance=1e-4, median_depth=True)


@pytest.mark.parametrize("features", [0, 16])
def test_a_scene_of_usual_size(rasterizer: CudaRasterizer, features: int) -> None:
    scene = make_scene(60_000, features, 4)
    scene.log_scales -= 2.0
    camera = Camera(640, 480, 500.0, 500.0, 319.5, 239.5)
    check_against_cpu(rasterizer, scene, camera, tolerance=1e-4, borderline_tolerance=5e-4)


def test_features_detached(rasterizer: CudaRasterizer) -> None:
    check_against_cpu(rasterizer, make_scene(features=16), tolerance=ON_GPU_TOLERANCE, detach_features=True)


def test_degenerate_gaussians_are_skipped(rasterizer: CudaRasterizer) -> None:
    scene = make_scene(150, 3, 4)
    bad = bad_rows(scene)
    gradients = make_image_gradients(CAMERA, 3)
    found = run(rasterizer, scene, CAMERA, POSE, gradients)
    without = GaussianTensors(**{f.name: getattr(scene, f.name)[~bad] for f in dataclasses.fields(scene)})
    expected = run(rasterizer, without, CAMERA, POSE, gradients)
    assert torch.equal(found["rendered_image"], expected["rendered_image"])
    for name in PARAMETERS:
        assert not found[name][bad].any() and torch.isfinite(found[name]).all(), name


def test_room_for_pairs_grows(rasterizer: CudaRasterizer) -> None:
    few, many = make_scene(5), make_scene(20_000, seed=2)
    rasterizer.forward(moved(few, rasterizer.device), CAMERA, POSE)
    check_against_cpu(rasterizer, many, tolerance=1e-4)


def test_another_stream(rasterizer: CudaRasterizer) -> None:
    scene, gradients = make_scene(500, 16), make_image_gradients(CAMERA, 16)
    expected = run(rasterizer, scene, CAMERA, POSE, gradients)
    with torch.cuda.stream(torch.cuda.Stream()):
        found = run(CudaRasterizer(), scene, CAMERA, POSE, gradients)
    assert torch.equal(found["rendered_image"], expected["rendered_image"])
    assert relative_error(found["means"], expected["means"]) < ON_GPU_TOLERANCE


def test_backend_by_name(rasterizer: CudaRasterizer) -> None:
    scene, pose = make_scene(200, 4), np.linalg.inv(POSE)
    on_gpu = moved(scene, rasterizer.device)
    for name in PARAMETERS:
        getattr(on_gpu, name).requires_grad_()
    found = render(on_gpu, CAMERA, T_world_camera=pose, backend="auto")
    expected = render(scene, CAMERA, T_world_camera=pose, backend="auto")
    assert choose_backend() == "cuda" and expected.image.device.type == "cpu"
    assert relative_error(found.image.detach().cpu(), expected.image) < 1e-5
    found.image.sum().backward()
    assert on_gpu.means.grad is not None and on_gpu.means.grad.any()
