# SPDX-License-Identifier: Apache-2.0
"""The text header of PLY files: element and property declarations, checked before anything is allocated."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path
from typing import BinaryIO

import numpy as np

from ggslam.errors import FormatError
from ggslam.system.tuning import Tuning


class PlyHeaderTuning(Tuning):
    """A limit on damaged files."""

    max_header_bytes = 1 << 20
    """Largest header, in bytes."""


FORMATS = {"ascii": "", "binary_little_endian": "<", "binary_big_endian": ">"}
"""PLY encodings and numpy's sign of their byte order."""

NUMPY_CODES = {
    "char": "i1", "uchar": "u1", "short": "i2", "ushort": "u2", "int": "i4", "uint": "u4", "float": "f4",
    "double": "f8", "int8": "i1", "uint8": "u1", "int16": "i2", "uint16": "u2", "int32": "i4", "uint32": "u4",
    "float32": "f4", "float64": "f8",
}  # fmt: skip
"""Scalar types of the PLY specification, both naming schemes."""

_READ_CODES = {**NUMPY_CODES, "int64": "i8", "uint64": "u8", "long": "i8", "ulong": "u8"}
"""And types of 8 bytes, which the specification lacks and programs write nevertheless (times, numbers of points)."""

PLY_NAMES = {code: name for name, code in reversed(NUMPY_CODES.items())}
"""The classic name of each numpy type code."""

SIZED_NAMES = {**PLY_NAMES, "i2": "int16", "u2": "uint16", "i4": "int32", "u4": "uint32", "f8": "float64"}
"""Names that every reader of point clouds knows: the G-PCC reference software has no other ones of these types."""


@dataclass(frozen=True)
class Property:
    """One property: a number, or (`count_code` set) a list preceded by its length."""

    name: str
    code: str
    count_code: str | None = None


@dataclass
class Element:
    """One element declaration with its number of rows."""

    name: str
    count: int
    properties: list[Property] = field(default_factory=list)

    @property
    def has_lists(self) -> bool:
        """Whether rows may differ in size."""
        return any(p.count_code is not None for p in self.properties)

    def smallest_row(self, encoding: str) -> int:
        """Fewest bytes that one row can take; bounds the believable number of rows of a file."""
        if encoding == "ascii":
            return 2 * len(self.properties)  # a digit and a separator each
        return sum(np.dtype(p.count_code or p.code).itemsize for p in self.properties)


@dataclass
class Header:
    """A parsed header. `encoding` is one of `FORMATS`; the data begin at byte `size`."""

    encoding: str
    elements: list[Element]
    comments: list[str]
    size: int


def read_header(file: BinaryIO, path: Path) -> Header:
    """Parses the header of an open PLY file and leaves the file at the first byte of the data.

    Raises:
        FormatError: not a PLY file, or a damaged or impossible header; names file, line and reason.
    """
    lines, size = _header_lines(file, path)
    header = Header("", [], [], size)
    for number, line in enumerate(lines[1:], start=2):
        try:
            _parse_line(line, header)
        except (ValueError, IndexError) as error:
            raise FormatError(f"{path}: header line {number} {line[:80]!r}: {error}") from None
    if not header.encoding:
        raise FormatError(f"{path}: the header has no format line")
    _check_sizes(header, file, path)
    return header


def _header_lines(file: BinaryIO, path: Path) -> tuple[list[str], int]:
    """The lines up to `end_header`, and how many bytes they take."""
    lines: list[str] = []
    size = 0
    while size < PlyHeaderTuning.max_header_bytes:
        raw = file.readline(4096)
        size += len(raw)
        line = raw.decode("latin-1").rstrip("\r\n")
        if not lines and line.strip() != "ply":
            raise FormatError(f"{path}: not a PLY file (it begins with {raw[:16]!r}, expected 'ply')")
        if not raw.endswith(b"\n"):
            raise FormatError(f"{path}: the header is cut off or damaged after {size} bytes: no 'end_header' line")
        if line.strip() == "end_header":
            return lines, size
        lines.append(line)
    raise FormatError(f"{path}: no 'end_header' within the first {PlyHeaderTuning.max_header_bytes} bytes")


def _parse_line(line: str, header: Header) -> None:
    words = line.split()
    if not words or words[0] == "obj_info":
        return
    if words[0] == "comment":
        header.comments.append(line.split("comment", 1)[1].strip())
    elif words[0] == "format":
        if header.encoding or words[1] not in FORMATS or words[2] != "1.0":
            raise ValueError(f"expected one format line, one of {list(FORMATS)} and version 1.0")
        header.encoding = words[1]
    elif words[0] == "element":
        name, count = words[1], int(words[2])
        if count < 0 or any(name == other.name for other in header.elements):
            raise ValueError("negative count or element declared twice")
        header.elements.append(Element(name, count))
    elif words[0] == "property":
        _add_property(words[1:], header)
    else:
        raise ValueError("unknown keyword")


def _add_property(words: list[str], header: Header) -> None:
    if not header.elements:
        raise ValueError("property before the first element")
    types = words[1:3] if words[0] == "list" else words[:1]
    unknown = [name for name in types if name not in _READ_CODES]
    if unknown:
        raise ValueError(f"unknown type {unknown[0]!r}")
    if words[0] == "list":
        if _READ_CODES[types[0]].startswith("f"):
            raise ValueError("a list length cannot be a floating-point number")
        added = Property(words[3], _READ_CODES[types[1]], _READ_CODES[types[0]])
    else:
        added = Property(words[1], _READ_CODES[types[0]])
    properties = header.elements[-1].properties
    if any(added.name == other.name for other in properties):
        raise ValueError("property declared twice")
    properties.append(added)


def _check_sizes(header: Header, file: BinaryIO, path: Path) -> None:
    """Refuses counts that the file cannot hold, before memory is asked for."""
    left = path.stat().st_size - header.size + 1  # + 1: the last ASCII value needs no separator
    for element in header.elements:
        if element.count and not element.properties:
            raise FormatError(f"{path}: element '{element.name}' has {element.count} rows but no properties")
        needed = element.count * element.smallest_row(header.encoding)
        if needed > left:
            raise FormatError(
                f"{path}: truncated or damaged: element '{element.name}' claims {element.count} rows "
                f"(at least {needed} bytes), found {max(left - 1, 0)} bytes"
            )
        left -= needed
