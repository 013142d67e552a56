# SPDX-License-Identifier: Apache-2.0
"""Point clouds as bare float32 numbers (`.bin`), and the pose lists (`graph.txt`) that come with them."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from ggslam.errors import FormatError
from ggslam.formats.text_numbers import parse_numbers
from ggslam.scene.poses import quaternion_to_matrix
from ggslam.system.foreign import MAX_TEXT_BYTES, read_foreign


def read_raw_points(path: str | Path, columns: int = 3) -> np.ndarray:
    """Points float32 [n, columns] of a file of little-endian float32 rows, as LiDAR recordings have them: x y z in
    metres, then whatever else (intensity).

    Raises:
        FormatError: the file is missing, its size is no multiple of a row, or a coordinate is not finite.
    """
    path = Path(path)
    data = read_foreign(path)
    row = 4 * columns
    if len(data) % row:
        raise FormatError(f"{path}: {len(data)} bytes, expected a multiple of {row} ({columns} float32 per point)")
    points = np.frombuffer(data, "<f4").reshape(-1, columns).astype(np.float32)
    if not np.isfinite(points[:, :3]).all():
        row_number = int(np.argmin(np.isfinite(points[:, :3]).all(1)))
        raise FormatError(f"{path}: point {row_number} is {points[row_number, :3].tolist()}, expected finite numbers")
    return points


def read_pose_graph(path: str | Path) -> dict[str, np.ndarray]:
    """Poses T_world_sensor float64 [4, 4] by name, of lines `name x y z qx qy qz qw`, in the file's order.

    Raises:
        FormatError: the file is missing, empty, or a line has something else.
    """
    path = Path(path)
    lines = read_foreign(path, MAX_TEXT_BYTES).splitlines()
    poses = {}
    for number, line in enumerate(lines, 1):
        words = line.split()
        if not words:
            continue
        if len(words) != 8:
            raise FormatError(f"{path}: line {number}: expected a name and 7 numbers, found {len(words)} words")
        x = parse_numbers(words[1:], f"line {number}", path)
        if not np.isfinite(x).all() or abs(np.linalg.norm(x[3:]) - 1) > 0.01:
            raise FormatError(f"{path}: line {number}: {x[3:].tolist()} is no unit quaternion with a finite position")
        T = np.eye(4)
        T[:3, :3], T[:3, 3] = quaternion_to_matrix(x[[6, 3, 4, 5]]), x[:3]
        poses[words[0].decode(errors="replace")] = T
    if not poses:
        raise FormatError(f"{path}: no poses")
    return poses
