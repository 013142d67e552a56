# SPDX-License-Identifier: Apache-2.0
"""Point clouds as bare float32 numbers (`.bin`), and the pose lists (`graph.txt`) that come with them."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from ggslam.errors import FormatError
from ggslam.formats.text_numbers import parse_numbers
from ggslam.scene.poses import quaternion_to_matrix
from ggslam.system.foreign import MAX_TEXT_BYTES, read_foreign

_WIDEST = 8
_LOOKED_AT = 1 << 20
_CLEAR, _NOISE = 0.05, 20.0
"""Share of the variance that says something, and the most of what chance gives, in columns over rows."""


def read_raw_points(path: str | Path, columns: int | None = None) -> np.ndarray:
    """Numbers float32 [n, columns] of a file of little-endian float32 rows, as LiDAR recordings have them: x y z in
    metres, then whatever else (intensity, ring). Rows without a position are there, too: see `cloud_files`.

    Such a file does not say how many numbers a point has, but they do: intensities and rings are other numbers than
    coordinates, and z other than x and y.

    Args:
        path: the file.
        columns: numbers of a point; None: as the numbers tell, or 5 for files called .pcd.bin, as those of nuScenes
            are, 4 (x y z intensity) for others.

    Raises:
        FormatError: the file is missing, its size is no multiple of a row, or its numbers clearly repeat after another
            number of columns than `columns`.
    """
    path = Path(path)
    numbers = np.frombuffer(_whole_numbers(path), "<f4")
    told = _told_columns(numbers)
    if columns is None:
        columns = (5 if path.name.lower().endswith(".pcd.bin") else 4) if told is None else told
    elif told is not None and columns % told:
        raise FormatError(
            f"{path}: expected {columns} numbers for each point, found numbers that repeat after {told}"
        )
    if len(numbers) % columns:
        raise FormatError(
            f"{path}: {4 * len(numbers)} bytes, expected a multiple of {4 * columns} ({columns} float32 per point)"
        )
    return numbers.reshape(-1, columns).astype(np.float32)


def _whole_numbers(path: Path) -> bytes:
    data = read_foreign(path)
    if len(data) % 4:
        raise FormatError(f"{path}: {len(data)} bytes, expected a multiple of 4 (float32 numbers)")
    return data


def _told_columns(numbers: np.ndarray) -> int | None:
    """How many numbers a point has, by the share of the magnitudes' variance (of their ranks) that lies between the
    columns of a table of so many: nothing in a table of the wrong width, in which every column holds all kinds of
    numbers. None if no width stands out, as in small files."""
    magnitudes = np.abs(numbers[:_LOOKED_AT])
    magnitudes = magnitudes[: len(magnitudes) // _WIDEST * _WIDEST]
    if not np.isfinite(magnitudes).any():
        return None
    ranks = np.searchsorted(np.sort(magnitudes), magnitudes) / max(1, len(magnitudes))
    spread = ranks.var()
    best, most = None, 0.0
    for width in range(3, _WIDEST + 1):
        if len(numbers) % width == 0 and spread > 0:
            rows = ranks[: len(ranks) // width * width].reshape(-1, width)
            share = rows.mean(0).var() / spread
            if share > max(_CLEAR, _NOISE * width / len(rows)) and share > 1.2 * most:
                best, most = width, share
    return best


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
