# SPDX-License-Identifier: Apache-2.0
"""What sampled compositing by the CUDA kernels does at its limits, and that nothing waits for it."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from cuda_terms import ALL, RATES, SIZE, Both, make_map
from rendering_scenes import CAMERA, POSE, make_scene

from ggslam.cuda.library import CudaLibrary
from ggslam.errors import RenderError
from ggslam.rendering.cuda.pixel_terms import CudaPixelTerms
from ggslam.rendering.cuda.rasterizer import CudaRasterizer


def test_pixels_outside_the_image_have_no_terms(cuda_library: CudaLibrary) -> None:
    both = Both(cuda_library, make_scene(300, 2))
    inside = int(both.view.alpha.argmax())
    pixels = np.array([-1, SIZE, inside, 2**31 - 1, -(2**31)], np.int32)
    terms = both.cuda_terms(pixels, 8, 1e-3)
    assert torch.equal(terms.counts.cpu() > 0, torch.from_numpy(pixels == inside))
    assert not terms.weights[3].any() and not terms.gaussians[3].any()


def test_zero_pixels_and_an_empty_map(cuda_library: CudaLibrary) -> None:
    for count, pixels in ((50, ALL[:0]), (0, ALL[:9])):
        both = Both(cuda_library, make_scene(count, 2))
        terms = both.cuda_terms(pixels.copy(), 8, 1e-3)
        size = len(pixels)
        assert not terms.counts.any() and terms.opacity().shape == (size,)
        assert torch.equal(terms.features(both.device_map).cpu(), torch.zeros(size, 2))
        terms.step(both.device_map, torch.ones(size, 2, device=both.device), RATES)
        terms.vote(both.device_map, torch.ones(size, dtype=torch.int32, device=both.device))
        ids, shares = terms.labels(torch.ones(count, dtype=torch.int32, device=both.device))
        assert not ids.any() and not shares.any() and len(ids) == size
        assert not both.device_map.feature_updates.any() and not terms.weight_sums(count).any()


def test_gaussians_beyond_the_map_are_passed_over(cuda_library: CudaLibrary) -> None:
    device = cuda_library.whole_device(None)
    gaussians = make_map(make_scene(4, 2), device)
    terms = CudaPixelTerms.of_gaussians(torch.tensor([-1, 1, 4, 2**31 - 1], device=device), 2, cuda_library)
    terms.step(gaussians, torch.ones(4, 2, device=device), RATES)
    terms.vote(gaussians, torch.ones(4, dtype=torch.int32, device=device))
    assert gaussians.feature_updates.tolist() == [0, 1, 0, 0]
    assert terms.features(gaussians).any(1).tolist() == [False, True, False, False]
    assert terms.labels(torch.full((4,), 6, dtype=torch.int32, device=device))[0].tolist() == [0, 6, 0, 0]


def test_terms_outlive_the_next_rendering_and_the_step_of_the_features(cuda_library: CudaLibrary) -> None:
    both = Both(cuda_library, make_scene(200, 16))
    before = both.cuda_terms(ALL, 32, 1e-3)
    weights = before.weights.clone()
    before.step(both.device_map, torch.ones(SIZE, 16, device=both.device), RATES)
    assert torch.equal(both.cuda_terms(ALL, 32, 1e-3).weights, weights)
    both.cuda.forward(both.device_map, CAMERA, np.eye(4), features=False)
    assert torch.equal(before.weights, weights)
    assert not torch.equal(both.cuda_terms(ALL, 32, 1e-3).weights, weights)


def test_nothing_waits_for_the_device(cuda_library: CudaLibrary, monkeypatch: pytest.MonkeyPatch) -> None:
    both = Both(cuda_library, make_scene(200, 16))
    pixels, rows = both.given(ALL), torch.arange(9, device=both.device)
    gradient = torch.ones(SIZE + 9, 16, device=both.device)
    labels = torch.ones(SIZE, dtype=torch.int32, device=both.device)

    def refuse(*_: object) -> None:
        raise AssertionError("the host asks for numbers that are on the device")

    for name in ("item", "cpu", "numpy", "tolist", "nonzero", "__bool__", "__int__", "__float__", "__index__"):
        monkeypatch.setattr(torch.Tensor, name, refuse)
    terms = both.cuda.pixel_terms(pixels).append(CudaPixelTerms.of_gaussians(rows, 48, cuda_library))
    terms.features(both.device_map), terms.labels(labels[:200]), terms.opacity(), terms.weight_sums(200)
    terms.step(both.device_map, gradient, RATES)
    terms.vote(both.device_map, labels)


def test_impossible_requests_are_refused(cuda_library: CudaLibrary) -> None:
    device = cuda_library.whole_device(None)
    gaussians, rasterizer = make_map(make_scene(50, 16), device), CudaRasterizer(device, library=cuda_library)
    pixels = torch.arange(5, dtype=torch.int32, device=device)
    with pytest.raises(RenderError, match="forward"):
        rasterizer.pixel_terms(pixels)
    rasterizer.forward(gaussians, CAMERA, POSE)
    with pytest.raises(RenderError, match="capacity"):
        rasterizer.pixel_terms(pixels, 0)
    with pytest.raises(RenderError, match=r"torch.int32 \[P\].*torch.int64"):
        rasterizer.pixel_terms(pixels.long())
    with pytest.raises(RenderError, match="2147483647"):
        rasterizer.pixel_terms(pixels, 2**30)
    terms = rasterizer.pixel_terms(pixels)
    with pytest.raises(RenderError, match="gradient"):
        terms.step(gaussians, torch.zeros(4, 16, device=device), RATES)
    with pytest.raises(RenderError, match="contiguous"):
        terms.step(gaussians, torch.zeros(16, 5, device=device).T, RATES)
    with pytest.raises(RenderError, match="labels"):
        terms.vote(gaussians, torch.zeros(5, dtype=torch.int64, device=device))
    with pytest.raises(RenderError, match="labels"):
        terms.vote(gaussians, torch.zeros(6, dtype=torch.int32, device=device))
    plain = make_map(make_scene(50, 0), device)
    with pytest.raises(RenderError, match=r"\b1 to 64\b.*\b0\b"):
        terms.features(plain)
    with pytest.raises(RenderError, match="vote_ids"):
        terms.vote(plain, torch.zeros(5, dtype=torch.int32, device=device))
