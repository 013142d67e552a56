# SPDX-License-Identifier: Apache-2.0
"""Polygon File Format (PLY 1.0): reads ASCII and binary files of either byte order, writes binary little endian.

Specification: G. Turk, "The PLY Polygon File Format", 1994.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import BinaryIO

import numpy as np

from ggslam.errors import FormatError, InputError
from ggslam.formats.ply_header import FORMATS, PLY_NAMES, SIZED_NAMES, Element, Header, read_header
from ggslam.formats.text_numbers import fit, parse_numbers
from ggslam.system.atomic import atomic_write
from ggslam.system.untrusted_files import open_untrusted


@dataclass(frozen=True)
class PlyFile:
    """The contents of a PLY file.

    Attributes:
        elements: one structured array per element ("vertex", "face", ...), native byte order. A list property becomes
            a field of shape [k] where all rows have k entries, else a field of objects (one array per row).
        comments: the texts of the header's comment lines.
    """

    elements: dict[str, np.ndarray]
    comments: list[str] = field(default_factory=list)


def read_ply(path: str | Path) -> PlyFile:
    """Reads a PLY file.

    Raises:
        FormatError: the file is missing, no PLY file, cut off, or claims more data than it holds; names file and
            reason. Bytes after the declared data are ignored, as all readers do.
    """
    path = Path(path)
    try:
        with open_untrusted(path) as file:
            header = read_header(file, path)
            if header.encoding == "ascii":
                elements = _read_ascii(file, header, path)
            else:
                elements = _read_binary(file, header, path)
    except OSError as error:
        raise FormatError(f"cannot read {path}: {error.strerror or error}") from error
    return PlyFile(elements, header.comments)


def write_ply(
    path: str | Path, elements: Mapping[str, np.ndarray], comments: Sequence[str] = (), fsync: bool = False,
    sized_names: bool = False,
) -> None:  # fmt: skip
    """Writes a binary little-endian PLY file, atomically (see `ggslam.system.atomic.atomic_write`).

    Args:
        path: the file to write.
        elements: one structured array per element. Fields of 1, 2 or 4 byte integers and float32/float64 become
            scalar properties; a field of shape [k], k < 256, becomes a list property.
        comments: single lines for the header, ASCII.
        fsync: also waits for the disk.
        sized_names: types are called int32 and float64, not int and double, as tools for point clouds want them; splat
            viewers want the others.

    Raises:
        ValueError: a name, type or comment that PLY cannot express.
        RunFolderError: the file cannot be written.
    """
    with atomic_write(path, fsync) as temporary, temporary.open("wb") as file:
        kinds = {name: (len(rows), rows.dtype) for name, rows in elements.items()}
        file.write(_header(kinds, comments, sized_names))
        for rows in elements.values():
            file.write(_pack(rows).tobytes())


def write_ply_parts(
    path: str | Path, element: str, count: int, parts: Iterable[np.ndarray], dtype: np.dtype,
    comments: Sequence[str] = (), sized_names: bool = False,
) -> None:  # fmt: skip
    """Writes a file of one element whose rows come in parts, atomically, so that they are never all in memory.

    Args:
        path, comments, sized_names: as in `write_ply`.
        element: its name ("vertex").
        count: rows of all parts together.
        parts: structured arrays of type `dtype`.

    Raises:
        ValueError: a name, type or comment that PLY cannot express, or another number of rows than `count`.
        RunFolderError: the file cannot be written.
    """
    write_ply_elements(path, {element: RowParts(count, dtype, parts)}, comments, sized_names)


@dataclass(frozen=True)
class RowParts:
    """Rows of an element that come in parts.

    Attributes:
        count: of all parts together.
        dtype: of a row.
        parts: structured arrays of this type.
    """

    count: int
    dtype: np.dtype
    parts: Iterable[np.ndarray]


def write_ply_elements(
    path: str | Path, elements: Mapping[str, RowParts], comments: Sequence[str] = (), sized_names: bool = False
) -> None:
    """Writes a file of elements whose rows come in parts, one element after the other; see `write_ply_parts`."""
    with atomic_write(path) as temporary, temporary.open("wb") as file:
        file.write(_header({name: (rows.count, rows.dtype) for name, rows in elements.items()}, comments, sized_names))
        for rows in elements.values():
            written = 0
            for part in rows.parts:
                file.write(_pack(part).tobytes())
                written += len(part)
            if written != rows.count:
                raise InputError(f"{path}: {written} rows were given, {rows.count} were announced")


def _header(elements: Mapping[str, tuple[int, np.dtype]], comments: Sequence[str], sized_names: bool) -> bytes:
    for text in comments:
        if not text.isascii() or not text.isprintable():
            raise InputError(f"a PLY comment must be one line of ASCII, found {text!r}")
    lines = ["ply", "format binary_little_endian 1.0", *(f"comment {text}" for text in comments)]
    types = SIZED_NAMES if sized_names else PLY_NAMES
    for name, (count, dtype) in elements.items():
        lines += [f"element {_checked_name(name)} {count}", *_declarations(dtype, types)]
    return "\n".join([*lines, "end_header", ""]).encode("ascii")


def _checked_name(name: str) -> str:
    if not name.isascii() or not name.isprintable() or len(name.split()) != 1:
        raise InputError(f"a PLY name must be one ASCII word, found {name!r}")
    return name


def _declarations(dtype: np.dtype, names: Mapping[str, str]) -> Iterator[str]:
    """Property lines of a structured type, whose types have these names."""
    if not dtype.names:
        raise InputError(f"a PLY element needs a structured array, found {dtype}")
    for name in dtype.names:
        base, shape = dtype[name].base, dtype[name].shape
        code = base.str[1:]
        if code not in names or len(shape) > 1 or (shape and shape[0] > 255):
            raise InputError(f"PLY has no type for field '{name}' ({dtype[name]})")
        listed = "list uchar " if shape else ""
        yield f"property {listed}{names[code]} {_checked_name(name)}"


def _pack(rows: np.ndarray) -> np.ndarray:
    """The rows as they lie in the file: little endian, without padding, lists preceded by their length."""
    parts: list[tuple] = []
    for name in rows.dtype.names or ():
        base, shape = rows.dtype[name].base, rows.dtype[name].shape
        if shape:
            parts.append((f"{name} count", "u1"))
        parts.append((name, base.newbyteorder("<"), shape) if shape else (name, base.newbyteorder("<")))
    packed = np.empty(len(rows), np.dtype(parts))
    for name in rows.dtype.names or ():
        packed[name] = rows[name]
        if rows.dtype[name].shape:
            packed[f"{name} count"] = rows.dtype[name].shape[0]
    return packed


# --- reading -------------------------------------------------------------------------------------------------------


def _read_binary(file: BinaryIO, header: Header, path: Path) -> dict[str, np.ndarray]:
    order = FORMATS[header.encoding]
    out: dict[str, np.ndarray] = {}
    for element in header.elements:
        if element.has_lists:
            data = file.read()
            rows, used = _binary_rows_with_lists(data, element, order, path)
            file.seek(used - len(data), 1)
        else:
            stored = np.dtype([(p.name, order + p.code) for p in element.properties])
            data = file.read(element.count * stored.itemsize)
            if len(data) < element.count * stored.itemsize:
                raise _truncation_error(path, element, len(data) // stored.itemsize)
            # An element without properties has no rows (the header check sees to that), nor a size to divide by.
            rows = np.frombuffer(data, stored) if element.properties else np.empty(0, stored)
            rows = rows.astype(stored.newbyteorder("="))
        out[element.name] = rows
    return out


def _binary_rows_with_lists(data: bytes, element: Element, order: str, path: Path) -> tuple[np.ndarray, int]:
    """Rows of an element with list properties, and the bytes used. Rows of one size are read at once."""
    lengths = _first_list_lengths(data, element, order)
    if lengths is not None:
        stored = np.dtype(
            [part for p in element.properties
             for part in ([(f"{p.name} count", order + p.count_code), (p.name, order + p.code, (lengths[p.name],))]
                          if p.count_code else [(p.name, order + p.code)])]
        )  # fmt: skip
        size = stored.itemsize * element.count
        if size <= len(data):
            rows = np.frombuffer(data, stored, element.count)
            if all((rows[f"{name} count"] == length).all() for name, length in lengths.items()):
                wanted = [(p.name, p.code, (lengths[p.name],)) if p.count_code else (p.name, p.code)
                          for p in element.properties]  # fmt: skip
                out = np.empty(element.count, np.dtype(wanted))
                for p in element.properties:
                    out[p.name] = rows[p.name]
                return out, size
    return _binary_rows_one_by_one(data, element, order, path)


def _first_list_lengths(data: bytes, element: Element, order: str) -> dict[str, int] | None:
    """List lengths of the first row; None if there is none or it is damaged."""
    if element.count == 0:
        return None
    offset, lengths = 0, {}
    for p in element.properties:
        length = 1
        if p.count_code:
            size = np.dtype(p.count_code).itemsize
            if offset + size > len(data):
                return None
            length = lengths[p.name] = int(np.frombuffer(data, order + p.count_code, 1, offset)[0])
            offset += size
        if length < 0 or length > len(data):
            return None
        offset += length * np.dtype(p.code).itemsize
    return lengths


def _binary_rows_one_by_one(data: bytes, element: Element, order: str, path: Path) -> tuple[np.ndarray, int]:
    out = np.empty(element.count, [(p.name, object if p.count_code else p.code) for p in element.properties])
    offset = 0
    for row in range(element.count):
        for p in element.properties:
            try:
                length = 1
                if p.count_code:
                    length = int(np.frombuffer(data, order + p.count_code, 1, offset)[0])
                    offset += np.dtype(p.count_code).itemsize
                if length < 0:
                    raise ValueError("negative list length")
                values = np.frombuffer(data, order + p.code, length, offset) if length else np.empty(0, p.code)
            except ValueError:
                raise _truncation_error(path, element, row) from None
            offset += length * np.dtype(p.code).itemsize
            out[row][p.name] = values.astype(p.code) if p.count_code else values[0]
    return out, offset


def _read_ascii(file: BinaryIO, header: Header, path: Path) -> dict[str, np.ndarray]:
    words = file.read().split()
    position = 0
    out: dict[str, np.ndarray] = {}
    for element in header.elements:
        if element.has_lists:
            out[element.name], position = _ascii_rows_with_lists(words, position, element, path)
            continue
        columns = len(element.properties)
        found = words[position : position + element.count * columns]
        position += len(found)
        if len(found) < element.count * columns:
            raise _truncation_error(path, element, len(found) // max(columns, 1))
        table = parse_numbers(found, f"element '{element.name}'", path).reshape(element.count, columns)
        rows = np.empty(element.count, [(p.name, p.code) for p in element.properties])
        for column, p in enumerate(element.properties):
            rows[p.name] = fit(table[:, column], p.code, p.name, path)
        out[element.name] = rows
    return out


def _ascii_rows_with_lists(words: list[bytes], position: int, element: Element, path: Path) -> tuple[np.ndarray, int]:
    what = f"element '{element.name}'"
    out = np.empty(element.count, [(p.name, object if p.count_code else p.code) for p in element.properties])
    for row in range(element.count):
        for p in element.properties:
            length = 1
            if p.count_code:
                found = parse_numbers(words[position : position + 1], what, path)
                length = int(found[0]) if len(found) and np.isfinite(found[0]) else -1
                position += 1
            if length < 0 or position + length > len(words):
                raise _truncation_error(path, element, row)
            values = parse_numbers(words[position : position + length], what, path)
            values = fit(values, p.code, p.name, path)
            position += length
            out[row][p.name] = values if p.count_code else values[0]
    return _with_equal_lists_as_arrays(out, element), position


def _with_equal_lists_as_arrays(rows: np.ndarray, element: Element) -> np.ndarray:
    """Gives lists that all have the same length a field of that shape, as the binary reader does."""
    wanted: list[tuple] = []
    for p in element.properties:
        lengths = {len(v) for v in rows[p.name]} if p.count_code else set()
        wanted.append((p.name, p.code, (lengths.pop(),)) if len(lengths) == 1 else (p.name, rows.dtype[p.name]))
    out = np.empty(len(rows), np.dtype(wanted))
    for p in element.properties:
        stacked = len(out.dtype[p.name].shape) == 1
        out[p.name] = np.stack(list(rows[p.name])) if stacked else rows[p.name]
    return out


def _truncation_error(path: Path, element: Element, found: int) -> FormatError:
    return FormatError(
        f"{path}: truncated or damaged: element '{element.name}' claims {element.count} rows, found {found}"
    )
