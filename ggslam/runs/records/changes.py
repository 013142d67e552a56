# SPDX-License-Identifier: Apache-2.0
"""changes.json: what changed between two visits, as a folder of changes has it."""

from __future__ import annotations

from typing import Any, ClassVar

from ggslam.runs.records.record import Record, RecordFile


class ChangedSide(Record):
    """A thing as one of the visits has it: ids of the objects that it is."""

    ids: list[int]


class ChangeRecord(Record):
    """A change: what happened, to what, how sure; `T_new_old` of what moved."""

    kind: str
    name: str
    confidence: float
    old: ChangedSide | None = None
    new: ChangedSide | None = None
    T_new_old: Any = None
    turn_known: bool | None = None


class UnseenRecord(Record):
    """A thing that the newer visit hardly looked at."""

    name: str
    ids: list[int]


class ChangesRecord(RecordFile):
    """The file."""

    FILE: ClassVar[str] = "changes.json"

    changes: list[ChangeRecord] = []
    unseen: list[UnseenRecord] = []
