# SPDX-License-Identifier: Apache-2.0
"""Some rows of a binary PLY file, without reading the rest."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from ggslam.errors import FormatError
from ggslam.formats.ply_header import FORMATS, read_header
from ggslam.system.untrusted_files import open_untrusted


class PlyRows:
    """The rows of the first element of a binary PLY file without lists.

    Args:
        path: the file.
        element: name that the first element must have.

    Raises:
        FormatError: no such file; the file is cut off, ASCII, has another first element or one with lists.
    """

    def __init__(self, path: Path, element: str) -> None:
        self.path = path
        try:
            with open_untrusted(path) as file:
                header = read_header(file, path)
        except OSError as error:
            raise FormatError(f"cannot read {path}: {error.strerror or error}") from error
        order = FORMATS[header.encoding]
        first = header.elements[0] if header.elements else None
        if first is None or first.name != element or first.has_lists or not order:
            raise FormatError(f"{path}: expected a binary file whose first element is '{element}', without lists")
        self.count = first.count
        """Rows there are."""
        self.comments = header.comments
        self._begin = header.size
        self._stored = np.dtype([(p.name, order + p.code) for p in first.properties])

    def read(self, start: int, count: int) -> np.ndarray:
        """Rows start to start + count as a structured array in native byte order.

        Raises:
            FormatError: the file cannot be read, or is shorter now.
        """
        try:
            offset = self._begin + start * self._stored.itemsize
            with open_untrusted(self.path) as file:
                file.seek(offset)
                rows = np.fromfile(file, self._stored, count)
        except OSError as error:
            raise FormatError(f"cannot read {self.path}: {error.strerror or error}") from error
        if len(rows) < count:
            raise FormatError(f"{self.path}: truncated: expected rows {start} to {start + count}")
        return rows.astype(self._stored.newbyteorder("="), copy=False)
