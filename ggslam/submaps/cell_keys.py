# SPDX-License-Identifier: Apache-2.0
"""Cells of a regular grid: whole coordinates from positions and back, and many points sorted into them at once."""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Final

import numpy as np

from ggslam.errors import ConfigError
from ggslam.submaps.settings import GridAxes

CellKey = tuple[int, int, int]
"""Whole coordinates of a cell along x, y, z; 0 along an axis that the grid does not span."""

LIMIT: Final = 2**31
"""Largest coordinate of a cell: differences and sums stay exact in 64 bits."""


def is_coordinate(value: object) -> bool:
    """Whether this may be a coordinate of a cell; keys out of files may be anything."""
    return type(value) is int and abs(value) <= LIMIT


@dataclass(frozen=True)
class Grid:
    """Cells of edge `spacing` (metres) whose centres are the multiples of it, along some of the world's axes."""

    spacing: float
    axes: GridAxes

    @property
    def spans(self) -> np.ndarray:
        """bool [3]: which world axes the grid spans."""
        return np.array([name in self.axes for name in "xyz"])

    def keys_of(self, points: np.ndarray) -> np.ndarray:
        """The cells of points [N, 3] in metres, int64 [N, 3]. A border belongs to the cell on its positive side.

        Raises:
            ConfigError: a coordinate is not finite or more than 2^31 cells away.
        """
        cells = np.floor(np.asarray(points, np.float64) / self.spacing + 0.5) * self.spans
        if not (np.abs(cells) < LIMIT).all():  # NaN is not
            raise ConfigError(f"positions must be finite and within 2^31 cells of {self.spacing:g} m of the origin")
        return cells.astype(np.int64)

    def key_of(self, position: np.ndarray) -> CellKey:
        """The cell of a position [3] in metres; see `keys_of`."""
        # Asked for at every frame, where arrays of one row cost more than the arithmetic.
        places = [at / self.spacing + 0.5 for at in np.asarray(position, np.float64).reshape(3).tolist()]
        if not all(abs(at) < (LIMIT if n in self.axes else math.inf) for at, n in zip(places, "xyz", strict=True)):
            raise ConfigError(f"positions must be finite and within 2^31 cells of {self.spacing:g} m of the origin")
        x, y, z = (math.floor(at) if name in self.axes else 0 for at, name in zip(places, "xyz", strict=True))
        return x, y, z

    def centres_of(self, keys: np.ndarray) -> np.ndarray:
        """Centres in metres of cells [N, 3], float64 [N, 3]; 0 along axes that the grid does not span."""
        return np.asarray(keys, np.float64).reshape(-1, 3) * self.spacing

    def distances(self, keys: np.ndarray, position: np.ndarray) -> np.ndarray:
        """Metres, float64 [N], along the grid's axes from a position [3] to the centres of cells [N, 3]."""
        return np.linalg.norm((self.centres_of(keys) - position) * self.spans, axis=1)

    def box(self, position: np.ndarray, radius: float) -> tuple[CellKey, CellKey]:
        """Least and greatest coordinates of the cells whose centres can lie within `radius` metres of a position."""
        position = np.asarray(position, np.float64) * self.spans
        reach = radius * self.spans
        low = np.ceil((position - reach) / self.spacing - 1e-9).clip(-LIMIT, LIMIT)
        high = np.floor((position + reach) / self.spacing + 1e-9).clip(-LIMIT, LIMIT)
        (x, y, z), (u, v, w) = low.astype(np.int64).tolist(), high.astype(np.int64).tolist()
        return (x, y, z), (u, v, w)


def sorted_groups(keys: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Sorts whole coordinates [N, 3] so that equal rows lie together.

    Returns:
        order: int64 [N]; equal rows keep their order.
        starts: int64 [G]: where each group of equal rows begins in `order`.
    """
    if not len(keys):
        return np.empty(0, np.int64), np.empty(0, np.int64)
    keys = keys - keys.min(0)
    x, y, z = (int(span) + 1 for span in keys.max(0))
    if x * y * z < 2**63:  # one number per row sorts several times faster than three
        packed = (keys[:, 0] * y + keys[:, 1]) * z + keys[:, 2]
        order = np.argsort(packed, kind="stable")
        packed = packed[order]
        differs = packed[1:] != packed[:-1]
    else:
        order = np.lexsort(keys.T[::-1])
        differs = (keys[order[1:]] != keys[order[:-1]]).any(1)
    return order, np.concatenate([[0], np.nonzero(differs)[0] + 1])


def partition(points: np.ndarray, grid: Grid) -> Iterator[tuple[CellKey, np.ndarray]]:
    """Cuts points [N, 3] into cells by one sort: each cell with a point in it, and the indices of its points in order.

    Raises:
        ConfigError: a point is not finite or too far away.
    """
    keys = grid.keys_of(points)
    order, starts = sorted_groups(keys)
    for indices in np.split(order, starts[1:]) if len(starts) else []:
        x, y, z = keys[indices[0]].tolist()
        yield (x, y, z), indices
