# SPDX-License-Identifier: Apache-2.0
"""A map as thinned points, in tiles of which only those are sent that changed.

A tile is named by nothing but its place: that of x is floor(x / `TileTuning.edge_m`) along each axis. A tile that has
become empty is told by one entry in its middle that stands for no Gaussian (`count` 0; of splats with opacity 0).
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

import numpy as np

from ggslam.system.tuning import Tuning

Tile = tuple[int, int, int]
_BITS: Final = 21
_HALF: Final = 1 << (_BITS - 1)


class TileTuning(Tuning):
    """How maps are thinned and cut."""

    point_m = 0.05
    """Edge of the cells that one point stands for, in metres; doubled until there are few enough points."""
    points_in_tile = 40
    """Points along the edge of a tile."""
    edge_m = 2.0
    """Edge of a tile, in metres: `points_in_tile` times `point_m`."""
    min_opacity = 0.5
    """Least opacity of a Gaussian that belongs to a surface."""
    moved_share = 0.02
    """Share of a tile's points that came or went from which the tile is sent again..."""
    color_levels = 6.0
    """...or mean difference of its colours, of 255."""
    max_points = 40_000
    """Most points of a whole map in one message."""


@dataclass(frozen=True)
class ThinPoints:
    """One point for each cell that has something in it, by rising code.

    Attributes:
        codes: int64 [N], of the cells.
        xyz: float32 [N, 3], that of what is in it which lies nearest to the mean, metres: means of a corner lie beside
            both of its walls.
        rgb: uint8 [N, 3].
        count: uint16 [N], how many points that is.
        ids: uint16 [N], object of one of them, 0: none.
        cell_m: edge of a cell.
    """

    codes: np.ndarray
    xyz: np.ndarray
    rgb: np.ndarray
    count: np.ndarray
    ids: np.ndarray
    cell_m: float

    def __len__(self) -> int:
        return len(self.codes)


def thin_points(
    means: np.ndarray, rgb: np.ndarray, ids: np.ndarray, cell_m: float = TileTuning.point_m
) -> ThinPoints:  # fmt: skip
    """Thins points.

    Args:
        means: float32 [N, 3], metres. Those that are not finite, or 50 km away, are left out.
        rgb: uint8 [N, 3].
        ids: uint16 [N].
        cell_m: edge of a cell, metres.
    """
    near = (np.abs(means) < _HALF * cell_m).all(axis=1)
    if not near.all():
        means, rgb, ids = means[near], rgb[near], ids[near]
    codes = _codes(_cells_of(means, cell_m))
    order = np.argsort(codes, kind="stable")
    codes = codes[order]
    first = np.flatnonzero(np.concatenate([[True], codes[1:] != codes[:-1]])) if len(codes) else np.zeros(0, int)
    count = np.diff(np.append(first, len(codes)))
    if not len(first):
        return ThinPoints(codes, np.zeros((0, 3), np.float32), np.zeros((0, 3), np.uint8), count.astype(np.uint16),
                          np.zeros(0, np.uint16), cell_m)  # fmt: skip
    sums = np.add.reduceat(np.concatenate([means, rgb], axis=1, dtype=np.float64)[order], first, axis=0)
    mean = sums / count[:, None]
    chosen = order[_nearest(means[order], mean[:, :3], count)]
    return ThinPoints(codes[first], means[chosen], (mean[:, 3:] + 0.5).astype(np.uint8),
                      np.minimum(count, 65535).astype(np.uint16), ids[chosen], cell_m)  # fmt: skip


def _nearest(points: np.ndarray, middles: np.ndarray, count: np.ndarray) -> np.ndarray:
    """Row of each group's point that lies nearest to its middle, int64 [M].

    Args:
        points: [N, 3], group by group.
        middles: [M, 3].
        count: [M], of the points of each group.
    """
    first = np.cumsum(count) - count
    far = np.square(points - np.repeat(middles, count, axis=0)).sum(axis=1)
    nearest = np.flatnonzero(far == np.repeat(np.minimum.reduceat(far, first), count))
    return nearest[np.searchsorted(nearest, first)]


def at_most(means: np.ndarray, rgb: np.ndarray, ids: np.ndarray, most: int) -> ThinPoints:
    """Thinned to cells so large that there are no more than `most` points; arguments as of `thin_points`."""
    cell = TileTuning.point_m
    thin = thin_points(means, rgb, ids, cell)
    while len(thin) > most:
        cell *= 2
        thin = thin_points(means, rgb, ids, cell)
    return thin


def tile_of(points: np.ndarray) -> np.ndarray:
    """Tiles of points [N, 3], int64 [N, 3]."""
    return _cells_of(np.asarray(points), TileTuning.point_m) // TileTuning.points_in_tile


def middle_of(tile: Tile) -> np.ndarray:
    """Of a tile, float32 [1, 3], metres."""
    return ((np.array([tile]) + 0.5) * TileTuning.edge_m).astype(np.float32)


@dataclass(frozen=True)
class _Sent:
    codes: np.ndarray
    rgb: np.ndarray


class SentTiles:
    """Knows how each tile was when it was sent last."""

    def __init__(self) -> None:
        self._sent: dict[Tile, _Sent] = {}

    def find_changes(self, thin: ThinPoints, exactly: bool = False, whole: bool = True) -> dict[Tile, np.ndarray]:
        """Rows of the tiles that are to be sent, by tile; no rows: it has become empty. They count as sent.

        Args:
            thin: the map, in cells of `TileTuning.point_m`.
            exactly: whether the least difference counts.
            whole: whether tiles that are not there have become empty.
        """
        found = {}
        tiles = rows_by_tile(thin)
        for tile, rows in tiles.items():
            now, before = _Sent(thin.codes[rows], thin.rgb[rows]), self._sent.get(tile)
            if before is None or _differs(before, now, exactly):
                found[tile] = rows
                self._sent[tile] = now
        for tile in self._sent.keys() - tiles.keys() if whole else ():
            found[tile] = np.zeros(0, np.int64)
            del self._sent[tile]
        return found


def rows_by_tile(thin: ThinPoints) -> dict[Tile, np.ndarray]:
    """Rows of points of `TileTuning.point_m` by the tile that their cell lies in."""
    cells = _cells(thin.codes) // TileTuning.points_in_tile
    return rows_by_key(cells)


def rows_by_key(keys: np.ndarray) -> dict[Tile, np.ndarray]:
    """Rows of equal keys, int64 [N, 3], by the key."""
    if not len(keys):
        return {}
    codes = _codes(keys)
    order = np.argsort(codes, kind="stable")
    ends = np.flatnonzero(np.diff(codes[order])) + 1
    groups = np.split(order, ends)
    return {_tile(keys[group[0]]): group for group in groups}


def _tile(key: np.ndarray) -> Tile:
    x, y, z = key.tolist()
    return x, y, z


def _differs(before: _Sent, now: _Sent, exactly: bool) -> bool:
    if exactly:
        return not (np.array_equal(before.codes, now.codes) and np.array_equal(before.rgb, now.rgb))
    _, old, new = np.intersect1d(before.codes, now.codes, assume_unique=True, return_indices=True)
    gone = len(before.codes) + len(now.codes) - 2 * len(old)
    if gone > TileTuning.moved_share * max(len(before.codes), len(now.codes)):
        return True
    if not len(old):
        return False
    difference = np.abs(before.rgb[old].astype(np.int16) - now.rgb[new]).mean()
    return bool(difference > TileTuning.color_levels)


def _cells_of(points: np.ndarray, cell_m: float) -> np.ndarray:
    return np.floor(points / np.float32(cell_m)).astype(np.int64)


def _codes(cells: np.ndarray) -> np.ndarray:
    """One number for each cell, int64 [N] of [N, 3]."""
    shifted = cells + _HALF
    return np.asarray((shifted[:, 0] << (2 * _BITS)) | (shifted[:, 1] << _BITS) | shifted[:, 2])


def _cells(codes: np.ndarray) -> np.ndarray:
    """Cells int64 [N, 3] of their numbers."""
    mask = (1 << _BITS) - 1
    return np.stack([codes >> (2 * _BITS), (codes >> _BITS) & mask, codes & mask], axis=1) - _HALF
