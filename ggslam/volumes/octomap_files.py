# SPDX-License-Identifier: Apache-2.0
"""OctoMap's files, read and written without OctoMap.

`.bt` holds free and occupied leaves (two bits a child), `.ot` the log-odds of every node (float32). Both are pruned as
OctoMap prunes: eight equal children are one leaf, equal by state in `.bt` and by value in `.ot`. The layout is that of
OctoMap 1.10's AbstractOcTree, AbstractOccupancyOcTree and their classes of nodes.

OctoMap's grid lies around zero and is 65536 voxels wide, so a map in UTM coordinates does not fit. Its files are
counted from its origin, which stands in a comment of the header: `# origin X Y Z`. OctoMap passes over that;
`read_octomap` gives a map in the world again.
"""

from __future__ import annotations

import ctypes
import math
from dataclasses import dataclass
from pathlib import Path
from typing import Final

import numpy as np

from ggslam.errors import FormatError
from ggslam.native.loader import NativeContext, load_library
from ggslam.system.atomic import write_bytes
from ggslam.system.tuning import Tuning
from ggslam.system.untrusted_files import read_untrusted
from ggslam.volumes.occupancy import OccupancyMap
from ggslam.volumes.occupancy_arrays import output_bytes
from ggslam.volumes.occupancy_settings import OccupancySettings, log_odds
from ggslam.volumes.quantization import KeyGridTuning

_BINARY: Final = 0
"""Code of OctoMap's binary format (.bt) in the compiled core."""
_FULL: Final = 1
"""Code of OctoMap's full format (.ot) there."""
_FIRST_LINES = {_BINARY: "# Octomap OcTree binary file", _FULL: "# Octomap OcTree file"}
_COMMENT = "# (feel free to add / change comments, but leave the first line as it is!)\n#\n"
_ORIGIN = "# origin "


class OctomapFileTuning(Tuning):
    """Limits of files that are read."""

    max_header_bytes = 1 << 16
    """Largest header, in bytes."""


_BLOCK_BYTES: Final = 2112
"""Bytes of a block of the compiled core's tree."""
_CUT_OFF: Final = 1
"""The compiled core's code for a file that ends too early."""
_FAULTS = {
    2: "a node of the finest level has children",
    3: "an inner node has no children",
    4: "a leaf's value is not finite",
}
_TOO_LARGE: Final = 5
"""The compiled core's code for a tree above the memory limit."""


@dataclass(frozen=True)
class _Header:
    format: int
    nodes: int
    resolution: float
    size: int
    """Bytes before the tree."""
    origin: np.ndarray
    """Of the grid in the world, [3] metres."""


def read_octomap(
    path: str | Path,
    settings: OccupancySettings | None = None,
    context: NativeContext | None = None,
    memory_limit: int = 8 << 30,
) -> OccupancyMap:
    """The map in a `.bt` or `.ot` file; which of the two is told by its first line.

    Leaves of a `.bt` file get the settings' clamping thresholds as values, as in OctoMap.

    Args:
        path: the file.
        settings: of the map, for later insertions.
        context: threads for the map.
        memory_limit: bytes that the map's blocks may take (a file of a few MB can hold a map of several GB).

    Raises:
        FormatError: the file is missing, of another kind, cut off, damaged or too large; names file and reason.
    """
    path = Path(path)
    return decode_octomap(read_untrusted(path), str(path), settings, context, memory_limit)


def decode_octomap(
    data: bytes,
    name: str,
    settings: OccupancySettings | None = None,
    context: NativeContext | None = None,
    memory_limit: int = 8 << 30,
) -> OccupancyMap:
    """The map in the bytes of a `.bt` or `.ot` file; `name` stands for the file in messages, see `read_octomap`."""
    header = _read_header(data, name)
    result = OccupancyMap(header.resolution, settings, context, header.origin)
    if header.nodes == 0:
        return result
    tree = np.frombuffer(data, np.uint8, offset=header.size)
    nodes = ctypes.c_uint64()
    limits = (result.settings.probability_minimum, result.settings.probability_maximum)
    fault = load_library().ggslam_occupancy_read(
        result.handle, header.format, tree.ctypes.data, len(tree), *map(log_odds, limits),
        max(1, memory_limit // _BLOCK_BYTES), ctypes.byref(nodes),
    )  # fmt: skip
    if fault == _CUT_OFF:
        raise FormatError(f"{name}: cut off or damaged: the tree of {header.nodes} nodes ends after {nodes.value}")
    if fault == _TOO_LARGE:
        raise FormatError(f"{name}: the map needs more than the {memory_limit / 2**30:.1f} GiB allowed")
    if fault:
        raise FormatError(f"{name}: damaged: {_FAULTS[fault]}")
    if nodes.value != header.nodes:
        raise FormatError(f"{name}: damaged: the header tells {header.nodes} nodes, the tree has {nodes.value}")
    return result


def write_octomap(occupancy: OccupancyMap, path: str | Path) -> None:
    """Writes a map as `.bt` or `.ot`, by the ending of `path`, atomically.

    Raises:
        FormatError: another ending.
        RunFolderError: the file cannot be written.
    """
    path = Path(path)
    formats = {".bt": _BINARY, ".ot": _FULL}
    if path.suffix.lower() not in formats:
        raise FormatError(f"{path}: expected the ending .bt (free or occupied) or .ot (log-odds)")
    write_bytes(path, _encode(occupancy, formats[path.suffix.lower()]))


def binary_octomap(occupancy: OccupancyMap) -> bytes:
    """The map as the bytes of a `.bt` file."""
    return _encode(occupancy, _BINARY)


def full_octomap(occupancy: OccupancyMap) -> bytes:
    """The map as the bytes of an `.ot` file."""
    return _encode(occupancy, _FULL)


def _encode(occupancy: OccupancyMap, kind: int) -> bytes:
    nodes = ctypes.c_uint64()
    size = load_library().ggslam_occupancy_write(
        occupancy.handle, kind, occupancy.settings.threshold, ctypes.byref(nodes)
    )
    tree = output_bytes(occupancy.handle, size)
    origin = ""
    if occupancy.origin.any():
        origin = f"{_ORIGIN}{' '.join(repr(float(value)) for value in occupancy.origin)}\n"
    numbers = f"id OcTree\nsize {nodes.value}\nres {occupancy.resolution!r}\ndata\n"
    return f"{_FIRST_LINES[kind]}\n{_COMMENT}{origin}{numbers}".encode() + tree


def _read_header(data: bytes, name: str) -> _Header:
    first_line = data[:64].split(b"\n", 1)[0].decode("latin-1").rstrip()
    kind = next((kind for kind, line in _FIRST_LINES.items() if line == first_line), None)
    if kind is None:
        raise FormatError(f"{name}: no OctoMap file: the first line should be {' or '.join(_FIRST_LINES.values())!r}")
    end = data.find(b"\ndata\n", 0, OctomapFileTuning.max_header_bytes)
    if end < 0:
        raise FormatError(f"{name}: the header has no line 'data': cut off or damaged")
    fields, origin = {}, np.zeros(3)
    for line in data[:end].decode("latin-1").splitlines():
        if line.startswith(_ORIGIN):
            origin = _place(line, name)
        elif not line.startswith("#") and line.strip():
            key, _, value = line.strip().partition(" ")
            fields[key] = value.strip()
    if fields.get("id") != "OcTree":
        raise FormatError(f"{name}: expected a map of kind OcTree, found {fields.get('id', 'none')!r}")
    nodes, resolution = _number(fields, "size", name), _number(fields, "res", name)
    low, high = KeyGridTuning.resolution_range
    if not low <= resolution <= high:
        raise FormatError(f"{name}: res: expected {low:g} to {high:g} m, found {fields['res']}")
    if nodes < 0 or nodes != int(nodes):
        raise FormatError(f"{name}: size: expected a number of nodes, found {fields['size']}")
    return _Header(kind, int(nodes), resolution, end + len(b"\ndata\n"), origin)


def _place(line: str, name: str) -> np.ndarray:
    """The origin in a comment of the header; a comment of words that begins so is none."""
    try:
        origin = np.array([float(word) for word in line[len(_ORIGIN) :].split()])
    except ValueError:
        return np.zeros(3)
    if len(origin) != 3 or not np.isfinite(origin).all():
        raise FormatError(f"{name}: {line!r}: expected three finite numbers of metres")
    return origin


def _number(fields: dict[str, str], key: str, name: str) -> float:
    try:
        value = float(fields[key])
    except KeyError:
        raise FormatError(f"{name}: the header has no line {key!r}") from None
    except ValueError:
        value = math.nan
    if not math.isfinite(value):
        raise FormatError(f"{name}: {key}: expected a number, found {fields[key]!r}")
    return value
