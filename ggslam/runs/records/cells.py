# SPDX-License-Identifier: Apache-2.0
"""The head of a file with the coded cells of a grid store."""

from __future__ import annotations

import pydantic

from ggslam.runs.records.record import Record
from ggslam.runs.records.run_json import FileRecord
from ggslam.submaps.settings import GridAxes

CELLS_FORMAT, CELLS_VERSION = "ggslam cells", 2


class CellMember(FileRecord):
    """A cell: its Gaussians, and bytes and checksum of its stream; the visit that wrote it last, that its Gaussians are
    from, and when it was recorded, seconds."""

    gaussians: int
    visit: str | None = None
    seen_by: str | None = None
    recorded_at: float | None = None


class CellsRecord(Record):
    """What the file says of itself.

    Attributes:
        format, version: `CELLS_FORMAT`, and that of the layout.
        ggslam: version that wrote it.
        rate: quality of the Gaussians.
        spacing, axes: of the store's grid.
        cells: by member.
        visits: names, oldest first.
        files: the store's objects and what it remembers of visits, by member (version 2).
    """

    format: str
    version: int
    ggslam: str = "unknown"
    rate: str = ""
    spacing: float
    axes: GridAxes
    cells: dict[str, CellMember]
    visits: list[str] = []
    files: dict[str, FileRecord] = {}

    @staticmethod
    def parse(content: bytes) -> CellsRecord:
        """The head in its bytes. Raises ValueError, which says why, if they are none."""
        try:
            found = CellsRecord.model_validate_json(content)
        except pydantic.ValidationError as error:
            first = error.errors()[0]
            raise ValueError(f"{'.'.join(map(str, first['loc']))}: {first['msg']}") from None
        if found.format != CELLS_FORMAT:
            raise ValueError(f"of another format: {found.format[:40]!r}")
        if found.version > CELLS_VERSION:
            raise ValueError(f"of version {found.version}; this ggslam reads up to {CELLS_VERSION}: use a newer one")
        return found
