# SPDX-License-Identifier: Apache-2.0
"""container.json: what is in a run's container, see `runs.map_container`."""

from __future__ import annotations

from typing import Final

import pydantic

from ggslam.runs.records.record import Record
from ggslam.runs.records.run_json import FileRecord

CONTAINER_FORMAT = "ggslam map"
CONTAINER_VERSION: Final = 2
"""Version of the format of map containers."""


class ContainerRecord(Record):
    """The head of a container.

    Attributes:
        format, version: `CONTAINER_FORMAT`, and that of the layout.
        ggslam: version that wrote it.
        gaussians: of its map.
        rate: quality of the map.
        files: its other members.
    """

    format: str
    version: int
    ggslam: str = "unknown"
    gaussians: int = 0
    rate: str = ""
    files: dict[str, FileRecord]

    @staticmethod
    def parse(content: bytes) -> ContainerRecord:
        """The head in its bytes.

        Raises:
            ValueError: they are none; says why.
        """
        try:
            found = ContainerRecord.model_validate_json(content)
        except pydantic.ValidationError as error:
            first = error.errors()[0]
            raise ValueError(f"{'.'.join(map(str, first['loc']))}: {first['msg']}") from None
        if found.format != CONTAINER_FORMAT:
            raise ValueError(f"of another format: {found.format[:40]!r}")
        return found
