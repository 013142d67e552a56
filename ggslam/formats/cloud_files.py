# SPDX-License-Identifier: Apache-2.0
"""Clouds of every kind that ggslam reads, by suffix: .ply and .pcd, bare numbers (.bin), arrays (.npy)."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from ggslam.errors import FormatError
from ggslam.formats.point_cloud import ColoredCloud, read_point_cloud
from ggslam.formats.positions import placed_rows
from ggslam.formats.raw_points import read_raw_points
from ggslam.scene.arrays import read_array

SUFFIXES = (".ply", ".pcd", ".npy", ".bin")


def read_cloud_file(path: str | Path, columns: int | None = None, tell: bool = True) -> ColoredCloud:
    """Reads a cloud; points without a position are left out and counted.

    Args:
        path: .ply or .pcd; .npy, floating-point numbers [n, 3 or more]; .bin, see `read_raw_points`.
        columns: numbers that a .bin file holds for each point; None: see `read_raw_points`.
        tell: warn if points were left out.

    Raises:
        FormatError: the file is missing or damaged, or has no points.
    """
    path = Path(path)
    if path.suffix.lower() == ".bin":
        stored = read_raw_points(path, columns)
    elif path.suffix.lower() == ".npy":
        stored = read_array(path)
        if stored.ndim != 2 or stored.shape[1] < 3 or stored.dtype.kind != "f":
            found = f"{stored.dtype} {list(stored.shape)}"
            raise FormatError(f"{path}: expected floating-point numbers [n, 3 or more], found {found}")
    else:
        return read_point_cloud(path, tell)
    points = stored[placed_rows(path, stored[:, :3], tell), :3].astype(np.float64)
    return ColoredCloud(points, None, nowhere=len(stored) - len(points))
