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
NOT_READ = {
    ".las": "LAS: convert it, e.g. `pdal translate cloud.las cloud.ply`",
    ".laz": "LAZ: convert it, e.g. `pdal translate cloud.laz cloud.ply`",
    ".e57": "E57: convert it, e.g. `pdal translate cloud.e57 cloud.ply`",
    ".pcap": "packets of a LiDAR, which only its driver can read: write .pcd or .bin files, one a scan",
    ".bag": "a bag of scans: write one .pcd file a scan, e.g. `rosrun pcl_ros bag_to_pcd cloud.bag /points folder`",
    ".mcap": "a bag of scans: write one .pcd or .bin file a scan",
    ".ot": "OctoMap with probabilities: write a .bt file, e.g. `convert_octree map.ot map.bt`",
}
"""Why files of other kinds are not read, and what to do."""


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
    if path.suffix.lower() in NOT_READ:
        raise FormatError(f"{path}: is not read: {NOT_READ[path.suffix.lower()]}")
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
