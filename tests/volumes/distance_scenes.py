# SPDX-License-Identifier: Apache-2.0
"""Scenes with known distances, as TSDF maps."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from ggslam.volumes.tsdf import FREE_VALUE, FULL_WEIGHT, SIDE, VOXELS, TsdfMap

Scene = Callable[[np.ndarray], np.ndarray]
"""Signed distances [N] of points [N, 3], metres, positive in free space."""


def sphere(centre: tuple[float, float, float], radius: float) -> Scene:
    """A ball."""
    return lambda p: np.linalg.norm(p - np.array(centre), axis=-1) - radius


def hollow_sphere(centre: tuple[float, float, float], radius: float) -> Scene:
    """The inside of a ball."""
    return lambda p: radius - np.linalg.norm(p - np.array(centre), axis=-1)


def box(low: tuple[float, float, float], high: tuple[float, float, float], turn: np.ndarray | None = None) -> Scene:
    """A solid box, turned by the rotation `turn` [3, 3]."""
    middle, half = (np.array(low) + np.array(high)) / 2, (np.array(high) - np.array(low)) / 2
    rotation = np.eye(3) if turn is None else turn

    def distance(p: np.ndarray) -> np.ndarray:
        q = np.abs((p - middle) @ rotation) - half
        return np.linalg.norm(np.maximum(q, 0), axis=-1) + np.minimum(q.max(axis=-1), 0)

    return distance


def box_room(
    low: tuple[float, float, float], high: tuple[float, float, float], turn: np.ndarray | None = None
) -> Scene:
    """The inside of a box."""
    solid = box(low, high, turn)
    return lambda p: -solid(p)


def plane(point: tuple[float, float, float], normal: tuple[float, float, float]) -> Scene:
    """Free on the side that the normal points to."""
    n = np.array(normal) / np.linalg.norm(normal)
    return lambda p: (p - np.array(point)) @ n


def union(*scenes: Scene) -> Scene:
    """Several obstacles."""
    return lambda p: np.min([scene(p) for scene in scenes], axis=0)


def rotation(axis: tuple[float, float, float], degrees: float) -> np.ndarray:
    """[3, 3] of a rotation about an axis."""
    x, y, z = np.array(axis) / np.linalg.norm(axis)
    k, angle = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]]), np.radians(degrees)
    return np.eye(3) + np.sin(angle) * k + (1 - np.cos(angle)) * k @ k


def block_range(low: tuple[float, float, float], high: tuple[float, float, float], voxel: float) -> np.ndarray:
    """Coordinates int32 [B, 3] of the blocks that cover a box."""
    edge = SIDE * voxel
    ranges = [
        np.arange(np.floor(a / edge + 1e-9), np.ceil(b / edge - 1e-9), dtype=np.int32)
        for a, b in zip(low, high, strict=True)
    ]
    return np.stack(np.meshgrid(*ranges, indexing="ij"), -1).reshape(-1, 3)


def voxel_centres(blocks: np.ndarray, voxel: float) -> np.ndarray:
    """[B, 512, 3], metres, in the order of the voxels."""
    k, j, i = np.unravel_index(np.arange(VOXELS), (SIDE, SIDE, SIDE))
    return (blocks[:, None, :] * SIDE + np.stack([i, j, k], -1)[None] + 0.5) * voxel


def write_scene(tsdf: TsdfMap, scene: Scene, blocks: np.ndarray, behind: float | None = None) -> None:
    """Writes the blocks of a scene as fusion would: free ones without voxels, behind surfaces nothing.

    Args:
        tsdf: the map.
        scene: the distances.
        blocks: coordinates [B, 3] to write.
        behind: how far behind surfaces voxels are seen, metres; None: the truncation.
    """
    settings = tsdf.settings
    distance = scene(voxel_centres(blocks, settings.voxel).reshape(-1, 3)).reshape(len(blocks), VOXELS)
    value = np.clip(np.round(distance / settings.truncation * FREE_VALUE), -FREE_VALUE, FREE_VALUE)
    weight = np.where(distance >= -(settings.truncation if behind is None else behind), FULL_WEIGHT, 0)
    free = (value == FREE_VALUE).all(axis=1)
    tsdf.write(blocks[~free], value=value[~free], weight=weight[~free])
    tsdf.write_free(blocks[free], np.full(free.sum(), FULL_WEIGHT))
