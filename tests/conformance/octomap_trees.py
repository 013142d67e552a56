# SPDX-License-Identifier: Apache-2.0
"""OctoMap's files as a program reads them that knows the formats from their description alone."""

from __future__ import annotations

import math
import struct
from dataclasses import dataclass
from pathlib import Path

import numpy as np

DEPTH = 16
"""Levels of a tree below its root, which spans 2^16 voxels along each axis around the origin."""


@dataclass(frozen=True)
class Tree:
    """The leaves of a tree: `levels` [N] above the finest, `corners` [N, 3] in voxels from the lowest corner of all,
    multiples of 2^level, and `values` [N], log-odds of occupancy."""

    resolution: float
    levels: np.ndarray
    corners: np.ndarray
    values: np.ndarray

    def values_at(self, points: np.ndarray) -> np.ndarray:
        """Log-odds [N] where some points are, metres; NaN: unknown."""
        voxels = np.floor(np.asarray(points) / self.resolution).astype(np.int64) + 2 ** (DEPTH - 1)
        out = np.full(len(voxels), math.nan)
        for level in np.unique(self.levels):
            own = self.levels == level
            at = {tuple(corner): value for corner, value in zip(self.corners[own], self.values[own], strict=True)}
            found = [at.get(tuple(voxel), math.nan) for voxel in voxels >> level << level]
            out = np.where(np.isnan(found), out, found)
        return out

    def centers(self) -> np.ndarray:
        """Of the leaves, metres."""
        middles = self.corners + 2.0 ** (self.levels[:, None] - 1) - 2 ** (DEPTH - 1)
        return middles * self.resolution

    def sizes(self) -> np.ndarray:
        """Edges of the leaves, metres."""
        return 2.0**self.levels * self.resolution

    def sorted(self) -> Tree:
        order = np.lexsort([*self.corners.T, self.levels])
        return Tree(self.resolution, self.levels[order], self.corners[order], self.values[order])


def read_tree(path: Path) -> Tree:
    """A `.bt` (leaves are free, -1, or occupied, +1) or `.ot` file."""
    head, data = path.read_bytes().split(b"\ndata\n", 1)
    first, *lines = head.decode("ascii").splitlines()
    fields = dict(line.split() for line in lines if not line.startswith("#"))
    assert fields["id"] == "OcTree"
    binary = {"# Octomap OcTree binary file": True, "# Octomap OcTree file": False}[first]
    rows, size, nodes = _binary_leaves(data) if binary else _full_leaves(data)
    assert size == len(data) and nodes == int(fields["size"])
    levels, corners, values = (np.array(column) for column in zip(*rows, strict=True))
    return Tree(float(fields["res"]), levels, corners, values)


def _child(corner: tuple[int, ...], level: int, number: int) -> tuple[int, ...]:
    """The lowest corner of one of eight children, whose own level is given."""
    return tuple(at + (number >> axis & 1) * 2**level for axis, at in enumerate(corner))


Leaves = list[tuple[int, tuple[int, ...], float]]


def _binary_leaves(data: bytes) -> tuple[Leaves, int, int]:
    """Two bits a child: 1 free, 2 occupied, 3 a node whose own two bytes follow in turn. Gives the leaves, the bytes
    read and the number of nodes."""
    leaves: Leaves = []
    waiting, place, nodes = [(DEPTH, (0, 0, 0))], 0, 1
    while waiting:
        level, corner = waiting.pop()
        (word,) = struct.unpack_from("<H", data, place)
        place += 2
        inner = []
        for number in range(8):
            kind = word >> 2 * number & 3
            nodes += kind > 0
            below = (level - 1, _child(corner, level - 1, number))
            if kind == 3:
                inner.append(below)
            elif kind:
                leaves.append((*below, 1.0 if kind == 2 else -1.0))
        waiting += reversed(inner)
    return leaves, place, nodes


def _full_leaves(data: bytes) -> tuple[Leaves, int, int]:
    """A node is its value, a byte with a bit for each child that there is, and those children."""
    leaves: Leaves = []
    waiting, place, nodes = [(DEPTH, (0, 0, 0))], 0, 0
    while waiting:
        level, corner = waiting.pop()
        value, children = struct.unpack_from("<fB", data, place)
        place, nodes = place + 5, nodes + 1
        if not children:
            leaves.append((level, corner, value))
        waiting += [(level - 1, _child(corner, level - 1, n)) for n in reversed(range(8)) if children >> n & 1]
    return leaves, place, nodes
