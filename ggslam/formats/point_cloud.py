# SPDX-License-Identifier: Apache-2.0
"""Coloured point clouds from any PLY or PCD file, and back.

Positions are x y z. Colours are red green blue, r g b or diffuse_*, as bytes, 16-bit integers or floating-point
numbers; in PCD files packed as rgb or rgba; in 3DGS files the degree-0 coefficients f_dc_*. Other whole numbers
(label, object_id, ...) are kept by name, everything else is left out.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np

from ggslam.errors import FormatError, InputError, NoPointsError, NotACloudError
from ggslam.formats.gaussian_ply import object_ids
from ggslam.formats.pcd import read_pcd, write_pcd
from ggslam.formats.ply import read_ply, write_ply
from ggslam.formats.point_ply import grid_positions
from ggslam.formats.positions import placed_rows
from ggslam.formats.voxel_cloud import join_clouds
from ggslam.formats.writer import SurfacePoints, Takes, Writer
from ggslam.scene.gaussian_map import SH_C0
from ggslam.system.plurals import quantity
from ggslam.system.untrusted_files import open_untrusted

COLORS = ("red", "green", "blue")
_COLOR_NAMES = (COLORS, ("r", "g", "b"), ("diffuse_red", "diffuse_green", "diffuse_blue"))
_GAUSSIAN_COLOR = ("f_dc_0", "f_dc_1", "f_dc_2")
_PACKED_COLORS = ("rgb", "rgba")
_REFLECTANCE = ("reflectance", "refc", "intensity", "scalar_intensity")
_ALPHA = {"alpha", "a", "diffuse_alpha"}
_WRITTEN_SUFFIXES = ("", ".ply", ".pcd")
_WRITTEN_INTEGERS = ("u1", "i2", "u2", "i4", "u4")


@dataclass(frozen=True)
class ColoredCloud:
    """A cloud as a file holds it.

    Attributes:
        points: float64 [N, 3], metres (or the file's own unit), all finite.
        colors: uint8 [N, 3] RGB, or None.
        labels: whole numbers by name, each [N].
        reflectance: numbers [N] that say how much light came back, or None; `reflectance_name` is the file's own name.
        grid: int32 [N, 3], where the points lie on their grid, if the file is a voxelised cloud that ggslam wrote.
        voxel_size: edge of the grid's voxels in metres; points = origin + voxel_size * grid.
        origin: float64 [3], metres.
        left_out: names of the properties that are neither position nor colour nor whole numbers.
        nowhere: number of points of the file that have no position and were left out.
    """

    points: np.ndarray
    colors: np.ndarray | None
    labels: dict[str, np.ndarray] = field(default_factory=dict)
    grid: np.ndarray | None = None
    voxel_size: float | None = None
    origin: np.ndarray | None = None
    left_out: tuple[str, ...] = ()
    nowhere: int = 0
    reflectance: np.ndarray | None = None
    reflectance_name: str = "reflectance"

    def __len__(self) -> int:
        return len(self.points)


def read_point_cloud(path: str | Path, tell: bool = True) -> ColoredCloud:
    """Reads a PLY or PCD file; which one it is follows from its first bytes.

    Points without a position (not a number: the sensor saw nothing there) are left out and counted.

    Args:
        path: the file.
        tell: warn (logger `ggslam.formats.positions`) if points were left out.

    Raises:
        FormatError: the file is missing, neither PLY nor PCD, damaged, has no points, or colours or positions of a
            kind that cannot be; names file and reason.
    """
    path = Path(path)
    try:
        with open_untrusted(path) as file:
            start = file.read(4)
    except OSError as error:
        raise FormatError(f"cannot read {path}: {error.strerror or error}") from error
    if start[:3] == b"ply":
        ply = read_ply(path)
        if "vertex" not in ply.elements:
            raise FormatError(f"{path}: no element 'vertex'; it has {', '.join(ply.elements) or 'none'}")
        return _cloud(path, ply.elements["vertex"], ply.comments, tell)
    if path.suffix.lower() != ".pcd" and not start.startswith((b"#", b"VERS")):
        raise NotACloudError(path, f"neither a PLY nor a PCD file (it begins with {start!r})")
    return _cloud(path, read_pcd(path), [], tell)


def write_point_cloud(
    path: str | Path, points: np.ndarray, attributes: Mapping[str, np.ndarray], comments: Sequence[str] = ()
) -> None:
    """Writes a binary little-endian PLY file or, if the name ends so, a binary PCD file, atomically.

    Args:
        path: the file to write.
        points: [N, 3]; float32 and float64 become float and double, integers int.
        attributes: "color": uint8 [N, 3] RGB; others: integers [N] or [N, k], whose columns become NAME_0, NAME_1, ...
        comments: single ASCII lines for the header (PLY only).

    Raises:
        FormatError: an attribute holds integers of more than 32 bits, or the name ends as that of another format.
        InputError: points or an attribute of another shape or type.
        RunFolderError: the file cannot be written.
    """
    if Path(path).suffix.lower() not in _WRITTEN_SUFFIXES:
        raise FormatError(f"{path}: expected a name that ends in .ply or .pcd")
    _check_shapes(path, points, attributes)
    columns = {name: _to_written_type(path, "position", points[:, axis]) for axis, name in enumerate("xyz")}
    pcd = Path(path).suffix.lower() == ".pcd"
    for name, values in attributes.items():
        if name == "color" and pcd:
            columns["rgb"] = _packed_rgb(values)
        elif values.ndim == 1:
            columns[name] = _to_written_type(path, name, values)
        else:
            names = COLORS if name == "color" else [f"{name}_{i}" for i in range(values.shape[1])]
            columns.update({n: _to_written_type(path, name, values[:, i]) for i, n in enumerate(names)})
    if pcd:
        write_pcd(path, columns)
        return
    rows = np.empty(len(points), [(name, values.dtype) for name, values in columns.items()])
    for name, values in columns.items():
        rows[name] = values
    write_ply(path, {"vertex": rows}, comments, sized_names=True)


def _check_shapes(path: str | Path, points: np.ndarray, attributes: Mapping[str, np.ndarray]) -> None:
    for name, values in {"points": points, **attributes}.items():
        found = f"{values.dtype} {list(values.shape)}" if isinstance(values, np.ndarray) else type(values).__name__
        if not isinstance(values, np.ndarray) or values.dtype.kind not in "fiub":
            raise InputError(f"{path}: {name}: expected an array of numbers, found {found}")
        if name == "points" or name == "color":
            fits = values.ndim == 2 and values.shape[1] == 3 and len(values) == len(points)
        else:
            fits = values.ndim in (1, 2) and len(values) == len(points)
        if not fits:
            shape = {"points": "[N, 3]", "color": f"[{len(points)}, 3]"}.get(name, f"[{len(points)}] or [.., k]")
            raise InputError(f"{path}: {name}: expected {shape}, found {found}")


def _to_written_type(path: str | Path, name: str, values: np.ndarray) -> np.ndarray:
    """The values in a type that both formats have."""
    if values.dtype.kind == "f" or values.dtype.str[1:] in _WRITTEN_INTEGERS:
        return values
    low, high = int(values.min(initial=0)), int(values.max(initial=0))
    for code in ("i4", "u4"):
        if np.iinfo(code).min <= low and high <= np.iinfo(code).max:
            return values.astype(code)
    raise FormatError(f"{path}: '{name}' reaches from {low} to {high}, more than 32 bits can hold")


def _packed_rgb(colors: np.ndarray) -> np.ndarray:
    """The Point Cloud Library's float32 whose bits are 0x00RRGGBB."""
    r, g, b = colors.astype(np.uint32).T
    return ((r << 16) | (g << 8) | b).view(np.float32)


def _cloud(path: Path, rows: np.ndarray, comments: list[str], tell: bool) -> ColoredCloud:
    if not len(rows):
        raise NoPointsError(f"{path}: no points")
    axes = _position_names(path, rows)
    stored = len(rows)
    rows = rows[placed_rows(path, np.stack([rows[name] for name in axes], 1), tell)]
    position = np.stack([rows[name] for name in axes], 1)
    points = position.astype(np.float64)
    color_names = _color_names(rows)
    colors = None if color_names is None else _colors(path, rows, color_names)
    reflectance = _reflectance_name(rows)
    used = {*axes, *(color_names or ()), *((reflectance,) if reflectance else ())}
    others = [n for n in rows.dtype.names or () if n not in used]
    labels = {n: rows[n] for n in others if rows.dtype[n].kind in "iu" and n.lower() not in _ALPHA}
    if color_names == _GAUSSIAN_COLOR and "object_id" in others:  # of a 3DGS PLY, where all is float32
        labels["object_id"] = object_ids(path, rows)
    left_out = tuple(n for n in others if n not in labels)
    cloud = ColoredCloud(points, colors, labels, left_out=left_out, nowhere=stored - len(rows))
    if reflectance is not None:
        cloud = replace(cloud, reflectance=rows[reflectance], reflectance_name=reflectance)
    if not any(text.split()[:1] == ["voxel_size"] for text in comments):
        return cloud
    grid, voxel_size, origin = grid_positions(path, comments, position)
    return replace(cloud, points=origin + voxel_size * grid, grid=grid, voxel_size=voxel_size, origin=origin)


def _position_names(path: Path, rows: np.ndarray) -> tuple[str, str, str]:
    """The properties x y z, or X Y Z as some programs call them."""
    numbers = [name for name in rows.dtype.names or () if rows.dtype[name].kind in "fiu"]
    for names in (("x", "y", "z"), ("X", "Y", "Z")):
        if set(names) <= set(numbers):
            return names
    missing = " ".join(name for name in "xyz" if name not in numbers)
    raise FormatError(f"{path}: no positions: expected the properties x y z, missing {missing}")


def _color_names(rows: np.ndarray) -> tuple[str, ...] | None:
    """Which of the properties are the colour."""
    present = {name.lower(): name for name in rows.dtype.names or () if not rows.dtype[name].shape}
    for names in (*_COLOR_NAMES, _GAUSSIAN_COLOR, *((name,) for name in _PACKED_COLORS)):
        if all(name in present for name in names):
            return tuple(present[name] for name in names)
    return None


def _reflectance_name(rows: np.ndarray) -> str | None:
    """Which of the properties is the reflectance: finite numbers."""
    for name in rows.dtype.names or ():
        if name.lower() in _REFLECTANCE and not rows.dtype[name].shape and rows.dtype[name].kind in "fiu":
            return name if np.isfinite(rows[name]).all() else None
    return None


def _colors(path: Path, rows: np.ndarray, names: tuple[str, ...]) -> np.ndarray:
    """uint8 [N, 3]."""
    if len(names) == 1:
        return _unpacked_rgb(path, rows[names[0]], names[0])
    values = np.stack([rows[name] for name in names], 1)
    if not np.isfinite(values).all():
        raise FormatError(f"{path}: the colour of point {int(np.argmin(np.isfinite(values).all(1)))} is not a number")
    if names[0].lower() == _GAUSSIAN_COLOR[0]:
        return np.rint(255 * (0.5 + SH_C0 * values.astype(np.float64)).clip(0, 1)).astype(np.uint8)
    low, high = float(values.min()), float(values.max())
    if low < 0 or high > 65535:
        raise FormatError(f"{path}: colours {' '.join(names)} reach from {low:g} to {high:g}, expected 0 to 255")
    if high > 255:  # 16 bits
        return np.rint(values * (255 / 65535)).astype(np.uint8)
    scale = 255.0 if values.dtype.kind == "f" and high <= 1 else 1.0
    return np.rint(values * scale).astype(np.uint8)


def _unpacked_rgb(path: Path, packed: np.ndarray, name: str) -> np.ndarray:
    if packed.dtype.itemsize != 4:
        raise FormatError(f"{path}: field '{name}' is {packed.dtype}, expected 4 bytes")
    bits = np.ascontiguousarray(packed).view(np.uint32)
    return np.stack([bits >> 16 & 255, bits >> 8 & 255, bits & 255], 1).astype(np.uint8)


def _write_pcd(path: Path, points: SurfacePoints) -> str:
    cloud = join_clouds(points.clouds)
    attributes = {"color": cloud.colors}
    if cloud.object_id is not None:
        attributes["object_id"] = cloud.object_id
    write_point_cloud(path, cloud.points.astype("f4"), attributes)
    return f"wrote {path}: {quantity(len(cloud), 'point')} on a {points.voxel_size:g} m grid"


WRITER = Writer("pcd", (".pcd",), Takes.POINTS, "coloured points with object ids", _write_pcd)
