# SPDX-License-Identifier: Apache-2.0
"""Gaussians as arrays that a browser draws: centres, covariances, colours from all sides, opacities."""

from __future__ import annotations

import numpy as np

from ggslam.rendering.types import Gaussians
from ggslam.system.tuning import Tuning


class DrawnSplatTuning(Tuning):
    """Which Gaussians are drawn."""

    max_size_m = 2.0
    """Largest standard deviation, in metres: half-precision covariances end soon after."""
    min_opacity = 1.0 / 255
    """Fainter Gaussians are not drawn."""


def colors_to_uint8(rgb: np.ndarray) -> np.ndarray:
    """Colours in [0, 1] as bytes."""
    return (255 * np.clip(rgb, 0, 1) + 0.5).astype(np.uint8)


def opacities_of(gaussians: Gaussians) -> np.ndarray:
    """float32 [N] in (0, 1)."""
    logits = np.clip(gaussians.opacity_logits.numpy(), -30, 30)
    return (1 / (1 + np.exp(-logits))).astype(np.float32)


def most_visible(gaussians: Gaussians, limit: int, owners: np.ndarray | None = None) -> np.ndarray:
    """Rows, rising, of the `limit` Gaussians that cover most: by opacity times the area of their two widest axes.
    Gaussians that are too faint to be seen are left out in any case.

    Args:
        gaussians: the map.
        limit: no more rows than this.
        owners: object ids int [N]. A quarter of the rows is shared among the objects evenly before the others are
            chosen: the largest Gaussians are those of walls, and small objects would be left out.
    """
    opacities = opacities_of(gaussians)
    seen = np.flatnonzero(opacities >= DrawnSplatTuning.min_opacity)
    if len(seen) <= limit:
        return seen
    widths = np.sort(gaussians.log_scales.numpy()[seen], axis=1)[:, 1:].sum(axis=1)
    weight = np.log(opacities[seen]) + np.minimum(widths, 2 * np.log(DrawnSplatTuning.max_size_m))
    if owners is not None:
        ids = owners[seen]
        share = limit // (4 * len(np.unique(ids)))
        order = np.lexsort((-weight, ids))
        rank = np.arange(len(order)) - np.searchsorted(ids[order], ids[order])
        weight[order[rank < share]] = np.inf
    return np.sort(seen[np.argpartition(-weight, limit)[:limit]])
