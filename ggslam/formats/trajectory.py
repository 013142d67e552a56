# SPDX-License-Identifier: Apache-2.0
"""Trajectory files: TUM (`timestamp tx ty tz qx qy qz qw`), and rows of matrices (KITTI 3x4, Replica 4x4).

Poses are camera to world. The quaternion order xyzw exists only in TUM files; in memory it is wxyz.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from ggslam.errors import FormatError, InputError
from ggslam.scene.poses import is_valid_pose, matrix_to_quaternion, orthonormalize, quaternion_to_matrix
from ggslam.system.atomic import write_text
from ggslam.system.foreign import read_foreign_text

TUM_HEADER = "# timestamp tx ty tz qx qy qz qw (camera to world, metres)\n"


@dataclass(frozen=True)
class Trajectory:
    """Poses over time.

    Attributes:
        timestamps: float64 [N], seconds, in the order of the file (row numbers where the file has no times).
        T_world_camera: float64 [N, 4, 4].
    """

    timestamps: np.ndarray
    T_world_camera: np.ndarray

    def __len__(self) -> int:
        return len(self.timestamps)


def write_tum(path: str | Path, timestamps: Sequence[float] | np.ndarray, T_world_camera: np.ndarray) -> int:
    """Writes a TUM trajectory, atomically. Rows whose pose is not finite (the camera was lost) are left out.

    Args:
        path: the file to write.
        timestamps: [N] seconds.
        T_world_camera: [N, 4, 4].

    Returns:
        The number of poses written.

    Raises:
        InputError: poses of another shape, or of another number than the times.
        RunFolderError: the file cannot be written.
    """
    poses = np.asarray(T_world_camera, float)
    if poses.shape != (len(timestamps), 4, 4):
        raise InputError(f"{path}: {len(timestamps)} times need poses [N, 4, 4], found shape {list(poses.shape)}")
    lines = [TUM_HEADER]
    for time, T in zip(timestamps, poses, strict=True):
        if not np.isfinite(T).all():
            continue
        w, x, y, z = matrix_to_quaternion(T[:3, :3])
        numbers = (*T[:3, 3], x, y, z, w)
        lines.append(f"{time:.9f} " + " ".join(f"{number:.9f}" for number in numbers) + "\n")
    write_text(path, "".join(lines))
    return len(lines) - 1


def read_tum(path: str | Path) -> Trajectory:
    """Reads a TUM trajectory. Lines that begin with '#' and empty lines are passed over.

    Raises:
        FormatError: missing file, no poses, another number of columns, a value that is not a finite number, or a
            quaternion that is no rotation; names file and line.
    """
    times, poses = [], []
    for where, numbers in _rows(Path(path), (8,)):
        _check_finite(where, numbers)
        times.append(numbers[0])
        poses.append(_pose_of_tum_row(where, numbers))
    if not poses:
        raise FormatError(f"{path}: no poses in it")
    return Trajectory(np.array(times), np.stack(poses))


def read_matrices(path: str | Path, allow_missing: bool = False) -> Trajectory:
    """Reads one matrix per line, row by row: 12 numbers (KITTI) or 16 (Replica). Timestamps are the row numbers.

    Args:
        path: the file.
        allow_missing: takes a row with values that are not finite (how several recordings mark a lost camera) as a
            missing pose, NaN in the result, instead of refusing it.

    Raises:
        FormatError: missing file, no poses, another number of columns, values that are not finite, or a matrix that is
            no rigid transform; names file and line.
    """
    poses: list[np.ndarray] = []
    for where, numbers in _rows(Path(path), (12, 16)):
        if allow_missing and not np.isfinite(numbers).all():
            poses.append(np.full((4, 4), np.nan))
            continue
        _check_finite(where, numbers)
        T = np.vstack([numbers[:12].reshape(3, 4), [0.0, 0.0, 0.0, 1.0]])
        last_row = numbers[12:] if len(numbers) == 16 else T[3]
        if not is_valid_pose(T) or not np.allclose(last_row, T[3], atol=1e-6):
            raise FormatError(f"{where}: not a rigid transform (rotation not orthonormal or last row not 0 0 0 1)")
        poses.append(orthonormalize(T))
    if not poses:
        raise FormatError(f"{path}: no poses in it")
    return Trajectory(np.arange(len(poses), dtype=float), np.stack(poses))


def read_trajectory(path: str | Path) -> Trajectory:
    """Reads a trajectory of any of the kinds above, told apart by the number of columns.

    Raises:
        FormatError: as `read_tum` and `read_matrices`.
    """
    for _, numbers in _rows(Path(path), (8, 12, 16)):
        return read_tum(path) if len(numbers) == 8 else read_matrices(path)
    raise FormatError(f"{path}: no poses in it")


def _rows(path: Path, columns: tuple[int, ...]) -> Iterator[tuple[str, np.ndarray]]:
    """("file, line n", numbers) of each line with content; the number of columns must be one of `columns`."""
    for number, line in enumerate(read_foreign_text(path).splitlines(), start=1):
        words = line.split("#", 1)[0].split()
        if not words:
            continue
        where = f"{path}, line {number}"
        if len(words) not in columns:
            expected = " or ".join(map(str, columns))
            raise FormatError(f"{where}: expected {expected} columns, found {len(words)}")
        try:
            yield where, np.array([float(word) for word in words])
        except ValueError as error:
            raise FormatError(f"{where}: {error}") from None


def _check_finite(where: str, numbers: np.ndarray) -> None:
    if not np.isfinite(numbers).all():
        column = int(np.argmin(np.isfinite(numbers))) + 1
        raise FormatError(f"{where}: column {column} is {numbers[column - 1]}, expected a finite number")


def _pose_of_tum_row(where: str, numbers: np.ndarray) -> np.ndarray:
    x, y, z, w = numbers[4:]
    norm = float(np.linalg.norm(numbers[4:]))
    if not 0.9 < norm < 1.1:
        raise FormatError(f"{where}: the quaternion {x:g} {y:g} {z:g} {w:g} has length {norm:.3g}, expected 1")
    T = np.eye(4)
    T[:3, :3] = quaternion_to_matrix(np.array([w, x, y, z]))
    T[:3, 3] = numbers[1:4]
    return T
