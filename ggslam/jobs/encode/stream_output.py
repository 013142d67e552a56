# SPDX-License-Identifier: Apache-2.0
"""Where a coded file may be written: it replaces nothing but a coded file of its kind."""

from __future__ import annotations

import os
from collections.abc import Iterable
from pathlib import Path
from typing import Final

from ggslam.coding.container import HEADER, UnitType
from ggslam.coding.sequence_parameters import SequenceParameters
from ggslam.errors import ConfigError, FormatError
from ggslam.jobs.encode.coded_cells import HEAD as CELLS_HEAD
from ggslam.jobs.encode.coded_cells import is_cells_file
from ggslam.runs.folder import RunFolder
from ggslam.runs.map_container import HEAD as MAP_HEAD
from ggslam.runs.map_container import is_container
from ggslam.runs.output_files import lies_among
from ggslam.system.atomic import reason_of
from ggslam.system.untrusted_files import open_untrusted
from ggslam.system.zip_files import ZIP_DAMAGE, open_zip

_MOST_PARAMETERS: Final = 1 << 16
"""Bytes that a sequence parameter set may have."""


def check_stream_output(out: Path, sources: Iterable[Path] = (), option: str = "") -> bool:
    """Whether there is a coded file already that would be replaced.

    Args:
        out: file to write; its name says of what kind it is.
        sources: folders of the runs and recordings that it is made of.
        option: what the file is called in messages.

    Raises:
        ConfigError: there is something else, or the place belongs to a run or recording.
        RunFolderError: the folder cannot be written to.
    """
    name = f"{option}{out}"
    try:
        if out.is_dir():
            raise ConfigError(f"{name}: is a folder; name a file")
        there = out.exists()
        if lies_among(out, sources):
            raise ConfigError(f"{name}: lies in the folder of a run or recording; choose another place")
        if there and not (out.is_file() and _is_coded(out)):
            raise ConfigError(f"{name}: is there already, and no coded file of this kind; choose another name")
        folder = out.resolve().parent
        while not folder.exists():
            folder = folder.parent
        if not folder.is_dir():
            raise ConfigError(f"{name}: {folder} is no folder")
    except OSError as error:
        raise ConfigError(f"{name}: cannot be written: {reason_of(error)}") from None
    RunFolder(folder).check_writable()
    return there


def _is_coded(path: Path) -> bool:
    """Whether a file is of the kind that its name says."""
    if is_container(path):
        return _holds(path, MAP_HEAD)
    return _holds(path, CELLS_HEAD) if is_cells_file(path) else _begins_a_stream(path)


def _holds(path: Path, member: str) -> bool:
    """Whether a file is an archive with this member."""
    try:
        with open_zip(path) as archive:
            return member in archive.namelist()
    except (FormatError, *ZIP_DAMAGE):
        return False


def _begins_a_stream(path: Path) -> bool:
    """Whether a file begins with the sequence parameters of a G-PCC stream."""
    try:
        with open_untrusted(path) as file:
            head = file.read(HEADER.size)
            kind, length = HEADER.unpack(head) if len(head) == HEADER.size else (None, 0)
            left = os.fstat(file.fileno()).st_size - HEADER.size
            if kind != UnitType.SEQUENCE_PARAMETERS or length > min(left, _MOST_PARAMETERS):
                return False
            SequenceParameters.read(file.read(length))
    except FormatError:
        return False
    return True
