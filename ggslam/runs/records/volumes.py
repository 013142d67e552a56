# SPDX-License-Identifier: Apache-2.0
"""`volumes.json`: what `ggslam volumes` wrote."""

from __future__ import annotations

from typing import ClassVar

from ggslam.runs.records.record import RecordFile


class VolumesRecord(RecordFile):
    """Names of the files, and, as further fields, what is in them: sizes, counts, times."""

    FILE: ClassVar[str] = "volumes.json"
    files: tuple[str, ...]
