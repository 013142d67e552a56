# SPDX-License-Identifier: Apache-2.0
"""Trajectory files, of four kinds:

    TUM         timestamp tx ty tz qx qy qz qw
    matrices    a row each, KITTI's 3x4 or Replica's 4x4
    EuRoC       timestamp[ns],px,py,pz,qw,qx,qy,qz, with or without what follows; or as its header orders them
    g2o         pose graphs, VERTEX_SE3:QUAT number x y z qx qy qz qw

Poses are camera to world. The quaternion order xyzw exists only in TUM and g2o files; in memory it is wxyz. Times since
1970 in milli-, micro- or nanoseconds are told by their digits.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from ggslam.errors import FormatError, InputError
from ggslam.formats.writer import Takes, Writer
from ggslam.scene.poses import is_valid_pose, matrix_to_quaternion, orthonormalize, quaternion_to_matrix
from ggslam.system.atomic import write_text
from ggslam.system.clock_units import EPOCH_DIGITS, UNITS
from ggslam.system.plurals import quantity
from ggslam.system.untrusted_files import read_untrusted_text

_G2O_TAGS = ("VERTEX_", "EDGE_", "PARAMS_", "FIX")
_VERTEX = "VERTEX_SE3:QUAT"

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
        poses.append(_pose(where, numbers[1:4], numbers[4:]))
    if not poses:
        raise FormatError(f"{path}: no poses in it")
    return Trajectory(_seconds(np.array(times)), np.stack(poses))


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
    """Reads a trajectory of any of the kinds above, told apart by the first line with content.

    Raises:
        FormatError: as `read_tum` and `read_matrices`.
    """
    path = Path(path)
    for line in read_untrusted_text(path).splitlines():
        content = line.split("#", 1)[0].strip()
        if not content:
            continue
        if content.split()[0].startswith(_G2O_TAGS):
            return read_g2o(path)
        if "," in content:
            return read_euroc(path)
        return read_tum(path) if len(content.split()) == 8 else read_matrices(path)
    raise FormatError(f"{path}: no poses in it")


def read_euroc(path: str | Path) -> Trajectory:
    """Reads a table of EuRoC's: nanoseconds, position, quaternion wxyz, and perhaps velocity and biases. The poses are
    of the body (the IMU), in the order of the file.

    Raises:
        FormatError: as `read_tum`.
    """
    times, poses = [], []
    order = _quaternion_order(Path(path))
    for where, numbers in _rows(Path(path), None, ","):
        if len(numbers) < 8:
            raise FormatError(f"{where}: expected 8 columns or more, found {len(numbers)}")
        _check_finite(where, numbers[:8])
        times.append(numbers[0])
        poses.append(_pose(where, numbers[1:4], numbers[order]))
    if not poses:
        raise FormatError(f"{path}: no poses in it")
    return Trajectory(_seconds(np.array(times)), np.stack(poses))


def _quaternion_order(path: Path) -> list[int]:
    """The columns of x, y, z and w as the table's header names them (q_RS_w [], qw); without a header w comes first."""
    names = _head(path).split(",")
    of = {n[-1]: column for column, name in enumerate(names) if (n := name.split("[")[0].strip().lower())[:1] == "q"}
    told = set(of) == set("xyzw") and set(of.values()) == {4, 5, 6, 7}
    return [of[axis] for axis in "xyzw"] if told else [5, 6, 7, 4]


def _head(path: Path) -> str:
    """The first line of a table if it has names, else nothing."""
    first = read_untrusted_text(path).lstrip().split("\n", 1)[0].lstrip("# ")
    return "" if first[:1].isdigit() else first


def read_g2o(path: str | Path) -> Trajectory:
    """Reads the poses of a pose graph, by their numbers, which take the place of times; edges are passed over.

    Raises:
        FormatError: as `read_tum`, or two poses of one number.
    """
    found: dict[int, np.ndarray] = {}
    for number, line in enumerate(read_untrusted_text(path).splitlines(), start=1):
        words = line.split("#", 1)[0].split()
        if not words or words[0] != _VERTEX:
            continue
        where = f"{path}, line {number}"
        if len(words) != 9:
            raise FormatError(f"{where}: expected {_VERTEX} with 8 numbers, found {len(words) - 1}")
        numbers = _numbers(where, words[1:])
        _check_finite(where, numbers)
        if not numbers[0].is_integer() or int(numbers[0]) in found:
            raise FormatError(f"{where}: {words[1]} is no number of a pose, or there are two of it")
        found[int(numbers[0])] = _pose(where, numbers[1:4], numbers[4:])
    if not found:
        raise FormatError(f"{path}: no poses in it (lines {_VERTEX})")
    order = sorted(found)
    return Trajectory(np.array(order, float), np.stack([found[number] for number in order]))


def _rows(
    path: Path, columns: tuple[int, ...] | None, between: str | None = None
) -> Iterator[tuple[str, np.ndarray]]:
    """("file, line n", numbers) of each line with content; the number of columns must be one of `columns` (None: any);
    `between`: what stands between them, None: space. The names above a table are passed over."""
    for number, line in enumerate(read_untrusted_text(path).splitlines(), start=1):
        words = line.split("#", 1)[0].split(between)
        if not "".join(words).strip() or (number == 1 and between == "," and words[0].strip()[:1].isalpha()):
            continue
        where = f"{path}, line {number}"
        if columns is not None and len(words) not in columns:
            expected = " or ".join(map(str, columns))
            raise FormatError(f"{where}: expected {expected} columns, found {len(words)}")
        yield where, _numbers(where, words)


def _numbers(where: str, words: list[str]) -> np.ndarray:
    try:
        return np.array([float(word) for word in words])
    except ValueError as error:
        raise FormatError(f"{where}: {error}") from None


def _seconds(times: np.ndarray) -> np.ndarray:
    """Times of a file in seconds."""
    digits = {len(f"{abs(time):.0f}") for time in times.tolist()}
    return times * UNITS[EPOCH_DIGITS.get(digits.pop(), "s") if len(digits) == 1 else "s"]


def _check_finite(where: str, numbers: np.ndarray) -> None:
    if not np.isfinite(numbers).all():
        column = int(np.argmin(np.isfinite(numbers))) + 1
        raise FormatError(f"{where}: column {column} is {numbers[column - 1]}, expected a finite number")


def _pose(where: str, position: np.ndarray, quaternion: np.ndarray) -> np.ndarray:
    """T [4, 4] of a position and a quaternion xyzw."""
    x, y, z, w = quaternion
    norm = float(np.linalg.norm(quaternion))
    if not 0.9 < norm < 1.1:
        raise FormatError(f"{where}: the quaternion {x:g} {y:g} {z:g} {w:g} has length {norm:.3g}, expected 1")
    T = np.eye(4)
    T[:3, :3] = quaternion_to_matrix(np.array([w, x, y, z]))
    T[:3, 3] = position
    return T


def _write(path: Path, trajectory: Trajectory) -> str:
    written = write_tum(path, trajectory.timestamps, trajectory.T_world_camera)
    return f"wrote {path}: {quantity(written, 'pose')}"


WRITER = Writer("trajectory", (".txt",), Takes.TRAJECTORY, "the camera's poses, TUM", _write, any_name=True)
