# SPDX-License-Identifier: Apache-2.0
"""Point Cloud Data files (PCD 0.7, the Point Cloud Library's own): reads text, binary and compressed, writes binary and
compressed.

Specification: "The PCD (Point Cloud Data) file format", pointclouds.org.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from ggslam.errors import FormatError
from ggslam.formats import lzf
from ggslam.formats.text_numbers import fit, parse_numbers
from ggslam.scene.poses import quaternion_to_matrix
from ggslam.system.atomic import write_bytes
from ggslam.system.tuning import Tuning
from ggslam.system.untrusted_files import open_untrusted, read_untrusted


class PcdTuning(Tuning):
    """A limit on damaged files."""

    max_header_bytes = 1 << 16
    """Largest header, in bytes."""


_KEYWORDS = ("VERSION", "FIELDS", "SIZE", "TYPE", "COUNT", "WIDTH", "HEIGHT", "VIEWPOINT", "POINTS", "DATA")
_SIZES = {"I": (1, 2, 4, 8), "U": (1, 2, 4, 8), "F": (4, 8)}


@dataclass(frozen=True)
class _Header:
    """`stored` is the type of one point as it lies in the file; fields named '_' (padding) have running numbers."""

    stored: np.dtype
    points: int
    encoding: str
    size: int


def read_pcd(path: str | Path) -> np.ndarray:
    """The points of a PCD file as a structured array [N]; a field with COUNT k > 1 has shape [k]. Padding is left out.

    Raises:
        FormatError: the file is missing, no PCD file, cut off or damaged; names file and reason.
    """
    path = Path(path)
    return parse_pcd(read_untrusted(path), path)


def parse_pcd(data: bytes, path: str | Path) -> np.ndarray:
    """The points of a PCD file's whole content; `path` is the name for error messages. See `read_pcd`."""
    path = Path(path)
    header = _read_header(data, path)
    body = data[header.size :]
    if header.encoding == "ascii":
        rows = _ascii_rows(body, header, path)
    elif header.encoding == "binary":
        rows = _binary_rows(body, header, path)
    else:
        rows = _compressed_rows(body, header, path)
    wanted = [name for name in rows.dtype.names or () if not name.startswith("_ ")]
    return rows[wanted]


def read_viewpoint(path: str | Path) -> np.ndarray | None:
    """The pose of the sensor in the header of a PCD file (VIEWPOINT), T_world_sensor float64 [4, 4]; None: the header
    has none. The points are as the sensor saw them.

    Raises:
        FormatError: the file is missing, no PCD file, or the pose is none; names file and reason.
    """
    path = Path(path)
    with open_untrusted(path) as file:
        lines, _ = _header_lines(file.read(PcdTuning.max_header_bytes), path)
    words = lines.get("VIEWPOINT")
    if words is None:
        return None
    try:
        numbers = np.array([float(word) for word in words])
    except ValueError:
        numbers = np.zeros(0)
    norm = float(np.linalg.norm(numbers[3:]))
    if len(numbers) != 7 or not np.isfinite(numbers).all() or not 0.9 < norm < 1.1:
        raise FormatError(f"{path}: VIEWPOINT is {' '.join(words)!r}, expected a position and a unit quaternion (wxyz)")
    T = np.eye(4)
    T[:3, :3], T[:3, 3] = quaternion_to_matrix(numbers[3:] / norm), numbers[:3]
    return T


def write_pcd(path: str | Path, columns: Mapping[str, np.ndarray]) -> None:
    """Writes a binary PCD file, atomically. For `columns` see `pcd_bytes`.

    Raises:
        RunFolderError: the file cannot be written.
        ValueError: see `pcd_bytes`.
    """
    write_bytes(path, pcd_bytes(columns))


def pcd_bytes(columns: Mapping[str, np.ndarray], compressed: bool = False) -> bytes:
    """The content of a binary PCD file.

    Args:
        columns: one array of integers or floating-point numbers per field, in order, all of one length: [N] or, for a
            field with COUNT k > 1, [N, k].
        compressed: writes DATA binary_compressed, unless DATA binary takes no more bytes.

    Raises:
        ValueError: a field is of a type that PCD files do not have.
    """
    for name, values in columns.items():
        if values.dtype.itemsize not in _SIZES.get(values.dtype.kind.upper(), ()):
            raise ValueError(f"field '{name}': PCD files hold no {values.dtype}")
    fields = [(name, values.dtype.newbyteorder("<"), values.shape[1:]) for name, values in columns.items()]
    count = len(next(iter(columns.values())))
    if compressed:
        planes = b"".join(columns[name].astype(stored).tobytes() for name, stored, _ in fields)
        packed = lzf.compress(planes)
        if len(packed) + 8 < len(planes):
            sizes = np.array([len(packed), len(planes)], "<u4").tobytes()
            return _header_text(fields, count, "binary_compressed") + sizes + packed
    rows = np.empty(count, fields)
    for name, values in columns.items():
        rows[name] = values
    return _header_text(fields, count, "binary") + rows.tobytes()


def _header_text(fields: list[tuple[str, np.dtype, tuple[int, ...]]], count: int, encoding: str) -> bytes:
    names, types, shapes = zip(*fields, strict=True)
    lines = [
        "# .PCD v0.7 - Point Cloud Data file format", "VERSION 0.7", f"FIELDS {' '.join(names)}",
        f"SIZE {' '.join(str(t.itemsize) for t in types)}", f"TYPE {' '.join(t.kind.upper() for t in types)}",
        f"COUNT {' '.join(str(shape[0]) if shape else '1' for shape in shapes)}", f"WIDTH {count}", "HEIGHT 1",
        "VIEWPOINT 0 0 0 1 0 0 0", f"POINTS {count}", f"DATA {encoding}", "",
    ]  # fmt: skip
    return "\n".join(lines).encode("ascii")


def _read_header(data: bytes, path: Path) -> _Header:
    lines, size = _header_lines(data, path)
    try:
        names = lines["FIELDS"]
        sizes = [int(word) for word in lines["SIZE"]]
        counts = [int(word) for word in lines.get("COUNT", ["1"] * len(names))]
        width, height = int(lines["WIDTH"][0]), int(lines["HEIGHT"][0])
        points = int(lines["POINTS"][0]) if "POINTS" in lines else width * height
        stored = _stored_type(names, sizes, lines["TYPE"], counts)
    except KeyError as error:
        raise FormatError(f"{path}: the header has no line {error.args[0]}") from None
    except (ValueError, IndexError) as error:
        raise FormatError(f"{path}: the header is damaged: {error}") from None
    if points < 0 or points != width * height:
        raise FormatError(f"{path}: the header claims {points} points and an image of {width}x{height}")
    encoding = (lines["DATA"] or [""])[0]
    if encoding not in ("ascii", "binary", "binary_compressed"):
        raise FormatError(f"{path}: DATA is {encoding!r}, expected ascii, binary or binary_compressed")
    return _Header(stored, points, encoding, size)


def _header_lines(data: bytes, path: Path) -> tuple[dict[str, list[str]], int]:
    """The words behind each keyword, and where the data begin."""
    lines: dict[str, list[str]] = {}
    at = 0
    while "DATA" not in lines:
        end = data.find(b"\n", at, PcdTuning.max_header_bytes)
        words = data[at : max(end, 0)].decode("latin-1").split()
        if words and not words[0].startswith("#"):
            if words[0] not in _KEYWORDS:
                raise FormatError(f"{path}: not a PCD file, or damaged: a header line begins with {words[0][:32]!r}")
            lines[words[0]] = words[1:]
        if end < 0:
            raise FormatError(f"{path}: not a PCD file, or cut off: no line DATA in its header")
        at = end + 1
    return lines, at


def _stored_type(names: list[str], sizes: list[int], types: list[str], counts: list[int]) -> np.dtype:
    if not names or not len(names) == len(sizes) == len(types) == len(counts):
        raise ValueError("FIELDS, SIZE, TYPE and COUNT differ in length")
    fields: list[tuple] = []
    for number, (name, size, kind, count) in enumerate(zip(names, sizes, types, counts, strict=True)):
        if kind not in _SIZES or size not in _SIZES[kind] or not 0 <= count <= 1 << 16:
            raise ValueError(f"field '{name}' is of type {kind}, size {size} and count {count}")
        if count == 0:  # padding that takes no bytes, which drivers of sensors write
            continue
        unique = f"_ {number}" if name == "_" else name
        if any(unique == other[0] for other in fields):
            raise ValueError(f"field '{name}' is declared twice")
        code = f"<{kind.lower()}{size}"
        fields.append((unique, code) if count == 1 else (unique, code, (count,)))
    if not fields:
        raise ValueError("no field has a COUNT above 0")
    return np.dtype(fields)


def _binary_rows(body: bytes, header: _Header, path: Path) -> np.ndarray:
    needed = header.points * header.stored.itemsize
    if len(body) < needed:
        raise FormatError(f"{path}: truncated: {header.points} points take {needed} bytes, found {len(body)}")
    return np.frombuffer(body, header.stored, header.points)


def _compressed_rows(body: bytes, header: _Header, path: Path) -> np.ndarray:
    """Compressed files hold field after field, not point after point."""
    if len(body) < 8:
        raise FormatError(f"{path}: truncated: no sizes of the compressed data")
    packed, unpacked = (int(v) for v in np.frombuffer(body, "<u4", 2))
    needed = header.points * header.stored.itemsize
    if unpacked != needed or len(body) - 8 < packed:
        raise FormatError(
            f"{path}: truncated or damaged: {header.points} points take {needed} bytes, the data say {unpacked}; "
            f"{packed} compressed bytes, found {len(body) - 8}"
        )
    try:
        data = lzf.decompress(body[8 : 8 + packed], unpacked)
    except ValueError as error:
        raise FormatError(f"{path}: damaged: {error}") from None
    rows = np.empty(header.points, header.stored)
    at = 0
    for name in header.stored.names or ():
        part = header.stored[name]
        rows[name] = np.frombuffer(data, part, header.points, at)
        at += header.points * part.itemsize
    return rows


def _ascii_rows(body: bytes, header: _Header, path: Path) -> np.ndarray:
    names = header.stored.names or ()
    widths = [int(np.prod(header.stored[name].shape, dtype=int)) for name in names]
    words = body.split()
    needed = header.points * sum(widths)
    if len(words) < needed:
        raise FormatError(f"{path}: truncated: {header.points} points take {needed} numbers, found {len(words)}")
    table = parse_numbers(words[:needed], "data", path).reshape(header.points, sum(widths))
    rows = np.empty(header.points, header.stored)
    column = 0
    for name, width in zip(names, widths, strict=True):
        part = header.stored[name]
        values = fit(table[:, column : column + width], part.base.str[1:], name, path)
        rows[name] = values if part.shape else values[:, 0]
        column += width
    return rows
