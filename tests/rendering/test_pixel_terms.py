# SPDX-License-Identifier: Apache-2.0
"""Sampled compositing against whole images."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from rendering_scenes import CAMERA, POSE, make_scene

from ggslam.errors import RenderError
from ggslam.native.loader import available_instruction_sets
from ggslam.rendering.adam import AdamSettings
from ggslam.rendering.cpu import CpuRasterizer
from ggslam.rendering.pixel_terms import CpuPixelTerms, FeatureAdamSettings
from ggslam.scene.gaussian_map import GaussianMap

ALL = np.arange(CAMERA.width * CAMERA.height)


def make_map(features: int = 16, compact: bool = False) -> GaussianMap:
    scene = make_scene(300, features)
    gaussians = GaussianMap(0, features, compact_features=compact)
    gaussians.insert(
        scene.means, scene.quaternions, scene.log_scales, scene.opacity_logits, torch.rand(300, 3), scene.features
    )
    return gaussians


@pytest.mark.parametrize("close_below", [0.0, 0.2])
@pytest.mark.parametrize("isa", available_instruction_sets())
def test_terms_compose_the_rendered_features_and_alpha(isa: str, close_below: float) -> None:
    gaussians, rasterizer = make_map(), CpuRasterizer(2, isa)
    view = rasterizer.forward(gaussians, CAMERA, POSE, close_below=close_below)
    features, alpha = view.features.numpy().reshape(16, -1).T.copy(), view.alpha.numpy().reshape(-1).copy()
    rasterizer.forward(gaussians, CAMERA, POSE, features=False, close_below=close_below)
    pixels = np.random.default_rng(0).permutation(ALL)
    terms = rasterizer.pixel_terms(pixels, 300, 0.0)
    assert np.abs(terms.features(gaussians) - features[pixels]).max() < 1e-5
    assert np.abs(terms.opacity() - alpha[pixels]).max() < 1e-5
    assert terms.counts.max() > 3


def test_capacity_keeps_the_front_and_light_terms_are_left_out() -> None:
    gaussians, rasterizer = make_map(), CpuRasterizer()
    rasterizer.forward(gaussians, CAMERA, POSE)
    everything, front = rasterizer.pixel_terms(ALL, 300, 0.0), rasterizer.pixel_terms(ALL, 2, 0.0)
    assert front.counts.max() == 2
    full = everything.counts >= 2
    assert np.array_equal(front.gaussians[full], everything.gaussians[full, :2])
    heavy = rasterizer.pixel_terms(ALL, 300, 0.1)
    used = np.arange(300) < heavy.counts[:, None]
    assert heavy.weights[used].min() >= 0.1 and heavy.counts.sum() < everything.counts.sum()


@pytest.mark.parametrize("close_below", [0.0, 0.2])
@pytest.mark.parametrize("isa", available_instruction_sets())
def test_shown_are_those_with_a_heavy_term(isa: str, close_below: float) -> None:
    gaussians, rasterizer = make_map(), CpuRasterizer(2, isa)
    with pytest.raises(RenderError):
        rasterizer.mark_shown(np.zeros(300, bool), 0.1)
    rasterizer.forward(gaussians, CAMERA, POSE, features=False, close_below=close_below)
    for least in (0.0, 0.05, 0.4):
        shown, expected = np.zeros(300, bool), np.zeros(300, bool)
        rasterizer.mark_shown(shown, least)
        terms = rasterizer.pixel_terms(ALL, 300, least)
        expected[terms.rows()] = True
        assert np.array_equal(shown, expected) and 0 < shown.sum() < 300
    kept = np.ones(300, bool)
    rasterizer.mark_shown(kept, 2.0)
    assert kept.all()
    for wrong in (np.zeros(299, bool), np.zeros(300, np.uint8), np.zeros(600, bool)[::2]):
        with pytest.raises(RenderError, match="mark_shown"):
            rasterizer.mark_shown(wrong, 0.1)


def test_the_step_is_adam_on_the_summed_gradient() -> None:
    gaussians, rasterizer = make_map(), CpuRasterizer()
    rasterizer.forward(gaussians, CAMERA, POSE, features=False)
    pixels = ALL[::7]
    terms = rasterizer.pixel_terms(pixels, 64, 1e-3)
    weights = np.zeros((len(pixels), len(gaussians)), np.float32)
    for row, count in enumerate(terms.counts):
        weights[row, terms.gaussians[row, :count]] = terms.weights[row, :count]
    touched = weights.any(0)
    parameter = torch.nn.Parameter(gaussians.features[torch.from_numpy(touched)].clone())
    adam = torch.optim.Adam([parameter], lr=0.05, betas=(0.9, 0.99), eps=1e-15)
    untouched = gaussians.features[torch.from_numpy(~touched)].clone()
    random = np.random.default_rng(0)
    for _ in range(3):
        gradient = random.normal(size=(len(pixels), 16)).astype(np.float32)
        parameter.grad = torch.from_numpy(weights[:, touched].T @ gradient)
        adam.step()
        terms.step(gaussians, gradient, FeatureAdamSettings())
    assert torch.allclose(gaussians.features[torch.from_numpy(touched)], parameter.detach(), atol=2e-4)
    assert torch.equal(gaussians.features[torch.from_numpy(~touched)], untouched)
    assert np.array_equal(gaussians.feature_updates.numpy(), 3 * touched)


def test_compact_moments_step_all_channels_by_one_length() -> None:
    gaussians, rasterizer = make_map(compact=True), CpuRasterizer()
    terms = CpuPixelTerms.of_gaussians(np.array([3, 7]), 2, rasterizer.context)
    before = gaussians.features.numpy().copy()
    first, second, random = np.zeros((2, 16)), np.zeros(2), np.random.default_rng(0)
    expected = before[[3, 7]].astype(float)
    for step in range(1, 6):
        gradient = random.normal(size=(2, 16)).astype(np.float32)
        first, second = 0.9 * first + 0.1 * gradient, 0.99 * second + 0.01 * (gradient**2).mean(1)
        expected -= 0.05 * first / (1 - 0.9**step) / np.sqrt(second / (1 - 0.99**step))[:, None]
        terms.step(gaussians, gradient, FeatureAdamSettings())
    after = gaussians.features.numpy()
    assert np.allclose(after[[3, 7]], expected, atol=2e-3) and not np.allclose(after[[3, 7]], before[[3, 7]], atol=0.05)
    assert np.array_equal(np.delete(after, [3, 7], 0), np.delete(before, [3, 7], 0))
    rasterizer.forward(gaussians, CAMERA, POSE)
    with pytest.raises(RenderError, match="compact"):
        rasterizer.backward_step(
            gaussians, None, grad_features=torch.zeros(16, CAMERA.height, CAMERA.width), optimizer=AdamSettings()
        )


@pytest.mark.parametrize("compact", [False, True])
def test_learning_is_a_step_and_votes(compact: bool) -> None:
    results = []
    gradient = np.random.default_rng(1).normal(size=(len(ALL), 16)).astype(np.float32)
    labels, weights = (ALL % 9).astype(np.uint16), np.linspace(0, 2, len(ALL), dtype=np.float32)
    for at_once in (False, True):
        gaussians, rasterizer = make_map(compact=compact), CpuRasterizer()
        rasterizer.forward(gaussians, CAMERA, POSE, features=False)
        terms = rasterizer.pixel_terms(ALL)
        if at_once:
            terms.learn(gaussians, gradient, FeatureAdamSettings(), labels, weights)
        else:
            terms.step(gaussians, gradient, FeatureAdamSettings())
            terms.vote(gaussians, labels, weights)
        results.append((gaussians.features.numpy().copy(), gaussians.vote_weights.numpy().copy()))
    assert np.array_equal(results[0][0], results[1][0]) and np.array_equal(results[0][1], results[1][1])


@pytest.mark.parametrize("compact", [False, True])
def test_threads_do_not_change_a_step(compact: bool) -> None:
    results = []
    for threads in (1, 3):
        gaussians, rasterizer = make_map(compact=compact), CpuRasterizer(threads)
        rasterizer.forward(gaussians, CAMERA, POSE, features=False)
        terms = rasterizer.pixel_terms(ALL)
        gradient = np.random.default_rng(1).normal(size=(len(ALL), 16)).astype(np.float32)
        terms.step(gaussians, gradient, FeatureAdamSettings())
        terms.vote(gaussians, (ALL % 9).astype(np.uint16))
        results.append((gaussians.features.numpy().copy(), gaussians.vote_weights.numpy().copy()))
    assert np.array_equal(results[0][0], results[1][0]) and np.array_equal(results[0][1], results[1][1])


def test_votes_are_the_rendering_weights_under_each_label() -> None:
    gaussians, rasterizer = make_map(), CpuRasterizer()
    rasterizer.forward(gaussians, CAMERA, POSE)
    terms = rasterizer.pixel_terms(ALL, 300, 0.0)
    labels = np.where(ALL % CAMERA.width < 20, 7, 0).astype(np.uint16)
    terms.vote(gaussians, labels, np.full(len(ALL), 2, np.float32))
    expected = np.zeros(len(gaussians))
    used = (np.arange(300) < terms.counts[:, None]) & (labels > 0)[:, None]
    np.add.at(expected, terms.gaussians[used], 2 * terms.weights[used])
    assert np.allclose(gaussians.vote_weights.numpy().sum(1), expected, atol=1e-4)
    assert set(np.unique(gaussians.vote_ids.numpy())) == {0, 7}


def test_a_label_with_most_of_the_weight_survives_any_number_of_others() -> None:
    gaussians, rasterizer = make_map(), CpuRasterizer()
    rows = np.zeros(400, np.int64)
    labels = np.where(np.arange(400) % 2 == 0, 5, np.arange(400) + 100).astype(np.uint16)
    CpuPixelTerms.of_gaussians(rows, 4, rasterizer.context).vote(gaussians, labels)
    heaviest = gaussians.vote_ids.numpy()[0, gaussians.vote_weights.numpy()[0].argmax()]
    assert heaviest == 5 and gaussians.vote_weights.numpy()[0].sum() == 400


def test_the_label_of_a_pixel_is_the_one_with_the_largest_weight() -> None:
    gaussians, rasterizer = make_map(), CpuRasterizer()
    rasterizer.forward(gaussians, CAMERA, POSE)
    terms = rasterizer.pixel_terms(ALL, 300, 0.0)
    labels = (np.arange(len(gaussians)) % 3 + 1).astype(np.uint16)
    ids, share = terms.labels(labels)
    for row in range(0, len(ALL), 31):
        n = terms.counts[row]
        sums = np.bincount(labels[terms.gaussians[row, :n]], terms.weights[row, :n], 4)
        if n == 0:
            assert ids[row] == 0 and share[row] == 0
        else:
            assert sums[ids[row]] == pytest.approx(sums.max(), rel=1e-5)
            assert share[row] == pytest.approx(sums.max() / sums.sum(), rel=1e-4)


def test_impossible_requests_are_refused() -> None:
    gaussians, rasterizer = make_map(), CpuRasterizer()
    with pytest.raises(RenderError, match="forward"):
        rasterizer.pixel_terms(ALL)
    rasterizer.forward(gaussians, CAMERA, POSE)
    with pytest.raises(RenderError, match=r"pixels.*\b0\b"):
        rasterizer.pixel_terms(np.array([len(ALL)]))
    with pytest.raises(RenderError, match="capacity"):
        rasterizer.pixel_terms(ALL, 0)
    terms = rasterizer.pixel_terms(ALL[:5])
    with pytest.raises(RenderError, match="gradient"):
        terms.step(gaussians, np.zeros((4, 16), np.float32), FeatureAdamSettings())
    with pytest.raises(RenderError, match="labels"):
        terms.vote(gaussians, np.zeros(4, np.uint16))
    with pytest.raises(RenderError, match="label.*Gaussian"):
        rasterizer.pixel_terms(ALL).labels(np.zeros(3, np.uint16))
