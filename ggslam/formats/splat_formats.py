# SPDX-License-Identifier: Apache-2.0
"""The table of the formats that maps of Gaussians are read from: which file is of which, and who reads it.

All readers give maps in the axes that 3DGS files of cameras have, y down and z forward; formats whose descriptions put
y upwards are turned. Gaussians that cannot be drawn are left out, with a note; see `splat_repair`.
"""

from __future__ import annotations

import json
import struct
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path

from ggslam.errors import FormatError
from ggslam.formats.compressed_ply_reading import PACKED, read_compressed_ply
from ggslam.formats.foreign_ply import ForeignGaussianRows
from ggslam.formats.gaussian_gltf_reading import EXTENSION, read_gaussian_gltf
from ggslam.formats.gaussian_rows import GaussianRows, GaussiansInMemory
from ggslam.formats.gaussian_usd import USD_ENDINGS
from ggslam.formats.gaussian_usd_reading import read_gaussian_usd
from ggslam.formats.ply_header import read_header
from ggslam.formats.sog import META
from ggslam.formats.sog_reading import LEVELS, read_sog, read_streamed_sog
from ggslam.formats.splat_columns import SplatColumns
from ggslam.formats.splat_file import read_splat
from ggslam.formats.splat_repair import SplatFaults, map_of_columns, mend
from ggslam.formats.spz_reading import read_spz
from ggslam.scene.gaussian_map import GaussianMap
from ggslam.system.foreign import open_foreign
from ggslam.system.zip_files import ZIP_DAMAGE, open_zip

Names = dict[int, str]
"""Names of objects by id, empty where an object has none."""


@dataclass(frozen=True)
class SplatFile:
    """A map of Gaussians in a file of another program, or in one that `ggslam export` wrote.

    Attributes:
        format: name of the format, for people.
        rows: the Gaussians, in memory or on disk.
        names: of objects by id; None: the file has no object ids.
        notes: what the user should know: what was left out, bounded or changed.
    """

    format: str
    rows: GaussianRows
    names: Names | None = None
    notes: list[str] = field(default_factory=list)


@dataclass(frozen=True)
class SplatFormat:
    """A format: its name for people, whether a file is of it by its name and first bytes, and its reader."""

    name: str
    is_of: Callable[[Path, bytes], bool]
    open: Callable[[Path], SplatFile]


def _in_memory(name: str, read: Callable[[Path], SplatColumns | tuple[SplatColumns, Names | None]]) -> SplatFormat:
    """A format that is read as a whole; `is_of` is set by the table."""

    def open_file(path: Path) -> SplatFile:
        found = read(path)
        columns, names = (found, None) if isinstance(found, SplatColumns) else found
        faults = SplatFaults()
        keep = mend(columns, faults)
        gaussians = map_of_columns(columns if keep.all() else columns.take(keep.nonzero()[0]))
        return SplatFile(name, GaussiansInMemory(path, gaussians), names, faults.notes())

    return SplatFormat(name, lambda path, head: False, open_file)


def _rows_of_ply(path: Path) -> SplatFile:
    rows = ForeignGaussianRows(path)
    return SplatFile("3DGS PLY", rows, {} if rows.has_ids else None, rows.notes())


def _properties(path: Path, head: bytes) -> set[str]:
    """Names of the properties of a PLY's vertices; empty: it is none, or has none.

    Raises:
        FormatError: it is a PLY that is cut off or damaged.
    """
    if head[:3] != b"ply":
        return set()
    with open_foreign(path) as file:
        elements = {element.name: element for element in read_header(file, path).elements}
    return {p.name for p in elements["vertex"].properties} if "vertex" in elements else set()


def _is_zip_with(path: Path, head: bytes, *endings: str) -> bool:
    if head[:2] != b"PK":
        return False
    try:
        with open_zip(path) as archive:
            return any(name.lower().endswith(endings) for name in archive.namelist())
    except (*ZIP_DAMAGE, FormatError):
        return False


def _is_gltf_of_splats(path: Path, head: bytes) -> bool:
    """Whether the JSON part of a glTF names the extension: one without it is a mesh."""
    if head[:4] != b"glTF" and path.suffix.lower() != ".gltf":
        return False
    try:
        with open_foreign(path) as file:
            length = struct.unpack_from("<I", file.read(20), 12)[0] if head[:4] == b"glTF" else 0
            file.seek(20 if head[:4] == b"glTF" else 0)
            text = file.read(min(length, 64 << 20) if length else 64 << 20)
        return EXTENSION in json.loads(text).get("extensionsUsed", []) or EXTENSION.encode() in text
    except (OSError, ValueError, AttributeError, struct.error, RecursionError, FormatError):
        return False


def _is(table: SplatFormat, is_of: Callable[[Path, bytes], bool]) -> SplatFormat:
    return SplatFormat(table.name, is_of, table.open)


SPLAT_FORMATS = (
    SplatFormat(
        "3DGS PLY", lambda path, head: {"scale_0", "scale_1", "rot_0", "opacity"} <= _properties(path, head),
        _rows_of_ply,
    ),
    _is(_in_memory("compressed PLY", read_compressed_ply),
        lambda path, head: set(PACKED) <= _properties(path, head)),
    _is(_in_memory("SOG", read_sog),
        lambda path, head: path.name.lower() == META or path.suffix.lower() == ".sog"
        or _is_zip_with(path, head, META) and path.suffix.lower() not in USD_ENDINGS),
    _is(_in_memory("streamed SOG", read_streamed_sog), lambda path, head: path.name.lower() == LEVELS),
    _is(_in_memory("SPZ", read_spz), lambda path, head: path.suffix.lower() == ".spz" or head[:4] == b"NGSP"),
    _is(_in_memory("glTF", read_gaussian_gltf), _is_gltf_of_splats),
    _is(_in_memory("OpenUSD", read_gaussian_usd),
        lambda path, head: path.suffix.lower() in USD_ENDINGS or head.startswith((b"#usda ", b"PXR-USDC"))),
    _is(_in_memory(".splat", read_splat), lambda path, head: path.suffix.lower() == ".splat"),
)  # fmt: skip
"""All formats. The first that a file is of reads it."""


def splat_format(path: str | Path) -> SplatFormat | None:
    """The format of a file, or of a folder that holds a `meta.json` or `lod-meta.json`; None: it is no map of others.

    Nothing is raised: a file that cannot be opened is none.
    """
    found = _file_of(Path(path))
    if found is None:
        return None
    try:
        with open_foreign(found) as file:
            head = file.read(16)
    except (FormatError, OSError):
        return None
    return next((format for format in SPLAT_FORMATS if format.is_of(found, head)), None)


def open_splats(path: str | Path) -> SplatFile:
    """Opens a map of Gaussians that any of these formats holds; a 3DGS PLY is read as far as it is asked for.

    Raises:
        FormatError: it is of no such format, damaged, or holds no Gaussian that can be drawn.
        MissingDependency: a package is needed to read it.
    """
    known = splat_format(path)
    if known is None:
        names = ", ".join(format.name for format in SPLAT_FORMATS)
        raise FormatError(f"{path}: no Gaussians in a format that is known: {names}")
    opened = known.open(_file_of(Path(path)) or Path(path))
    if not len(opened.rows):
        reason = f" ({'; '.join(opened.notes)})" if opened.notes else ""
        raise FormatError(f"{path}: holds no Gaussian that can be drawn{reason}")
    return opened


def read_splats(path: str | Path) -> GaussianMap:
    """The map in a file of any of these formats, in memory, without optimizer state; see `open_splats`."""
    rows = open_splats(path).rows
    return rows.read(0, len(rows))


def _file_of(path: Path) -> Path | None:
    """The file itself, or the index in a folder."""
    if not path.is_dir():
        return path
    return next((path / name for name in (META, LEVELS) if (path / name).is_file()), None)
