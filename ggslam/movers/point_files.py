# SPDX-License-Identifier: Apache-2.0
"""Points of movers as arrays of a file: `ids` int32 [m], `offsets` int64 [m + 1], `points` float32 [n, 3] in each
mover's own frame, `colors` uint8 [n, 3]."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np

from ggslam.errors import FormatError
from ggslam.movers.mover_table import FoundMover

POINTS_FILE = "mover_points.npz"
"""Of runs in which something was found to move."""


def points_to_arrays(movers: Sequence[FoundMover]) -> dict[str, np.ndarray]:
    """For a file."""
    colors = [(255 * np.clip(mover.colors, 0, 1) + 0.5).astype(np.uint8) for mover in movers]
    return {
        "ids": np.array([mover.number for mover in movers], np.int32),
        "offsets": np.cumsum([0, *(len(mover.points) for mover in movers)]).astype(np.int64),
        "points": np.concatenate([np.zeros((0, 3), np.float32), *(mover.points for mover in movers)]),
        "colors": np.concatenate([np.zeros((0, 3), np.uint8), *colors]),
    }


def points_from_arrays(arrays: Mapping[str, np.ndarray]) -> dict[int, tuple[np.ndarray, np.ndarray]]:
    """Points and colours by mover, as `points_to_arrays` gave them.

    Raises:
        FormatError: it is not that.
    """
    names = ("ids", "offsets", "points", "colors")
    ids, offsets, points, colors = (np.asarray(arrays.get(name)) for name in names)
    typed = [a.dtype for a in (ids, offsets, points, colors)] == [np.int32, np.int64, np.float32, np.uint8]
    if not typed or points.ndim != 2 or points.shape[1] != 3 or colors.shape != points.shape:
        raise FormatError("no points of movers")
    fits = ids.ndim == 1 and offsets.shape == (len(ids) + 1,) and (np.diff(offsets) >= 0).all()
    if not fits or offsets[0] != 0 or offsets[-1] != len(points) or not np.isfinite(points).all():
        raise FormatError("points of movers that do not fit together")
    return {
        int(number): (points[a:b], colors[a:b]) for number, a, b in zip(ids, offsets[:-1], offsets[1:], strict=True)
    }
