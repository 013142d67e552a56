# SPDX-License-Identifier: Apache-2.0
"""Origins: how coordinates keep their precision far from zero, as those of maps in UTM or ECEF are.

Single precision has steps of 0.06 mm at 1 km from zero and of 0.5 m at a UTM northing. So coordinates are double at
every edge (files, poses, queries), and whatever computes in single precision inside (targets, signed distances,
occupancy) does so relative to an origin near by, which it keeps as three doubles. Origins are whole multiples of
100 m: what is moved by such a multiple gives the same bits.
"""

from __future__ import annotations

import numpy as np

from ggslam.system.tuning import Tuning


class OriginTuning(Tuning):
    """Choice of an origin."""

    far_m = 1000.0
    """Largest distance from an origin along an axis, in metres, before another one is chosen."""
    grid_m = 100.0
    """Origins are multiples of this many metres."""
    max_rounding_m = 1e-4
    """Largest rounding error of coordinates, in metres, that are written in single precision."""


def is_far(position: np.ndarray, origin: np.ndarray | None = None) -> bool:
    """Whether a position [3] (metres, world) is more than `OriginTuning.far_m` from an origin [3] along an axis. None
    is the origin at zero."""
    return bool(np.abs(np.asarray(position, np.float64) - (0 if origin is None else origin)).max() > OriginTuning.far_m)


def local_origin(position: np.ndarray) -> np.ndarray:
    """The origin, float64 [3], to compute with around a position [3] (metres, world): zero unless that is far."""
    position = np.asarray(position, np.float64)
    return np.rint(position / OriginTuning.grid_m) * OriginTuning.grid_m + 0.0 if is_far(position) else np.zeros(3)


def moved_pose(T: np.ndarray, offset: np.ndarray) -> np.ndarray:
    """Poses float64 [..., 4, 4] whose world is moved by an offset [3]."""
    moved = np.array(T, np.float64)
    moved[..., :3, 3] += offset
    return moved


def stored_positions(points: np.ndarray) -> np.ndarray:
    """Positions [n, 3] (metres) in the type to be written in: float32 where its steps are below 0.1 mm, which is up to
    1 km from zero, else float64."""
    points = np.asarray(points)
    step = np.spacing(np.float32(np.abs(points).max(initial=0)))
    return points.astype(np.float32 if step <= OriginTuning.max_rounding_m else np.float64)
