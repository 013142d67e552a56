# SPDX-License-Identifier: Apache-2.0
"""Reads camera poses and calibration matrices from the text files of recordings."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Final

import numpy as np

from ggslam.errors import SequenceError
from ggslam.scene.poses import is_valid_pose, quaternion_to_matrix
from ggslam.sequences.association import PairingTuning, poses_at, span
from ggslam.sequences.camera_files.matrices import intrinsics_of_matrix
from ggslam.sequences.recording import Calibration, Recording, image_numbers, read_text
from ggslam.sequences.stamps import unit_of_stamps
from ggslam.system.clock_units import UNITS
from ggslam.system.tuning import Tuning


def data_lines(path: Path) -> list[tuple[int, str]]:
    """Lines that are neither blank nor a `#` comment, with their numbers counted from 1."""
    lines = ((number, line.strip()) for number, line in enumerate(read_text(path).splitlines(), 1))
    return [(number, line) for number, line in lines if line and not line.startswith("#")]


def invalid_pose_reason(T: np.ndarray) -> str | None:
    """What is wrong with a 4x4 matrix as a camera pose; None when nothing is."""
    if not np.isfinite(T).all():
        return "pose holds NaN or infinity"
    with np.errstate(over="ignore", invalid="ignore"):  # numbers that no pose holds
        valid = is_valid_pose(T)
    if not valid:
        return "pose is not a rigid transform (its 3x3 part is not a rotation)"
    return None


class PoseTuning(Tuning):
    """A limit on damaged files."""

    max_number = 1e6
    """Largest number of a quaternion, which has unit length but for rounding."""


MATRIX: Final = 16
"""Numbers of a line that is a 4x4 matrix; 12 lack its last row."""


@dataclass(frozen=True)
class PoseRows:
    """The poses of a text file, one a line.

    Attributes:
        path: the file.
        poses: float64 [n, 4, 4] T_world_camera, rows of NaN for lines that hold none.
        stamps: float64 [n], the first number of lines of eight or nine, in whatever unit it is; NaN for lines that
            hold none. None: lines have no times.
        ids: of images, float64 [n], the last number of lines of nine; None: lines have no ids.
        problems: row -> file, line and reason, for lines that hold no pose.
    """

    path: Path
    poses: np.ndarray
    stamps: np.ndarray | None
    ids: np.ndarray | None
    problems: dict[int, str]


def read_pose_rows(path: Path, counts: tuple[int, ...] = (7, 8, 9, 12, 16)) -> PoseRows:
    """Poses written one a line: tx ty tz qx qy qz qw (7 numbers), the same after a time (8, TUM) and before an id (9,
    RTAB-Map), or a matrix row by row (12, KITTI; 16). What most lines hold counts; other lines hold no pose.

    Raises:
        SequenceError: the file cannot be read, or no line holds one of `counts` numbers.
    """
    lines = [(number, line, _numbers_in(line)) for number, line in data_lines(path)]
    found = Counter(_kind(values) for _, _, values in lines if values is not None and len(values) in counts)
    wanted = " or ".join(map(str, counts))
    if not found:
        first = f", found '{lines[0][1][:60]}' in line {lines[0][0]}" if lines else ", found no lines"
        raise SequenceError(f"{path}: expected poses as lines of {wanted} numbers{first}")
    count = found.most_common(1)[0][0]
    lines = lines[1:] if _names_columns(lines[0][1], count) else lines
    poses, stamps, ids = np.full((len(lines), 4, 4), np.nan), np.full(len(lines), np.nan), np.full(len(lines), np.nan)
    problems = {}
    for row, (number, line, values) in enumerate(lines):
        if values is None or _kind(values) != count:
            held = f"'{line[:60]}'" if values is None else f"{len(values)} words"
            expected = "16 or 12" if count == MATRIX else count
            problems[row] = f"{path}, line {number}: expected {expected} numbers, found {held}"
            continue
        T = pose_of_numbers(values[:8] if count == 9 else values)
        reason = _no_rotation_reason(values, count) or invalid_pose_reason(T)
        if reason is None:
            poses[row] = T
        else:
            problems[row] = f"{path}, line {number}: {reason}"
        if count in (8, 9):
            stamps[row], ids[row] = values[0], values[-1]
    return PoseRows(path, poses, stamps if count in (8, 9) else None, ids if count == 9 else None, problems)


def _no_rotation_reason(values: np.ndarray, count: int) -> str | None:
    """That the finite numbers of a line hold a quaternion that is far from unit length; None if they do not."""
    if count == MATRIX or not np.isfinite(values).all():
        return None
    quaternion = values[3:7] if count == 7 else values[4:8]
    length = float(np.linalg.norm(quaternion))
    return None if 0.5 < length <= PoseTuning.max_number else f"pose holds a quaternion of length {length:.3g}, not 1"


def _names_columns(line: str, count: int) -> bool:
    """Whether a line holds as many words as others hold numbers, none of them a number."""
    words = line.replace(",", " ").split()
    return len(words) == count and all(_numbers_in(word) is None for word in words)


def _kind(values: np.ndarray) -> int:
    return MATRIX if len(values) in (12, 16) else len(values)


def _numbers_in(line: str) -> np.ndarray | None:
    try:
        return np.array([float(word) for word in line.replace(",", " ").split()])
    except ValueError:
        return None


def pose_of_numbers(values: np.ndarray) -> np.ndarray:
    """T_world_camera [4, 4] of the 7, 8, 12 or 16 numbers of a line; not checked, NaN where it has no rotation."""
    T = np.eye(4)
    if len(values) in (12, 16):
        T[: len(values) // 4] = values.reshape(-1, 4)
        return T
    tx, ty, tz, qx, qy, qz, qw = values[-7:]
    if (
        not np.isfinite(values).all()
        or np.abs(values[-4:]).max() > PoseTuning.max_number
        or np.linalg.norm(values[-4:]) <= 0.5
    ):
        return np.full((4, 4), np.nan)
    T[:3, :3], T[:3, 3] = quaternion_to_matrix(np.array([qw, qx, qy, qz])), (tx, ty, tz)
    return T


def poses_of_frames(
    count: int, pose_of: Callable[[int], np.ndarray | None], place_of: Callable[[int], object]
) -> tuple[np.ndarray, dict[int, str]]:
    """Poses that each frame has a file or an entry of.

    Args:
        count: of the frames.
        pose_of: T_world_camera [4, 4] of a frame, None if it has none; may raise SequenceError.
        place_of: what tells it, for messages.

    Returns:
        float64 [count, 4, 4], rows of NaN where there is none, and frame -> reason where what is there is none.
    """
    poses, problems = np.full((count, 4, 4), np.nan), {}
    for i in range(count):
        try:
            T = pose_of(i)
        except SequenceError as error:
            problems[i] = str(error)
            continue
        reason = None if T is None else invalid_pose_reason(T)
        if reason is not None:
            problems[i] = f"{place_of(i)}: {reason}"
        elif T is not None:
            poses[i] = T
    return poses, problems


def add_row_poses(recording: Recording, path: Path) -> None:
    """Sets a recording's poses from a file with one row a frame (12 or 16 numbers), if there is that file.

    Raises:
        SequenceError: the file cannot be read, or holds no such row.
    """
    if path.is_file():
        take_rows(recording, read_pose_rows(path, (12, 16)))


def take_rows(recording: Recording, rows: PoseRows) -> None:
    """Gives rows to frames in order. Where there are more rows than frames, the number in a colour image's name is its
    row, counted from 0 (from 1 if the last number is the number of rows), so that a frame that is missing shifts no
    pose; without such numbers, or where they go beyond the rows, the first rows are taken. Frames beyond the last row
    have no pose."""
    count, held = len(recording.files), len(rows.poses)
    chosen = np.arange(count)
    numbers = image_numbers(entry.color for entry in recording.files)
    if held > count and numbers is not None:
        by_name = numbers - (numbers[-1] == held)
        if by_name[0] >= 0 and by_name[-1] < held:
            chosen = by_name
    poses = np.full((count, 4, 4), np.nan)
    there = chosen < held
    poses[there] = rows.poses[chosen[there]]
    problems = {frame: rows.problems[row] for frame, row in enumerate(chosen.tolist()) if row in rows.problems}
    if held < count:
        problems[count] = f"{rows.path}: holds {held} poses for {count} frames; they are taken for the first {held}"
    recording.take_poses(poses, rows.path.name, problems)


def take_rows_by_time(recording: Recording, rows: PoseRows) -> None:
    """Gives frames the poses at their times; in what unit the file's times are is told by those of the images.

    Raises:
        SequenceError: no pose is near in time to a frame.
    """
    assert rows.stamps is not None
    images, name = recording.timestamps, rows.path.name
    unit = unit_of_stamps(rows.stamps, images)
    stamps = rows.stamps * UNITS[unit]
    known = np.isfinite(stamps)
    poses = poses_at(images, stamps[known], rows.poses[known])
    if not np.isfinite(poses).any():
        raise SequenceError(
            f"{rows.path}: no pose within {PairingTuning.tolerance_s} s of any image; poses span "
            f"{span(stamps[known])}, images {span(images)}"
        )
    if unit != "s":
        recording.warnings.append(f"{name}: its times are read as {unit}, which agrees with the times of the images")
    recording.take_poses(poses, name, rows.problems)


def take_rows_by_number(recording: Recording, rows: PoseRows, numbers: np.ndarray) -> None:
    """Gives frames the poses of the numbers in their images' names, or where those have none, of their own (from 0).

    Args:
        recording: that gets them.
        rows: the poses.
        numbers: of the rows, float64 [n], NaN where a row has none.

    Raises:
        SequenceError: no row has the number of a frame.
    """
    named = image_numbers(entry.color for entry in recording.files)
    wanted = np.arange(len(recording.files)) if named is None else named
    row_of = {int(number): row for row, number in enumerate(numbers) if np.isfinite(number)}
    chosen = [row_of.get(number) for number in wanted.tolist()]
    unknown = np.full((4, 4), np.nan)
    poses = np.array([unknown if row is None else rows.poses[row] for row in chosen])
    if not np.isfinite(poses).any():
        raise SequenceError(f"{rows.path}: no line has the number of a frame ({wanted[0]} to {wanted[-1]})")
    recording.take_poses(poses, rows.path.name, rows.problems)


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
        SequenceError: missing file, wrong number of values, or no matrix of a camera.
    """
    count = sum(len(line.replace(",", " ").split()) for _, line in data_lines(path))
    K = intrinsics_of_matrix(path, read_matrix(path, (4, 4) if count == 16 else (3, 3)).reshape(-1))
    return K["fx"], K["fy"], K["cx"], K["cy"]
