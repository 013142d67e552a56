# SPDX-License-Identifier: Apache-2.0
"""What a format declares to be read: which files are of it, and how they are opened.

All readers give maps in the axes that 3DGS files of cameras have, y down and z forward; formats whose descriptions put
y upwards are turned. Gaussians that cannot be drawn are left out, with a note; see `splat_repair`.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path

from ggslam.formats.gaussian_rows import GaussianRows, GaussiansInMemory
from ggslam.formats.ply_header import read_header
from ggslam.formats.splat_columns import SplatColumns
from ggslam.formats.splat_repair import SplatFaults, map_of_columns, mend
from ggslam.system.untrusted_files import open_untrusted

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
class SplatReader:
    """A format: its name for people, whether a file is of it by its name and first bytes, how a file is opened, and
    names of the file that a folder of the format holds."""

    name: str
    is_of: Callable[[Path, bytes], bool]
    open: Callable[[Path], SplatFile]
    indices: tuple[str, ...] = ()


def read_whole(
    name: str, is_of: Callable[[Path, bytes], bool],
    read: Callable[[Path], SplatColumns | tuple[SplatColumns, Names | None]], indices: tuple[str, ...] = (),
    notes: Callable[[Path], list[str]] = lambda path: [],
) -> SplatReader:  # fmt: skip
    """A format that is read as a whole: `read` gives the columns, and the names of objects where there are ids;
    `notes` what the user should know of a file that can be read."""

    def open_file(path: Path) -> SplatFile:
        found = read(path)
        columns, names = (found, None) if isinstance(found, SplatColumns) else found
        faults = SplatFaults()
        keep = mend(columns, faults)
        gaussians = map_of_columns(columns if keep.all() else columns.take(keep.nonzero()[0]))
        return SplatFile(name, GaussiansInMemory(path, gaussians), names, [*notes(path), *faults.notes()])

    return SplatReader(name, is_of, open_file, indices)


def properties_of_ply(path: Path, head: bytes) -> set[str]:
    """Names of the properties of a PLY's vertices; empty: it is none, or has none.

    Raises:
        FormatError: it is a PLY that is cut off or damaged.
    """
    if head[:3] != b"ply":
        return set()
    with open_untrusted(path) as file:
        elements = {element.name: element for element in read_header(file, path).elements}
    return {p.name for p in elements["vertex"].properties} if "vertex" in elements else set()
