# SPDX-License-Identifier: Apache-2.0
"""Reading camera poses and calibration matrices from the text files that recordings carry."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from ggslam.errors import SequenceError
from ggslam.scene.poses import is_valid_pose, quaternion_to_matrix
from ggslam.sequences.recording import Calibration, Recording, image_numbers, read_text


def data_lines(path: Path) -> list[tuple[int, str]]:
    """Lines that are neither blank nor a `#` comment, with their numbers counted from 1."""
    lines = ((number, line.strip()) for number, line in enumerate(read_text(path).splitlines(), 1))
    return [(number, line) for number, line in lines if line and not line.startswith("#")]


def _numbers(path: Path, number: int, line: str, counts: tuple[int, ...]) -> np.ndarray:
    words = line.replace(",", " ").split()
    expected = " or ".join(map(str, counts))
    if len(words) not in counts:
        raise SequenceError(f"{path}, line {number}: expected {expected} numbers, found {len(words)} words")
    try:
        return np.array([float(word) for word in words])
    except ValueError:
        raise SequenceError(f"{path}, line {number}: expected {expected} numbers, found '{line[:60]}'") from None


def invalid_pose_reason(T: np.ndarray) -> str | None:
    """What is wrong with a 4x4 matrix as a camera pose; None when nothing is."""
    if not np.isfinite(T).all():
        return "pose holds NaN or infinity"
    if not is_valid_pose(T):
        return "pose is not a rigid transform (its 3x3 part is no rotation)"
    return None


def _stack_valid(poses: list[np.ndarray], places: list[str]) -> tuple[np.ndarray, dict[int, str]]:
    """Stacks poses; bad ones become rows of NaN and are named in the second result."""
    problems = {}
    stack = np.empty((len(poses), 4, 4))
    for i, (T, place) in enumerate(zip(poses, places, strict=True)):
        reason = invalid_pose_reason(T)
        stack[i] = T if reason is None else np.nan
        if reason is not None:
            problems[i] = f"{place}: {reason}"
    return stack, problems


def read_matrix_rows(path: Path) -> tuple[np.ndarray, dict[int, str]]:
    """Poses written one per line as 16 (or 12) numbers, row-major.

    Returns:
        T_world_camera float64 [n, 4, 4], and row -> reason for rows that are no pose (those are NaN).

    Raises:
        SequenceError: a line does not hold 12 or 16 numbers.
    """
    poses, places = [], []
    for number, line in data_lines(path):
        T = np.eye(4)
        values = _numbers(path, number, line, (16, 12))
        T[: len(values) // 4] = values.reshape(-1, 4)
        poses.append(T)
        places.append(f"{path}, line {number}")
    return _stack_valid(poses, places)


def add_row_poses(recording: Recording, path: Path) -> None:
    """Sets a recording's poses from a file with one row a frame (see `read_matrix_rows`), if there is that file. Where
    there are more rows than frames, the number in a colour image's name is its row, counted from 0 (from 1 if the last
    number is the number of rows), so that a frame that is missing shifts no pose; without such numbers, or where they
    go beyond the rows, the first rows are taken.

    Raises:
        SequenceError: a row does not hold 12 or 16 numbers, or there are fewer rows than frames.
    """
    if not path.is_file():
        return
    poses, problems = read_matrix_rows(path)
    count = len(recording.files)
    if len(poses) < count:
        raise SequenceError(f"{path}: expected {count} poses, one a frame, found {len(poses)}")
    rows = np.arange(count)
    numbers = image_numbers(entry.color for entry in recording.files)
    if len(poses) > count and numbers is not None:
        by_name = numbers - (numbers[-1] == len(poses))
        if by_name[0] >= 0 and by_name[-1] < len(poses):
            rows = by_name
    reasons = {frame: problems[row] for frame, row in enumerate(rows.tolist()) if row in problems}
    recording.take_poses(poses[rows], path.name, reasons)


def read_tum_poses(path: Path) -> tuple[np.ndarray, np.ndarray, dict[int, str]]:
    """Poses of a TUM trajectory: lines `t tx ty tz qx qy qz qw`.

    Returns:
        timestamps float64 [n], T_world_camera float64 [n, 4, 4], and row -> reason for rows that are no pose.

    Raises:
        SequenceError: a line does not hold 8 numbers.
    """
    stamps, poses, places = [], [], []
    for number, line in data_lines(path):
        values = _numbers(path, number, line, (8,))
        T = np.full((4, 4), np.nan)
        if np.isfinite(values).all() and np.linalg.norm(values[4:]) > 0.5:
            T = np.eye(4)
            T[:3, :3] = quaternion_to_matrix(values[[7, 4, 5, 6]])
            T[:3, 3] = values[1:4]
        stamps.append(values[0])
        poses.append(T)
        places.append(f"{path}, line {number}")
    stack, problems = _stack_valid(poses, places)
    return np.array(stamps), stack, problems


def read_matrix(path: Path, size: tuple[int, int] = (4, 4)) -> np.ndarray:
    """A matrix of the given size written as text, float64; values need not be finite.

    Raises:
        SequenceError: missing file, or not that many numbers.
    """
    lines = data_lines(path)
    words = " ".join(line for _, line in lines).replace(",", " ").split()
    try:
        values = np.array([float(word) for word in words])
    except ValueError:
        raise SequenceError(f"{path}: expected a {size[0]}x{size[1]} matrix of numbers, found other text") from None
    if values.size != size[0] * size[1]:
        raise SequenceError(f"{path}: expected a {size[0]}x{size[1]} matrix, found {values.size} numbers")
    return values.reshape(size)


def read_intrinsics(path: Path) -> Calibration:
    """(fx, fy, cx, cy) of a calibration matrix file, 3x3 or 4x4.

    Raises:
        SequenceError: missing file, wrong number of values, or focal lengths that are not positive.
    """
    count = sum(len(line.replace(",", " ").split()) for _, line in data_lines(path))
    K = read_matrix(path, (4, 4) if count == 16 else (3, 3))
    fx, fy, cx, cy = float(K[0, 0]), float(K[1, 1]), float(K[0, 2]), float(K[1, 2])
    if not (np.isfinite([fx, fy, cx, cy]).all() and fx > 0 and fy > 0):
        raise SequenceError(f"{path}: expected positive focal lengths, found fx {fx:g}, fy {fy:g}")
    return fx, fy, cx, cy
