# SPDX-License-Identifier: Apache-2.0
"""Points of a cell: as bytes (PCD, world coordinates) and back; thinning, and comparison with an earlier recording."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

import numpy as np
from scipy.spatial import cKDTree

from ggslam.errors import FormatError
from ggslam.formats.pcd import parse_pcd, pcd_bytes
from ggslam.scene.origin import stored_positions
from ggslam.submaps.cell_keys import sorted_groups

CellArrays = Mapping[str, np.ndarray]
"""Arrays of one length: "points" [N, 3] in metres, world coordinates, and attributes [N] or [N, k] by name."""

POINTS = "points.pcd"
"""The part of a cell that holds its points."""


def encode_points(arrays: CellArrays) -> bytes:
    """The content of a PCD file, compressed if that makes it smaller.

    Coordinates are written in single precision where its steps are below 0.1 mm (up to 1 km from the origin), else in
    double precision. Attributes keep their types.

    Raises:
        ValueError: an attribute is called x, y or z, or is of a type that PCD files do not have.
    """
    if taken := sorted(set("xyz") & set(arrays)):
        raise ValueError(f"an attribute cannot be called {taken[0]!r}: so are the coordinates")
    points = np.asarray(arrays["points"])
    positions = stored_positions(points)
    columns = {axis: positions[:, number] for number, axis in enumerate("xyz")}
    return pcd_bytes({**columns, **{name: v for name, v in arrays.items() if name != "points"}}, compressed=True)


def decode_points(data: bytes, path: str | Path) -> dict[str, np.ndarray]:
    """The arrays that `encode_points` was given; "points" is float32 or float64 [N, 3]. `path` is for messages.

    Raises:
        FormatError: the data are damaged or have no positions; names the file and the reason.
    """
    rows = parse_pcd(data, path)
    names = rows.dtype.names or ()
    if any(axis not in names for axis in "xyz"):
        raise FormatError(f"{path}: no positions: the fields are {', '.join(names)}")
    arrays = {"points": np.stack([rows[axis] for axis in "xyz"], 1)}
    return arrays | {name: np.ascontiguousarray(rows[name]) for name in names if name not in ("x", "y", "z")}


def select(arrays: CellArrays, rows: np.ndarray) -> dict[str, np.ndarray]:
    """The rows (indices or bool mask) of every array."""
    return {name: values[rows] for name, values in arrays.items()}


def thin(arrays: CellArrays, voxel: float, ratio: float) -> dict[str, np.ndarray]:
    """At most one point per cube of edge `voxel` (metres; 0: all), then the share `ratio` of them, evenly taken.

    A cube's points become their mean, in the order of the cubes; attributes of floating-point type too, others are
    those of its first point. Deterministic.
    """
    if voxel > 0:
        arrays = _voxel_means(arrays, voxel)
    kept = round(len(arrays["points"]) * ratio)
    if kept == len(arrays["points"]):
        return dict(arrays)
    return select(arrays, (np.arange(kept) * (len(arrays["points"]) / max(kept, 1))).astype(np.int64))


def _voxel_means(arrays: CellArrays, voxel: float) -> dict[str, np.ndarray]:
    order, starts = sorted_groups(np.floor(np.asarray(arrays["points"], np.float64) / voxel).astype(np.int64))
    if not len(starts):
        return dict(arrays)
    counts = np.diff(starts, append=len(order))
    result = {}
    for name, values in arrays.items():
        if values.dtype.kind == "f":
            sums = np.add.reduceat(values[order].astype(np.float64), starts, axis=0)
            means = sums / counts.reshape(-1, *[1] * (values.ndim - 1))
            result[name] = means.astype(values.dtype)
        else:
            result[name] = values[order[starts]]
    return result


def changed_share(
    old: np.ndarray, new: np.ndarray, distance: float, centre: np.ndarray | None = None, radius: float = np.inf
) -> float:
    """Share, 0 to 1, of the points [N, 3] of two recordings that have none of the other within `distance` metres.

    Only points within `radius` of `centre` ([3], metres) count, but the other's may lie anywhere: what both sensors
    could see is compared, wherever either recording ends.
    """
    judged = []
    for points, others in ((old, new), (new, old)):
        if centre is not None:
            points = points[np.linalg.norm(points - centre, axis=1) <= radius]
        nearest = (
            cKDTree(others).query(points, distance_upper_bound=distance)[0] if len(others) else points[:, 0] + np.inf
        )
        judged.append(np.isinf(nearest))
    return float(np.concatenate(judged).mean()) if sum(map(len, judged)) else 0.0
