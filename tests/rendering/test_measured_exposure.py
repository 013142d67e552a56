# SPDX-License-Identifier: Apache-2.0
"""The exposure of an image against a rendering of the same view."""

from __future__ import annotations

import numpy as np
import pytest

from ggslam.rendering.exposure import change_of, measure_exposure, without_exposure


def views(gains: tuple[float, float, float]) -> tuple[np.ndarray, ...]:
    """What a camera saw, its depth, and the map's colour, alpha and depth."""
    generator = np.random.default_rng(0)
    image = generator.uniform(0.1, 0.8, (3, 60, 80)).astype(np.float32)
    color = np.clip(255 * np.array(gains)[:, None, None] * image + generator.normal(0, 2, image.shape), 0, 255)
    depth = np.full((60, 80), 2.0, np.float32)
    return color.transpose(1, 2, 0).round().astype(np.uint8), depth, image, np.ones_like(depth), depth.copy()


@pytest.mark.parametrize("gains", [(0.4, 0.4, 0.4), (1.2, 1.0, 0.8), (1.0, 1.0, 1.0)])
def test_gains_are_found(gains: tuple[float, float, float]) -> None:
    found = measure_exposure(*views(gains))
    assert found is not None
    np.testing.assert_allclose(found, np.column_stack([gains, np.zeros(3)]), rtol=0.01)
    assert change_of(found) == pytest.approx(float(np.prod(gains)) ** (1 / 3), rel=0.01)


def test_what_is_new_and_what_is_saturated_does_not_count() -> None:
    color, depth, image, alpha, rendered = views((0.5, 0.5, 0.5))
    color[:20] = 255  # a lamp that was lit
    depth[20:35] = 1.0  # somebody who came in
    color[20:35] = 3
    found = measure_exposure(color, depth, image, alpha, rendered)
    assert found is not None and found[:, 0] == pytest.approx(0.5, rel=0.02)
    assert measure_exposure(color, depth, image, np.zeros_like(alpha), rendered) is None


def test_colours_come_back() -> None:
    color = np.random.default_rng(1).integers(0, 256, (30, 40, 3)).astype(np.uint8)
    exposure = np.array([[0.5, 0.0], [0.6, 0.05], [0.7, 0.0]])
    dimmed = np.clip(np.rint(color * exposure[:, 0] + 255 * exposure[:, 1]), 0, 255).astype(np.uint8)
    assert np.abs(without_exposure(dimmed, exposure).astype(int) - color).max() <= 2
