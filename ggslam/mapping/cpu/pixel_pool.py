# SPDX-License-Identifier: Apache-2.0
"""Which pixels of a keyframe's mask identity learning looks at."""

from __future__ import annotations

import numpy as np

from ggslam.mapping.identity_settings import IdentitySettings
from ggslam.mapping.pixel_pool import PixelPool


def draw_pool(
    ids: np.ndarray, wanted: int, settings: IdentitySettings, rng: np.random.Generator
) -> PixelPool[np.ndarray]:
    """Draws labelled pixels: a share `settings.boundary` of them at the boundaries of objects, where nearly all errors
    are, the others anywhere; in both parts an object of n pixels comes with a share that goes with n^(1 - balance).

    Args:
        ids: object of each pixel, uint16 [H, W]; 0 is never drawn.
        wanted: how many; a pixel may come twice.
    """
    flat = ids.reshape(-1)
    edge = at_boundary(ids).reshape(-1)
    parts, density = [], np.zeros(len(flat))
    for share, strata in ((1 - settings.boundary, flat), (settings.boundary, np.where(edge, flat, 0))):
        counts = np.bincount(strata)
        counts[0] = 0
        present = np.flatnonzero(counts)
        number = round(share * wanted)
        if not len(present) or not number:
            continue
        odds = counts[present].astype(np.float64) ** (1 - settings.balance)
        odds /= odds.sum()
        by_object = np.argsort(strata, kind="stable").astype(np.int32)  # a radix sort for 16 bits
        starts = np.concatenate([[0], np.cumsum(np.bincount(strata))])[present]
        drawn = rng.choice(len(present), number, p=odds)
        parts.append(by_object[starts[drawn] + (rng.random(number) * counts[present][drawn]).astype(np.int64)])
        per_pixel = np.zeros(len(counts))
        per_pixel[present] = number * odds / counts[present]
        density += per_pixel[strata]
    if not parts:
        return PixelPool(np.zeros(0, np.int32), np.zeros(0, np.float32))
    pixels = rng.permutation(np.concatenate(parts))
    weights = 1 / density[pixels]
    return PixelPool(pixels, (weights / weights.mean()).astype(np.float32))


def at_boundary(ids: np.ndarray) -> np.ndarray:
    """Pixels with a pixel of another object beside, above or below them, bool [H, W]."""
    edge = np.zeros(ids.shape, bool)
    across, down = ids[:, 1:] != ids[:, :-1], ids[1:] != ids[:-1]
    edge[:, 1:] |= across
    edge[:, :-1] |= across
    edge[1:] |= down
    edge[:-1] |= down
    return edge
