# SPDX-License-Identifier: Apache-2.0
"""Sampled compositing by the CUDA kernels, emulated or on a GPU, against the CPU's."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from cuda_contract import crowded_scene
from cuda_terms import ALL, RATES, Both, copied, make_map, on_cpu
from rendering_scenes import CAMERA, make_scene

from ggslam.cuda.library import CudaLibrary
from ggslam.errors import RenderError
from ggslam.rendering.cpu import CpuRasterizer
from ggslam.rendering.cuda.pixel_terms import CudaPixelTerms
from ggslam.rendering.pixel_terms import CpuPixelTerms


def assert_terms_agree(found: CpuPixelTerms, expected: CpuPixelTerms) -> None:
    """The same Gaussians in the same order with the same weights; but rounding decides about contributions of just
    1/255 and of just the least weight, so that one pixel in a hundred may differ."""
    capacity = found.gaussians.shape[1]
    used = np.arange(capacity) < found.counts[:, None]
    assert not found.gaussians[~used].any() and not found.weights[~used].any()
    rows = np.where(np.arange(capacity) < expected.counts[:, None], expected.gaussians, 0)
    same = (found.counts == expected.counts) & (found.gaussians == rows).all(1)
    assert (~same).sum() <= len(same) / 100
    error = np.abs(found.weights - np.where(used, expected.weights, 0))[same]
    assert error.max(initial=0) < 1e-5


@pytest.mark.parametrize(("capacity", "min_weight"), [(300, 0.0), (48, 1e-3), (32, 5e-3), (3, 0.05), (1, 1e-3)])
def test_terms_are_those_of_the_cpu(cuda_library: CudaLibrary, capacity: int, min_weight: float) -> None:
    both = Both(cuda_library, make_scene(300, 16))
    pixels = np.random.default_rng(0).permutation(ALL)
    pixels[5:8] = pixels[0]  # a pixel may be drawn more than once
    found = on_cpu(both.cuda_terms(pixels, capacity, min_weight), both.cpu)
    assert_terms_agree(found, both.cpu.pixel_terms(pixels, capacity, min_weight))
    assert found.counts.max() == capacity if capacity < 10 else 3 < found.counts.max() < capacity
    assert np.array_equal(found.weights[5], found.weights[0])


def test_crowded_and_saturated_tiles(cuda_library: CudaLibrary) -> None:
    both = Both(cuda_library, crowded_scene(4))
    found = on_cpu(both.cuda_terms(ALL, 48, 1e-3), both.cpu)
    assert_terms_agree(found, both.cpu.pixel_terms(ALL, 48, 1e-3))
    assert both.view.alpha.max() > 0.999 and both.cuda.statistics()["pairs"] > 6 * 256


def test_order_of_threads_does_not_matter(cuda_library: CudaLibrary, other_order: None) -> None:
    both = Both(cuda_library, crowded_scene(16))
    pixels = ALL[::3].copy()
    found = on_cpu(both.cuda_terms(pixels, 48, 1e-3), both.cpu)
    assert_terms_agree(found, both.cpu.pixel_terms(pixels, 48, 1e-3))
    check_step(both, pixels, 2)
    check_votes(both, pixels)


def test_weights_sum_up_to_the_rendered_opacity(cuda_library: CudaLibrary) -> None:
    both = Both(cuda_library, make_scene(300, 16))
    terms = both.cuda_terms(ALL, 300, 0.0)
    assert float((terms.opacity() - both.view.alpha.reshape(-1)).abs().max()) < 1e-5


@pytest.mark.parametrize("features", [1, 5, 16, 20, 64])
def test_features_are_those_of_the_same_terms_on_the_cpu(cuda_library: CudaLibrary, features: int) -> None:
    both = Both(cuda_library, make_scene(200, features))
    expected, terms = both.equal_terms(ALL[::2].copy())
    found = terms.features(both.device_map).cpu().numpy()
    assert found.shape == (len(terms), features)
    assert np.abs(found - expected.features(both.map)).max() < 1e-5


def check_step(both: Both, pixels: np.ndarray, steps: int) -> None:
    expected, terms = both.equal_terms(pixels)
    channels, random = both.map.features.shape[1], np.random.default_rng(0)
    reference, found = copied(both.map, "cpu"), copied(both.map, both.device)
    for _ in range(steps):
        gradient = random.normal(size=(len(pixels), channels)).astype(np.float32)
        expected.step(reference, gradient, RATES)
        terms.step(found, both.given(gradient), RATES)
    assert torch.equal(found.feature_updates.cpu(), reference.feature_updates)
    assert 0 < int((reference.feature_updates == steps).sum()) < len(reference)
    for a, b in zip(found.moments["features"], reference.moments["features"], strict=True):
        assert torch.allclose(a.cpu(), b, rtol=1e-4, atol=1e-6)
    # A gradient that all but cancels has a sign that rounding decides, and Adam steps by its sign.
    differing = (found.features.cpu() - reference.features).abs() > 1e-4
    assert int(differing.sum()) <= differing.numel() / 1000
    untouched = reference.feature_updates == 0
    assert torch.equal(found.features.cpu()[untouched], both.map.features[untouched])


@pytest.mark.parametrize("features", [1, 5, 16, 20, 33, 64])
def test_steps_are_those_of_the_cpu(cuda_library: CudaLibrary, features: int) -> None:
    check_step(Both(cuda_library, make_scene(200, features)), ALL[::2].copy(), 3)


def test_a_gaussian_seen_by_many_pixels_sums_them_all(cuda_library: CudaLibrary) -> None:
    scene = make_scene(3, 5)
    gaussians, device = make_map(scene), cuda_library.whole_device(None)
    found, context = make_map(scene, device), CpuRasterizer(1).context
    rows = np.repeat(np.array([2, 0, 2], np.int32), [70, 1, 45])
    gradient = np.random.default_rng(2).normal(size=(len(rows), 5)).astype(np.float32)
    terms = CudaPixelTerms.of_gaussians(torch.from_numpy(rows).to(device), 4, cuda_library)
    CpuPixelTerms.of_gaussians(rows, 4, context).step(gaussians, gradient, RATES)
    terms.step(found, torch.from_numpy(gradient).to(device), RATES)
    assert torch.equal(found.feature_updates.cpu(), torch.tensor([1, 0, 1], dtype=torch.int32))
    assert torch.allclose(found.moments["features"][0].cpu(), gaussians.moments["features"][0], rtol=1e-5, atol=1e-6)
    assert torch.equal(terms.weight_sums(3).cpu(), torch.tensor([1.0, 0.0, 115.0]))


def test_a_gradient_that_is_no_number_stays_with_its_gaussians(cuda_library: CudaLibrary) -> None:
    device = cuda_library.whole_device(None)
    gaussians = make_map(make_scene(3, 5), device)
    terms = CudaPixelTerms.of_gaussians(torch.tensor([0, 1, 1, 1], device=device), 2, cuda_library)
    gradient = torch.ones(4, 5, device=device)
    gradient[0] = torch.nan
    terms.step(gaussians, gradient, RATES)
    assert torch.equal(gaussians.features.isfinite().all(1).cpu(), torch.tensor([False, True, True]))


def check_votes(both: Both, pixels: np.ndarray) -> None:
    expected, terms = both.equal_terms(pixels)
    reference, found = copied(both.map, "cpu"), copied(both.map, both.device)
    random = np.random.default_rng(3)
    for most in (2, 9, 9):  # later there are more labels than slots
        labels = random.integers(0, most, len(pixels)).astype(np.int32)
        factors = random.random(len(pixels), np.float32) if most == 9 else None
        expected.vote(reference, labels.astype(np.uint16), factors)
        terms.vote(found, both.given(labels), None if factors is None else both.given(factors))
    assert torch.equal(found.vote_ids.cpu(), reference.vote_ids)
    assert torch.allclose(found.vote_weights.cpu(), reference.vote_weights, rtol=1e-5, atol=1e-6)
    assert int((reference.vote_ids > 0).all(1).sum()) > 10


def test_votes_are_those_of_the_cpu(cuda_library: CudaLibrary) -> None:
    check_votes(Both(cuda_library, make_scene(200, 16)), ALL[::2].copy())


def test_pixels_joined_to_others_need_no_labels(cuda_library: CudaLibrary) -> None:
    both = Both(cuda_library, make_scene(200, 16))
    expected, terms = both.equal_terms(ALL[::2].copy())
    joined = terms.append(CudaPixelTerms.of_gaussians(torch.arange(50, device=both.device), 32, cuda_library))
    labels = (np.arange(len(terms)) % 3).astype(np.int32)
    factors = np.linspace(0, 1, len(terms), dtype=np.float32)
    expected.vote(both.map, labels.astype(np.uint16), factors)
    joined.vote(both.device_map, both.given(labels), both.given(factors))
    assert torch.equal(both.device_map.vote_ids.cpu(), both.map.vote_ids)
    assert torch.allclose(both.device_map.vote_weights.cpu(), both.map.vote_weights, rtol=1e-5, atol=1e-6)


def test_a_label_with_most_of_the_weight_survives_any_number_of_others(cuda_library: CudaLibrary) -> None:
    device = cuda_library.whole_device(None)
    gaussians = make_map(make_scene(300, 16), device)
    labels = torch.where(torch.arange(400) % 2 == 0, 5, torch.arange(400) + 100).to(torch.int32).to(device)
    rows = torch.zeros(400, dtype=torch.int64, device=device)
    CudaPixelTerms.of_gaussians(rows, 4, cuda_library).vote(gaussians, labels)
    weights = gaussians.vote_weights[0].cpu()
    assert int(gaussians.vote_ids[0].cpu()[weights.argmax()]) == 5 and float(weights.sum()) == 400


@pytest.mark.parametrize("labels", [3, 40])
def test_labels_are_those_of_the_cpu(cuda_library: CudaLibrary, labels: int) -> None:
    """With 40 labels some pixels have more than are told apart."""
    both = Both(cuda_library, make_scene(600, 4))
    expected, terms = both.equal_terms(ALL, 48)
    assert expected.counts.max() > 32
    of_gaussians = (np.arange(600) % labels).astype(np.int32)
    ids, shares = terms.labels(both.given(of_gaussians))
    expected_ids, expected_shares = expected.labels(of_gaussians.astype(np.uint16))
    assert np.array_equal(ids.cpu().numpy(), expected_ids)
    assert np.abs(shares.cpu().numpy() - expected_shares).max() < 1e-6
    if labels == 40:
        distinct = [len(set(row[:n] % 40)) for row, n in zip(expected.gaussians, expected.counts, strict=True)]
        assert max(distinct) > 16


def test_weight_sums_are_those_of_the_terms(cuda_library: CudaLibrary) -> None:
    both = Both(cuda_library, make_scene(200, 16))
    expected, terms = both.equal_terms(ALL, 48)
    inside = (ALL % CAMERA.width < 12).astype(np.float32)
    for factors in (None, inside):
        sums = np.bincount(
            expected.gaussians.reshape(-1),
            (expected.weights if factors is None else expected.weights * factors[:, None]).reshape(-1), 200,
        )  # fmt: skip
        found = terms.weight_sums(200, None if factors is None else both.given(factors)).cpu().numpy()
        assert np.abs(found - sums).max() < 1e-4 and sums.max() > 1


def test_everything_repeats_bit_for_bit(cuda_library: CudaLibrary) -> None:
    results = []
    for _ in range(2):
        both = Both(cuda_library, crowded_scene(16))
        terms = both.cuda_terms(ALL[::2].copy(), 32, 5e-3)
        pulled = CudaPixelTerms.of_gaussians(torch.arange(7, device=both.device), 32, cuda_library)
        terms = terms.append(pulled)
        gradient = np.random.default_rng(1).normal(size=(len(terms), 16)).astype(np.float32)
        terms.step(both.device_map, both.given(gradient), RATES)
        terms.vote(both.device_map, both.given((np.arange(len(terms)) % 9).astype(np.int32)))
        rendered = terms.features(both.device_map)
        changed = (both.device_map.features, both.device_map.vote_ids, both.device_map.vote_weights)
        results.append([value.cpu().clone() for value in (*changed, rendered, terms.weights, terms.weight_sums(1500))])
    assert all(torch.equal(a, b) for a, b in zip(*results, strict=True))


def test_pseudo_pixels_follow_when_joined(cuda_library: CudaLibrary) -> None:
    both = Both(cuda_library, make_scene(50, 3))
    terms = both.cuda_terms(ALL[:40].copy(), 8, 1e-3)
    rows = torch.tensor([4, 4, 49], device=both.device)
    joined = terms.append(CudaPixelTerms.of_gaussians(rows, 8, cuda_library))
    assert len(joined) == 43 and joined.capacity == 8
    assert torch.equal(joined.weights[:40], terms.weights)
    assert torch.equal(joined.features(both.device_map)[40:], both.device_map.features[rows])
    assert torch.equal(joined.opacity()[40:].cpu(), torch.ones(3))
    with pytest.raises(RenderError, match=r"\b8\b.*\b9\b"):
        terms.append(CudaPixelTerms.of_gaussians(rows, 9, cuda_library))
