# SPDX-License-Identifier: Apache-2.0
"""Gaussians as arrays that a browser draws: centres, covariances, colours from all sides, opacities."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ggslam.rendering.types import Gaussians
from ggslam.scene.gaussian_map import SH_C0
from ggslam.scene.poses import quaternion_to_matrix
from ggslam.system.tuning import Tuning


class DrawnSplatTuning(Tuning):
    """Which Gaussians are drawn."""

    max_size_m = 2.0
    """Largest standard deviation, in metres: half-precision covariances end soon after."""
    min_opacity = 1.0 / 255
    """Fainter Gaussians are not drawn."""


@dataclass(frozen=True)
class Splats:
    """Arrays of N splats.

    Attributes:
        centers: float32 [N, 3], metres, world frame.
        covariances: float32 [N, 3, 3], square metres.
        colors: uint8 [N, 3].
        opacities: float32 [N], in (0, 1).
    """

    centers: np.ndarray
    covariances: np.ndarray
    colors: np.ndarray
    opacities: np.ndarray

    def __len__(self) -> int:
        return len(self.centers)

    def rows(self, index: np.ndarray) -> Splats:
        """Some of them: index int [M] or bool [N]."""
        return Splats(self.centers[index], self.covariances[index], self.colors[index], self.opacities[index])


def splats_of(gaussians: Gaussians, index: np.ndarray | None = None) -> Splats:
    """Splats of a map's Gaussians, of those at `index` (int [M]) if it is given, in that order. Only the part of a
    colour that is the same from all sides is used."""
    rows = slice(None) if index is None else index
    scales = np.minimum(np.exp(gaussians.log_scales.numpy()[rows]), DrawnSplatTuning.max_size_m)
    axes = quaternion_to_matrix(gaussians.quaternions.numpy()[rows]).astype(np.float32) * scales[:, None, :]
    rgb = 0.5 + SH_C0 * gaussians.sh.numpy()[rows, 0]
    return Splats(
        gaussians.means.numpy()[rows].copy(), axes @ axes.transpose(0, 2, 1), colors_to_uint8(rgb),
        opacities_of(gaussians)[rows],
    )  # fmt: skip


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
