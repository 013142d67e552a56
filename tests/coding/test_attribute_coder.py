# SPDX-License-Identifier: Apache-2.0
"""The compiled attribute coder against the slow reference, and its promises."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
from gpcc_reference import CoefficientDecoder, inverse_transform

from ggslam.coding.attribute_syntax import AttributeParameters
from ggslam.coding.native_settings import raht_settings
from ggslam.coding.slice_coder import SliceCoder


def coded(
    points: np.ndarray, values: np.ndarray, parameters: AttributeParameters, bits: int, rdoq: float = 0.0
) -> tuple[SliceCoder, bytes, np.ndarray, np.ndarray]:
    """Coder, payload, values in coding order and their reconstruction."""
    coder = SliceCoder()
    order = coder.build(points, max(1, int(points.max()).bit_length()))
    original = np.ascontiguousarray(values[order].reshape(len(points), -1), np.int32)
    reconstructed = original.copy()
    settings = raht_settings(parameters, original.shape[1], bits, rdoq=rdoq)
    payload = coder.encode_attribute(settings, reconstructed)
    return coder, payload, original, reconstructed


def step(qp: int) -> float:
    return ([161, 181, 203, 228, 256, 287][qp % 6] << (qp // 6)) / 256


@pytest.mark.parametrize("qp", [4, 16, 34])
def test_transform_without_prediction_is_the_textbook_one(gpcc_data: Path, surface: tuple, qp: int) -> None:
    """Another arithmetic decoder and a transform in floating point give the same values, but for rounding."""
    adaptation = json.loads((gpcc_data / "tables.json").read_text())["entropy_lut_256"]
    points, colors = surface[0][:3000], surface[1][:3000]
    parameters = AttributeParameters(qp, 2, prediction=False)
    coder, payload, _, reconstructed = coded(points, colors, parameters, 8)
    coefficients = CoefficientDecoder(payload, adaptation).triplets(len(points))
    steps = np.array([step(qp), step(qp + 2), step(qp + 2)])
    expected = inverse_transform(coder.positions(), coefficients, steps).clip(0, 255)
    assert np.abs(reconstructed - expected).max() < 2.5
    assert np.abs(reconstructed - expected).mean() < 0.35


@pytest.mark.parametrize("prediction", [False, True])
@pytest.mark.parametrize(("bits", "components"), [(8, 3), (8, 1), (10, 3), (12, 1), (16, 3), (16, 1)])
def test_decoder_follows_the_encoder(surface: tuple, bits: int, components: int, prediction: bool) -> None:
    points, colors = surface
    values = (colors[:, :components].astype(np.int64) * ((1 << bits) - 1) // 255).astype(np.int32)
    for qp in (4, 22, 6 * (bits - 8) + 40):
        parameters = AttributeParameters(qp, -1, prediction)
        coder, payload, original, reconstructed = coded(points, values, parameters, bits)
        decoded = coder.decode_attribute(raht_settings(parameters, components, bits), payload)
        assert np.array_equal(decoded, reconstructed)
        # The last term: factors of 15 bits are rounded down, large values shrink a little.
        assert np.sqrt(np.mean((decoded - original) ** 2)) < 0.6 * step(qp) + 0.6 + 2.0 ** (bits - 11)


def test_prediction_saves_bits(surface: tuple) -> None:
    sizes = [len(coded(*surface, AttributeParameters(28, prediction=p), 8)[1]) for p in (False, True)]
    assert sizes[1] < 0.9 * sizes[0]


def test_smallest_step_is_nearly_lossless_only(surface: tuple) -> None:
    """Which is why ids are not sent as they are."""
    rng = np.random.default_rng(0)
    noise = rng.integers(0, 65536, len(surface[0]))
    _, _, original, reconstructed = coded(surface[0], noise, AttributeParameters(4), 16)
    error = np.abs(reconstructed - original)
    assert 0 < error.max() < 64


def test_dropping_coefficients_trades_size_for_error(surface: tuple) -> None:
    points = surface[0]
    values = surface[1].astype(np.int32) + np.random.default_rng(0).integers(0, 12, surface[1].shape)
    parameters = AttributeParameters(34)
    results = []
    for rdoq in (0.0, 1.0):
        coder, payload, original, reconstructed = coded(points, values, parameters, 9, rdoq)
        assert np.array_equal(coder.decode_attribute(raht_settings(parameters, 3, 9), payload), reconstructed)
        results.append((len(payload), np.mean((reconstructed - original) ** 2)))
    assert results[1][0] < 0.98 * results[0][0] and results[1][1] > results[0][1]


def test_heavy_nodes_are_exact_in_the_mean() -> None:
    """Weights beyond 2^16, where the square root takes its second form."""
    x, y = np.meshgrid(np.arange(400), np.arange(256), indexing="ij")
    points = np.stack([x, y, np.zeros_like(x)], -1).reshape(-1, 3).astype(np.int32)
    values = np.where(points[:, :1] < 256, 180, 20)
    _, payload, original, reconstructed = coded(points, values, AttributeParameters(4), 8)
    assert np.abs(reconstructed - original).max() <= 1
    assert len(payload) < 400


def test_the_first_versions_roots_of_heavy_nodes_are_kept() -> None:
    """Streams of that version come back as their encoder saw them, and only with its arithmetic."""
    x, y = np.meshgrid(np.arange(1000), np.arange(900), indexing="ij")
    points = np.stack([x, y, np.zeros_like(x)], -1).reshape(-1, 3).astype(np.int32)
    values = (40000 + 20000 * np.sin(points[:, :1] / 70)).astype(np.int32)
    coder = SliceCoder()
    original = np.ascontiguousarray(values[coder.build(points, 10)])
    old, new = (raht_settings(AttributeParameters(4), 1, 16, first_version=first) for first in (True, False))
    payload = coder.encode_attribute(old, original)  # becomes what a decoder sees
    assert np.array_equal(coder.decode_attribute(old, payload), original)
    assert not np.array_equal(coder.decode_attribute(new, payload), original)
