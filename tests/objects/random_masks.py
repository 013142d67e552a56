# SPDX-License-Identifier: Apache-2.0
"""Masks and depth images of all shapes, for tests of passes over them."""

from __future__ import annotations

import numpy as np

from ggslam.objects.settings import IDS

SHAPES = [(1, 1), (1, 2), (2, 1), (1, 40), (41, 1), (2, 2), (3, 3), (7, 5), (23, 37), (48, 64), (61, 83)]


def random_mask(rng: np.random.Generator, shape: tuple[int, int], ids: list[int]) -> np.ndarray:
    """Rectangles one over the other, with dots and slivers."""
    height, width = shape
    mask = np.full(shape, rng.choice(ids), np.uint16)
    for _ in range(int(rng.integers(0, 12))):
        y, x = rng.integers(0, height), rng.integers(0, width)
        size = (1, 1) if rng.random() < 0.2 else (1 + rng.integers(0, height), 1 + rng.integers(0, width) // 2)
        mask[y : y + size[0], x : x + size[1]] = rng.choice(ids)
    noise = rng.random(shape) < rng.choice([0, 0.02, 0.3, 1.0], p=[0.4, 0.3, 0.2, 0.1])
    mask[noise] = rng.choice(ids, shape)[noise]
    return mask


def masks(seed: int) -> list[np.ndarray]:
    rng = np.random.default_rng(seed)
    palettes: list[list[int]] = [[0], [0, 1], [0, 65535, 1, 32768], [9, 65535], list(range(300))]
    return [random_mask(rng, shape, palettes[k % len(palettes)]) for k in range(20) for shape in SHAPES]


def random_depth(rng: np.random.Generator, mask: np.ndarray) -> np.ndarray:
    """A plane for each id, over whose borders the mask may have bled, noise, and pixels that were not measured."""
    bled = np.roll(mask, rng.integers(0, 3), 1)
    planes = rng.uniform(0.5, 3, IDS)[bled] if rng.random() < 0.7 else np.ones(mask.shape)
    depth = planes + 0.01 * np.arange(mask.shape[0])[:, None] + rng.choice([0, 0.005, 0.03]) * rng.random(mask.shape)
    depth[rng.random(mask.shape) < rng.choice([0, 0.1, 1.0], p=[0.5, 0.4, 0.1])] = 0
    return depth.astype(np.float32)
