# SPDX-License-Identifier: Apache-2.0
"""Draws the pixels of a keyframe's mask that identity learning uses."""

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
    edge = np.flatnonzero(at_boundary(ids))
    anywhere, at_edges = _odds(flat, settings.balance), _odds(flat[edge], settings.balance)
    if anywhere is None:
        return PixelPool(np.zeros(0, np.int32), np.zeros(0, np.float32))
    share = 0.0 if at_edges is None else settings.boundary
    density = ((1 - share) * anywhere)[flat]
    if at_edges is not None:
        density[edge] += (share * at_edges)[flat[edge]]
    # Every so manyth of the sum, from a random one on.
    sums = density.cumsum()
    places = np.minimum((np.arange(wanted) + rng.random()) * (sums[-1] / wanted), np.nextafter(sums[-1], 0))
    pixels = np.searchsorted(sums, places, side="right").astype(np.int32)
    pixels = rng.permutation(pixels)
    weights = 1 / density[pixels]
    return PixelPool(pixels, (weights / weights.mean()).astype(np.float32))


def _odds(ids: np.ndarray, balance: float) -> np.ndarray | None:
    """Odds of one pixel by its id, summing to 1 over all pixels, float64 [largest id + 1], 0 for id 0; None if no pixel
    is labelled."""
    counts = np.bincount(ids, minlength=1).astype(np.float64)
    counts[0] = 0
    present = counts > 0
    if not present.any():
        return None
    odds = np.zeros(len(counts))
    odds[present] = counts[present] ** -balance
    return odds / (odds @ counts)


def at_boundary(ids: np.ndarray) -> np.ndarray:
    """Pixels with a pixel of another object beside, above or below them, bool [H, W]."""
    edge = np.zeros(ids.shape, bool)
    across, down = ids[:, 1:] != ids[:, :-1], ids[1:] != ids[:-1]
    edge[:, 1:] |= across
    edge[:, :-1] |= across
    edge[1:] |= down
    edge[:-1] |= down
    return edge
