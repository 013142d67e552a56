# SPDX-License-Identifier: Apache-2.0
"""Coloured voxel clouds as PLY files: in metres for viewers, as whole grid coordinates for the G-PCC coder.

Both files hold the same points in the same order; header comments tie them together: a grid coordinate denotes the
centre of its voxel, metres = origin + voxel_size * (grid coordinate). The file in metres has each point where it is
within its voxel; rounded, its coordinates are those of the other file.
"""

from __future__ import annotations

import tempfile
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import IO

import numpy as np

from ggslam.errors import FormatError
from ggslam.formats.ply import read_ply, write_ply, write_ply_parts
from ggslam.formats.point_sampling import sample_points
from ggslam.formats.voxel_cloud import VoxelCloud
from ggslam.formats.writer import SurfacePoints, Takes, Writer
from ggslam.system.atomic import make_folder, write_failure
from ggslam.system.plurals import quantity
from ggslam.system.tuning import Tuning

__all__ = ["GRID_FILE", "METRIC_FILE", "VoxelCloud", "grid_positions", "read_points", "sample_points",
           "write_grid_points", "write_metric_points", "write_points", "write_points_in_parts"]  # fmt: skip

METRIC_FILE, GRID_FILE = "points.ply", "points_grid.ply"
_COLORS = ("red", "green", "blue")
_METRIC, _GRID = "x y z are metres", "x y z are grid coordinates; metres = origin + voxel_size * (x, y, z)"


class PointPlyTuning(Tuning):
    """How a point cloud is written."""

    rows_at_once = 1 << 15
    """Points that are in memory at a time."""
    max_centre_error = 0.01
    """Distance from a voxel's centre that single precision explains, in voxels."""


_OFFSETS = ("offset_x", "offset_y", "offset_z")
"""Fields of the rows that wait in the temporary file."""


def write_points(folder: str | Path, cloud: VoxelCloud) -> None:
    """Writes both variants, `points.ply` (metres) and `points_grid.ply` (grid coordinates), into an existing folder.

    Raises:
        RunFolderError: a file cannot be written.
    """
    write_metric_points(Path(folder) / METRIC_FILE, cloud)
    write_grid_points(Path(folder) / GRID_FILE, cloud)


def write_points_in_parts(folder: str | Path, clouds: Iterable[VoxelCloud]) -> int:
    """Like `write_points` for a cloud that comes in parts on one grid, which are never all in memory; the order is
    that of the parts. Returns the number of points.

    Raises:
        RunFolderError: a file cannot be written.
    """
    folder = Path(folder)
    with _temporary_file(folder) as raw:  # until all parts are there, the corner is not known
        whole, count, dtype = _gather_rows(raw, clouds)
        for name, meaning, in_cells in ((METRIC_FILE, _METRIC, False), (GRID_FILE, _GRID, True)):
            clouds_again = _read_back(raw, whole, dtype)
            rows = (_vertices(c.grid if in_cells else c.points, "f4", c) for c in clouds_again)
            empty = _vertices(np.empty((0, 3)), "f4", whole)
            write_ply_parts(folder / name, "vertex", count, rows, empty.dtype, _comments(whole, meaning), True)
    return count


@contextmanager
def _temporary_file(folder: Path) -> Iterator[IO[bytes]]:
    try:
        with tempfile.TemporaryFile(dir=folder) as file:
            yield file
    except OSError as error:
        raise write_failure(folder, error) from error


def _gather_rows(raw: IO[bytes], clouds: Iterable[VoxelCloud]) -> tuple[VoxelCloud, int, np.dtype]:
    """Writes the rows of clouds, grid coordinates counted from the world's origin; gives an empty cloud with scale,
    lowest corner and whether there are objects, the number of rows and their type."""
    count, size, corner, dtype = 0, 1.0, np.full(3, np.iinfo(np.int64).max), np.dtype("u1")
    ids: np.ndarray | None = None
    for cloud in clouds:
        size, ids = cloud.voxel_size, None if cloud.object_id is None else cloud.object_id[:0]
        grid = cloud.grid + np.rint(cloud.origin / size).astype(np.int64)
        corner = np.minimum(corner, grid.min(0))
        rows = _vertices(grid, "i4", cloud, with_offsets=True)
        raw.write(rows.tobytes())
        count, dtype = count + len(rows), rows.dtype
    corner = corner if count else np.zeros(3, np.int64)
    nothing = np.empty((0, 3), np.int32)
    return VoxelCloud(nothing, nothing.astype(np.uint8), ids, size, corner * size), count, dtype


def _read_back(raw: IO[bytes], whole: VoxelCloud, dtype: np.dtype) -> Iterator[VoxelCloud]:
    corner = np.rint(whole.origin / whole.voxel_size).astype(np.int64)
    raw.seek(0)
    while len(rows := np.frombuffer(raw.read(PointPlyTuning.rows_at_once * dtype.itemsize), dtype)):
        grid = np.stack([rows[name] for name in "xyz"], 1).astype(np.int64) - corner
        colors = np.stack([rows[name] for name in _COLORS], 1)
        ids = None if whole.object_id is None else rows["object_id"]
        offsets = np.stack([rows[name] for name in _OFFSETS], 1)
        yield VoxelCloud(grid.astype(np.int32), colors, ids, whole.voxel_size, whole.origin, offsets)


def write_metric_points(path: str | Path, cloud: VoxelCloud) -> None:
    """Writes positions as float32 metres with uint8 colours; raises RunFolderError if that fails."""
    write_ply(path, {"vertex": _vertices(cloud.points, "f4", cloud)}, _comments(cloud, _METRIC), sized_names=True)


def write_grid_points(path: str | Path, cloud: VoxelCloud) -> None:
    """Writes positions as grid coordinates, whole numbers in float32, with uint8 colours; raises RunFolderError if that
    fails."""
    write_ply(path, {"vertex": _vertices(cloud.grid, "f4", cloud)}, _comments(cloud, _GRID), sized_names=True)


def read_points(path: str | Path) -> VoxelCloud:
    """Reads either variant back; which one it is follows from the header.

    Raises:
        FormatError: not a cloud written by ggslam (properties or the comments with scale and origin missing).
    """
    ply = read_ply(path)
    vertex = ply.elements.get("vertex")
    if vertex is None or not {"x", "y", "z", *_COLORS} <= set(vertex.dtype.names or ()):
        raise FormatError(f"{path}: expected a 'vertex' element with x y z red green blue")
    position = np.stack([vertex[name] for name in "xyz"], 1)
    grid, voxel_size, origin = grid_positions(path, ply.comments, position)
    colors = np.stack([vertex[name] for name in _COLORS], 1).astype(np.uint8)
    object_id = vertex["object_id"].astype(np.int32) if "object_id" in (vertex.dtype.names or ()) else None
    offsets = None if _is_grid(ply.comments, position) else ((position - origin) / voxel_size - grid).astype(np.float32)
    if offsets is not None and np.abs(offsets).max(initial=0) < PointPlyTuning.max_centre_error:
        offsets = None
    return VoxelCloud(grid, colors, object_id, voxel_size, origin, offsets)


def grid_positions(path: str | Path, comments: list[str], position: np.ndarray) -> tuple[np.ndarray, float, np.ndarray]:
    """Grid coordinates int32 [N, 3], voxel size and origin (float64 [3], metres) of either variant.

    Args:
        path: the file, for messages.
        comments: of its header.
        position: [N, 3] as stored: grid coordinates if they are integers or a comment says so, else metres.

    Raises:
        FormatError: the comments with scale and origin are missing or damaged.
    """
    voxel_size = float(_comment(path, comments, "voxel_size", 1)[0])
    origin = _comment(path, comments, "origin", 3)
    if not _is_grid(comments, position):
        position = (position - origin) / voxel_size
    return np.rint(position).astype(np.int32), voxel_size, origin


def _is_grid(comments: list[str], position: np.ndarray) -> bool:
    """Whether positions as stored are grid coordinates."""
    return position.dtype.kind != "f" or _GRID in comments


def _vertices(position: np.ndarray, code: str, cloud: VoxelCloud, with_offsets: bool = False) -> np.ndarray:
    fields = [(name, code) for name in "xyz"] + [(name, "u1") for name in _COLORS]
    fields += [(name, "f4") for name in _OFFSETS] if with_offsets else []
    if cloud.object_id is not None:
        fields.append(("object_id", "i4"))
    rows = np.empty(len(position), fields)
    for axis, name in enumerate("xyz"):
        rows[name] = position[:, axis]
    for channel, name in enumerate(_COLORS):
        rows[name] = cloud.colors[:, channel]
    for axis, name in enumerate(_OFFSETS if with_offsets else ()):
        rows[name] = 0 if cloud.offsets is None else cloud.offsets[:, axis]
    if cloud.object_id is not None:
        rows["object_id"] = cloud.object_id
    return rows


def _comments(cloud: VoxelCloud, meaning: str) -> list[str]:
    origin = " ".join(repr(float(value)) for value in cloud.origin)
    return [meaning, f"voxel_size {float(cloud.voxel_size)!r}", f"origin {origin}"]


def _comment(path: str | Path, comments: list[str], key: str, count: int) -> np.ndarray:
    """The numbers behind `key` in the header comments."""
    for text in comments:
        words = text.split()
        if words and words[0] == key:
            try:
                numbers = np.array([float(word) for word in words[1:]])
            except ValueError:
                break
            if len(numbers) == count and np.isfinite(numbers).all() and (key != "voxel_size" or numbers[0] > 0):
                return numbers
    raise FormatError(f"{path}: no usable header comment '{key}' (is it a cloud written by ggslam?)")


def _write(folder: Path, points: SurfacePoints) -> str:
    make_folder(folder)
    count = write_points_in_parts(folder, points.clouds)
    names = f"{METRIC_FILE} and {GRID_FILE}"
    return f"wrote {folder}/{names}: {quantity(count, 'point')} on a {points.voxel_size:g} m grid"


WRITER = Writer("points", (), Takes.POINTS, "coloured points, PLY in metres and in cells of a grid", _write)
