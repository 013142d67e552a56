# SPDX-License-Identifier: Apache-2.0
"""A large indoor world of boxes between a floor and a ceiling, found through a grid, so that work goes with what is
near and not with the size of the world. `plan` makes one, `scanner` scans it, `walk` walks through
it, `cloud` samples its surfaces.

World axes: x and y along the floor, z up, metres; the floor is z = 0 and reaches from 0 to `size` along x and y.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np

CELL = 1.0
"""Edge of a cell of the grid, metres."""
_SMALLEST = 1e-12
"""Directions have no smaller component: a slab along the ray is then met at a finite or infinite place, never at
"not a number"."""


@dataclass(frozen=True, eq=False)
class World:
    """Boxes, upright but turned about z, and the ways between them.

    Attributes:
        size: edge of the square floor, metres.
        height: of the ceiling, metres.
        seed: that it was made from.
        boxes: float64 [n, 7]: centre x, y, z, half extents along the box's own axes, angle about z in radians.
        nodes: float64 [m, 2], places (x, y) in corridors, rooms and doors.
        ways: int64 [k, 2], pairs of nodes between which the straight way is free.
    """

    size: float
    height: float
    seed: int
    boxes: np.ndarray
    nodes: np.ndarray
    ways: np.ndarray

    @cached_property
    def table(self) -> np.ndarray:
        """Boxes as the tests below want them, float64 [n, 8]: centre, half extents, cosine and sine of the angle."""
        angle = self.boxes[:, 6:]
        return np.ascontiguousarray(np.hstack([self.boxes[:, :6], np.cos(angle), np.sin(angle)]))

    @cached_property
    def grid(self) -> BoxGrid:
        """Which boxes reach into which cell."""
        half = self.table[:, 3:5]
        cosine, sine = np.abs(self.table[:, 6:]).T
        reach = np.stack([cosine * half[:, 0] + sine * half[:, 1], sine * half[:, 0] + cosine * half[:, 1]], 1)
        return BoxGrid(self.boxes[:, :2] - reach, self.boxes[:, :2] + reach, self.size)

    def inside(self, points: np.ndarray) -> np.ndarray:
        """Whether each of the points [n, 3] is in a box, bool [n]. Points outside of the floor are in none."""
        point, box = self.grid.candidates(self.grid.cells(points[:, :2]))
        row, p = self.table[box], points[point]
        x, y = p[:, 0] - row[:, 0], p[:, 1] - row[:, 1]
        within = np.abs(p[:, 2] - row[:, 2]) < row[:, 5]
        within &= np.abs(row[:, 6] * x + row[:, 7] * y) < row[:, 3]
        within &= np.abs(row[:, 6] * y - row[:, 7] * x) < row[:, 4]
        return np.bincount(point, within, len(points)) > 0


class BoxGrid:
    """Boxes by cell, as a compressed list.

    Args:
        low, high: corners (x, y) of the boxes' bounding rectangles, [n, 2].
        size: of the world; a margin of one cell about it holds the outer walls.
    """

    def __init__(self, low: np.ndarray, high: np.ndarray, size: float) -> None:
        self.columns = int(np.ceil(size / CELL)) + 2
        first = np.clip(np.floor(low / CELL).astype(np.int64) + 1, 0, self.columns - 1)
        last = np.clip(np.floor(high / CELL).astype(np.int64) + 1, 0, self.columns - 1)
        wide, deep = (last - first + 1).T
        box, index = spread(wide * deep)
        cell = (first[box, 1] + index // wide[box]) * self.columns + first[box, 0] + index % wide[box]
        self._boxes = box[np.argsort(cell, kind="stable")]
        self._start = np.concatenate([[0], np.cumsum(np.bincount(cell, minlength=self.columns**2))])

    def cells(self, places: np.ndarray) -> np.ndarray:
        """Cell number of each place (x, y) [n, 2], -1 outside of the grid."""
        at = np.floor(places / CELL).astype(np.int64) + 1
        within = ((at >= 0) & (at < self.columns)).all(1)
        return np.where(within, at[:, 1] * self.columns + at[:, 0], -1)

    def candidates(self, cells: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """All pairs of an entry of `cells` [n] (by its index) and a box that reaches into that cell; -1 has none.

        Returns:
            Indices, ascending, and boxes, int64 [pairs].
        """
        start = self._start[np.maximum(cells, 0)]
        count = np.where(cells >= 0, self._start[cells + 1] - start, 0)
        entry, index = spread(count)
        return entry, self._boxes[start[entry] + index]


@dataclass(frozen=True)
class Hits:
    """Where rays end: `distance` float64 [n] in metres, infinite where nothing is within reach, and how many pairs of
    a ray and a box were `tested`."""

    distance: np.ndarray
    tested: int


def cast_rays(world: World, origins: np.ndarray, directions: np.ndarray, reach: float) -> Hits:
    """Follows rays from cell to cell of the grid to the first box, the floor or the ceiling.

    All rays take a step together (J. Amanatides and A. Woo, "A Fast Voxel Traversal Algorithm for Ray Tracing", 1987);
    a ray is done when it has met something in the cells it passed, so that what walls hide is never looked at.

    Args:
        origins: [n, 3], above the floor, below the ceiling and in no box; outside of the world rays meet nothing.
        directions: [n, 3], unit vectors.
        reach: metres; what is farther away is not seen.
    """
    o = np.asarray(origins, float)
    d = np.where(np.abs(directions) < _SMALLEST, _SMALLEST, directions)
    best = (np.where(d[:, 2] > 0, world.height, 0.0) - o[:, 2]) / d[:, 2]
    rays = np.hstack([o, d])
    forward = (d[:, :2] > 0).astype(np.int64)
    at = np.floor(o[:, :2] / CELL).astype(np.int64)
    stride, border = CELL / np.abs(d[:, :2]), ((at + forward) * CELL - o[:, :2]) / d[:, :2]
    alive, tested = np.arange(len(o)), 0
    while len(alive):
        cells = world.grid.cells((at[alive] + 0.5) * CELL)
        entry, box = world.grid.candidates(cells)
        tested += len(box)
        if len(box):
            distance = _box_distance(rays[alive[entry]], world.table[box])
            start = np.nonzero(np.diff(entry, prepend=-1))[0]
            met = alive[entry[start]]
            best[met] = np.minimum(best[met], np.minimum.reduceat(distance, start))
        leave = border[alive].min(1)
        alive = alive[(leave < np.minimum(best[alive], reach)) & (cells >= 0)]
        axis = np.argmin(border[alive], 1)
        at[alive, axis] += 2 * forward[alive, axis] - 1
        border[alive, axis] += stride[alive, axis]
    outside = world.grid.cells(o[:, :2]) < 0
    return Hits(np.where((best > reach) | outside, np.inf, best), tested)


def _box_distance(ray: np.ndarray, box: np.ndarray) -> np.ndarray:
    """Distance [n] at which rays [n, 6] (origin, direction) enter boxes [n, 8], infinite where they do not."""
    cosine, sine = box[:, 6], box[:, 7]
    x, y, z = (ray[:, k] - box[:, k] for k in range(3))
    dx, dy = ray[:, 3], ray[:, 4]
    own = (
        (cosine * x + sine * y, cosine * dx + sine * dy),
        (cosine * y - sine * x, cosine * dy - sine * dx),
        (z, ray[:, 5]),
    )
    enter, leave = np.zeros(len(ray)), np.full(len(ray), np.inf)
    for axis, (position, direction) in enumerate(own):
        inverse = 1 / np.where(np.abs(direction) < _SMALLEST, _SMALLEST, direction)
        middle, half = -position * inverse, box[:, 3 + axis] * np.abs(inverse)
        np.maximum(enter, middle - half, out=enter)
        np.minimum(leave, middle + half, out=leave)
    return np.where((enter < leave) & (enter > 0), enter, np.inf)


def spread(counts: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Owner and place within the owner's share of each of sum(counts) items: (0, 0, 1, ...), (0, 1, 0, ...) for counts
    (2, 1, ...); int64."""
    owner = np.repeat(np.arange(len(counts)), counts)
    return owner, np.arange(len(owner)) - np.repeat(np.cumsum(counts) - counts, counts)
