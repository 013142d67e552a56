# SPDX-License-Identifier: Apache-2.0
"""Reads and writes maps of Gaussians in any format of `formats.table`."""

from __future__ import annotations

from pathlib import Path

from ggslam.errors import FormatError
from ggslam.formats.splat_reader import Names, SplatFile, SplatReader
from ggslam.formats.table import readers, splat_writer
from ggslam.formats.writer import Splats
from ggslam.scene.gaussian_map import GaussianMap
from ggslam.system.untrusted_files import open_untrusted


def splat_format(path: str | Path) -> SplatReader | None:
    """The format of a file, or of a folder that holds a `meta.json` or `lod-meta.json`; None: it is no map of others.

    Nothing is raised: a file that cannot be opened is none.
    """
    found = _file_of(Path(path))
    if found is None:
        return None
    try:
        with open_untrusted(found) as file:
            head = file.read(16)
    except (FormatError, OSError):
        return None
    return next((known for known in readers() if known.is_of(found, head)), None)


def open_splats(path: str | Path) -> SplatFile:
    """Opens a map of Gaussians that any of these formats holds; a 3DGS PLY is read as far as it is asked for.

    Raises:
        FormatError: it is of no such format, damaged, or holds no Gaussian that can be drawn.
        MissingDependency: a package is needed to read it.
    """
    known = splat_format(path)
    if known is None:
        names = ", ".join(reader.name for reader in readers())
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
    indices = (name for reader in readers() for name in reader.indices)
    return next((path / name for name in indices if (path / name).is_file()), None)


def write_splats(path: str | Path, gaussians: GaussianMap, names: Names | None = None) -> None:
    """Writes a map, whole or not at all.

    Args:
        path: the file; its name says the format.
        gaussians: at least one.
        names: of objects by id, empty where one has none; None: no object ids are written.

    Raises:
        ConfigError: no format is called so.
        FormatError: what the format cannot hold.
        MissingDependency: a package is needed to write it.
        RunFolderError: the file cannot be written.
    """
    splat_writer(path).write(Path(path), Splats.of(gaussians, names))
