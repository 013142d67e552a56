# SPDX-License-Identifier: Apache-2.0
"""A slow, obvious occupancy update with a dictionary of voxels, to hold the compiled one against."""

from __future__ import annotations

import math
from collections import Counter

import numpy as np

Key = tuple[int, ...]
HIT, MISS = np.float32(math.log(0.7 / 0.3)), np.float32(math.log(0.4 / 0.6))
LOW, HIGH = np.float32(math.log(0.1192 / 0.8808)), np.float32(math.log(0.971 / 0.029))


def key_of(point: np.ndarray, resolution: float) -> Key:
    return tuple(math.floor(float(x) / resolution) + 32768 for x in point)


def center_of(key: Key, resolution: float) -> np.ndarray:
    return (np.array(key) - 32768 + 0.5) * resolution


def voxels_between(origin: np.ndarray, end: np.ndarray, resolution: float) -> set[Key]:
    """Voxels that the segment passes, without the last: found from where it crosses the planes of the grid."""
    crossings = [0.0]
    for axis in range(3):
        low, high = sorted((origin[axis] / resolution, end[axis] / resolution))
        if high > low:
            planes = np.arange(math.floor(low) + 1, math.ceil(high)) * resolution
            crossings += list((planes - origin[axis]) / (end[axis] - origin[axis]))
    crossings = sorted(crossings) + [1.0]
    middles = [(a + b) / 2 for a, b in zip(crossings, crossings[1:], strict=False) if b - a > 1e-12]
    return {key_of(origin + t * (end - origin), resolution) for t in middles} - {key_of(end, resolution)}


class ReferenceMap:
    """`most_hits`: a voxel is hit as many times as points lie in it, but no more often."""

    def __init__(self, resolution: float, quantize: bool, most_hits: int = 1) -> None:
        self.resolution, self.quantize, self.most_hits = resolution, quantize, most_hits
        self.values: dict[Key, np.float32] = {}

    def insert(self, points: np.ndarray, origin: np.ndarray, max_range: float = math.inf) -> None:
        ends = points.astype(np.float64)
        counts = Counter(key_of(point, self.resolution) for point in ends)
        if self.quantize:
            ends = np.array([center_of(key, self.resolution) for key in {key_of(p, self.resolution) for p in ends}])
        free: set[Key] = set()
        occupied: set[Key] = set()
        for end in ends:
            distance = float(np.linalg.norm(end - origin))
            if distance <= max_range:
                occupied.add(key_of(end, self.resolution))
            else:
                end = origin + (end - origin) * max_range / distance
            free |= voxels_between(origin, end, self.resolution)
        for key in free - occupied:
            self._add(key, MISS)
        for key in occupied:
            for _ in range(min(counts[key], self.most_hits)):
                self._add(key, HIT)

    def _add(self, key: Key, update: np.float32) -> None:
        self.values[key] = min(max(self.values.get(key, np.float32(0)) + update, LOW), HIGH)
