# SPDX-License-Identifier: Apache-2.0
"""Point clouds as bare float32 numbers (`.bin`)."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from ggslam.errors import FormatError
from ggslam.system.tuning import Tuning
from ggslam.system.untrusted_files import read_untrusted


class RawPointsTuning(Tuning):
    """How the columns of a file without a header are found."""

    max_columns = 8
    """Most columns."""
    max_numbers = 1 << 20
    """Most numbers that are looked at."""
    min_share = 0.05
    """Smallest share of the variance that shows columns."""
    noise = 20.0
    """The same in multiples of columns over rows, which is what chance gives."""


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
    data = read_untrusted(path)
    if len(data) % 4:
        raise FormatError(f"{path}: {len(data)} bytes, expected a multiple of 4 (float32 numbers)")
    return data


def _told_columns(numbers: np.ndarray) -> int | None:
    """How many numbers a point has, by the share of the magnitudes' variance (of their ranks) that lies between the
    columns of a table of so many: nothing in a table of the wrong width, in which every column holds all kinds of
    numbers. None if no width stands out, as in small files."""
    magnitudes = np.abs(numbers[:RawPointsTuning.max_numbers])
    magnitudes = magnitudes[: len(magnitudes) // RawPointsTuning.max_columns * RawPointsTuning.max_columns]
    if not np.isfinite(magnitudes).any():
        return None
    ranks = np.searchsorted(np.sort(magnitudes), magnitudes) / max(1, len(magnitudes))
    spread = ranks.var()
    best, most = None, 0.0
    for width in range(3, RawPointsTuning.max_columns + 1):
        if len(numbers) % width == 0 and spread > 0:
            rows = ranks[: len(ranks) // width * width].reshape(-1, width)
            share = rows.mean(0).var() / spread
            if share > max(RawPointsTuning.min_share, RawPointsTuning.noise * width / len(rows)) and share > 1.2 * most:
                best, most = width, share
    return best
