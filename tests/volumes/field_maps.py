# SPDX-License-Identifier: Apache-2.0
"""Maps of known distance fields."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from ggslam.native.loader import NativeContext
from ggslam.volumes.settings import TsdfSettings
from ggslam.volumes.tsdf import FREE_VALUE, FULL_WEIGHT, SIDE, VOXELS, TsdfMap

Field = Callable[[np.ndarray], np.ndarray]
"""Signed distance [...] of points [..., 3], metres; positive in free space."""


def sphere(radius: float, center: tuple[float, float, float] = (0, 0, 0)) -> Field:
    return lambda p: np.linalg.norm(p - np.array(center), axis=-1) - radius


def torus(large: float, small: float) -> Field:
    """Around the z axis."""
    return lambda p: np.hypot(np.hypot(p[..., 0], p[..., 1]) - large, p[..., 2]) - small


def plane(normal: np.ndarray, offset: float) -> Field:
    """Free where normal . p > offset."""
    unit = np.asarray(normal, float) / np.linalg.norm(normal)
    return lambda p: p @ unit - offset


def box_room(half: tuple[float, float, float]) -> Field:
    """Free inside an axis-aligned box around the origin."""
    return lambda p: (np.array(half) - np.abs(p)).min(-1)


def block_grid(low: int, high: int) -> np.ndarray:
    """Coordinates [n, 3] of the blocks from low to high - 1 along each axis."""
    return np.stack(np.meshgrid(*3 * [np.arange(low, high)], indexing="ij"), -1).reshape(-1, 3).astype(np.int32)


def voxel_centers(blocks: np.ndarray, voxel: float) -> np.ndarray:
    """Metres, [B, 512, 3], in the order of the map's voxels."""
    k, j, i = np.unravel_index(np.arange(VOXELS), (SIDE, SIDE, SIDE))
    return voxel * (SIDE * blocks[:, None] + np.stack([i, j, k], 1)[None] + 0.5)


def field_map(
    field: Field, low: int, high: int, voxel: float = 0.02, free_blocks: bool = True,
    context: NativeContext | None = None,
) -> TsdfMap:  # fmt: skip
    """A map of the blocks from low to high - 1 that holds a field exactly (to its quantisation); blocks that are free
    throughout hold no voxels, or (`free_blocks` false) do. Colours tell the place: red, green, blue rise with x, y, z.
    """
    settings = TsdfSettings(voxel=voxel)
    tsdf, blocks = TsdfMap(settings, context), block_grid(low, high)
    points = voxel_centers(blocks, voxel)
    value = np.rint(np.clip(field(points) / settings.truncation, -1, 1) * FREE_VALUE)
    extent = SIDE * voxel * (high - low)
    color = np.rint(1 + 253 * (points / extent - low / (high - low))).astype(np.uint8)
    free = (value == FREE_VALUE).all(1) & free_blocks
    weight = np.full(value.shape, FULL_WEIGHT)
    tsdf.write(blocks[~free], value=value[~free], weight=weight[~free], color=color[~free])
    tsdf.write_free(blocks[free], np.full(free.sum(), FULL_WEIGHT))
    return tsdf
