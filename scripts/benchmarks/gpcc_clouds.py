# SPDX-License-Identifier: Apache-2.0
"""Clouds of about a million points for the benchmarks of the codec: recordings with true poses, and drawn people."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from ggslam.coding.settings import LEVEL_LIMIT
from ggslam.sequences import open_sequence
from ggslam.sequences.sequence import Sequence
from ggslam.synthetic.raycast import RayCaster
from ggslam.synthetic.scene import Kind, Light, Scene, Shape
from ggslam.synthetic.walker import WalkerTuning, person_in_stride

BITS = 10
_FRAMES_AT_ONCE = 16


@dataclass(frozen=True)
class Cloud:
    """A voxelised recording: grid int32 [N, 3], colours uint8 [N, 3]."""

    name: str
    grid: np.ndarray
    colors: np.ndarray


def voxelise(path: Path, every: int) -> Cloud:
    """Back-projects every n-th frame and averages the colours in each voxel."""
    sequence = open_sequence(path, stride=every)
    extents = []
    for index in range(len(sequence)):
        points, _ = world_points(sequence, index)
        if len(points):
            extents.append((points.min(0), points.max(0)))
    low, high = np.min([e[0] for e in extents], 0), np.max([e[1] for e in extents], 0)
    scale = ((1 << BITS) - 1) / (high - low).max()
    keys, sums = [np.empty(0, np.int64)], [np.empty((0, 4), np.int64)]
    for index in range(len(sequence)):
        points, colors = world_points(sequence, index)
        grid = np.floor((points - low) * scale).astype(np.int64)
        keys.append(grid[:, 0] << 2 * BITS | grid[:, 1] << BITS | grid[:, 2])
        sums.append(np.insert(colors.astype(np.int64), 3, 1, 1))
        if len(keys) > _FRAMES_AT_ONCE or index == len(sequence) - 1:
            key, total = add_up(np.concatenate(keys), np.concatenate(sums))
            keys, sums = [key], [total]
    return _largest(path.name, keys[0], sums[0])


def person(seed: int, bits: int = BITS) -> Cloud:
    """A drawn person in mid-stride, textured and lit, 1.8 m over so many bits, at most 10: a stand-in for the people of
    MPEG's tests."""
    rng = np.random.default_rng([seed, 10])
    shapes = person_in_stride(rng, rng.uniform(-0.5, 0.5))
    lamp = np.array([[x, y, 0.0] for x in (-0.2, 0.2) for y in (-0.2, 0.2)])
    lights = [Light(lamp + at, (1.6, 1.6, 1.5)) for at in ((2.0, 1.2, 2.4), (-2.0, 1.5, 2.0), (0.5, -2.4, 1.6))]
    caster = RayCaster(Scene([replace(shape, casts_shadow=True) for shape in shapes], lights), seed)
    most = (1 << bits) - 1
    points, colors = [], []
    for number in range(len(shapes)):
        own, lit = caster.surface(number, WalkerTuning.height_m / most / 2)
        seen = ~np.any([_is_inside(shape, own) for shape in shapes[:number] + shapes[number + 1 :]], 0)
        points.append(own[seen])
        colors.append(np.insert(lit[seen].astype(np.int64), 3, 1, 1))
    together = np.concatenate(points)
    grid = np.floor((together - together.min(0)) * (most / np.ptp(together, axis=0).max())).astype(np.int64)
    key, sums = add_up(grid[:, 0] << 2 * BITS | grid[:, 1] << BITS | grid[:, 2], np.concatenate(colors))
    return _largest(f"person {seed}", key, sums)


def _is_inside(shape: Shape, points: np.ndarray) -> np.ndarray:
    """Which points [N, 3] a solid holds."""
    q = (points - shape.T_world_shape[:3, 3]) @ shape.T_world_shape[:3, :3] / np.array(shape.half)
    if shape.kind is Kind.BOX:
        return (np.abs(q) < 1).all(1)
    if shape.kind is Kind.ELLIPSOID:
        return (q**2).sum(1) < 1
    width = 1 + (shape.top - 1) * (1 + q[:, 2]) / 2
    return (np.hypot(q[:, 0], q[:, 1]) < width) & (np.abs(q[:, 2]) < 1)


def _largest(name: str, keys: np.ndarray, sums: np.ndarray) -> Cloud:
    """The cloud of the voxels with the most measurements, as many as a slice may have."""
    counts = np.sort(sums[:, 3])
    if len(counts) > LEVEL_LIMIT:
        enough = sums[:, 3] > counts[-LEVEL_LIMIT - 1]
        keys, sums = keys[enough], sums[enough]
    limit = (1 << BITS) - 1
    grid = np.stack([keys >> 2 * BITS, keys >> BITS & limit, keys & limit], 1).astype(np.int32)
    return Cloud(name, grid, np.rint(sums[:, :3] / sums[:, 3:]).astype(np.uint8))


def world_points(sequence: Sequence, index: int) -> tuple[np.ndarray, np.ndarray]:
    """Points [N, 3] in world coordinates and colours [N, 3] of a frame; none if its pose is not known."""
    frame = sequence.frame(index, masks=False)
    if frame.T_world_camera is None:
        return np.empty((0, 3)), np.empty((0, 3), np.uint8)
    seen = frame.depth > 0
    points = frame.camera.back_project(frame.depth)[seen]
    return points @ frame.T_world_camera[:3, :3].T + frame.T_world_camera[:3, 3], frame.color[seen]


def add_up(keys: np.ndarray, sums: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """One row for all rows of equal key, their sum."""
    order = np.argsort(keys, kind="stable")
    keys, sums = keys[order], sums[order]
    starts = np.flatnonzero(np.append(True, keys[1:] != keys[:-1]))
    return keys[starts], np.add.reduceat(sums, starts)
