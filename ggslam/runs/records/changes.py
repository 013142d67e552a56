# SPDX-License-Identifier: Apache-2.0
"""changes.json: what changed between two visits, as a folder of changes has it."""

from __future__ import annotations

from typing import ClassVar

from ggslam.runs.records.movers import Pose
from ggslam.runs.records.record import Record, RecordFile
from ggslam.scene.oriented_box import OrientedBox


class ChangedSide(Record):
    """An object as one of the visits has it: its object ids, the share of it that the other visit looked at without
    finding it, and its box in the world of the older run."""

    ids: list[int]
    not_there: float | None = None
    box: OrientedBox | None = None


class ChangeRecord(Record):
    """A change: its kind, object and certainty; `T_new_old` of what moved, with distance and angle; the name of its
    picture."""

    kind: str
    name: str
    confidence: float
    old: ChangedSide | None = None
    new: ChangedSide | None = None
    T_new_old: Pose | None = None
    turn_known: bool | None = None
    moved_m: float | None = None
    turned_deg: float | None = None
    picture: str = ""


class UnseenRecord(Record):
    """An object that cannot be judged, with the reason; without one, the newer visit hardly looked at it."""

    name: str
    ids: list[int]
    reason: str = "hardly looked at by the newer visit"


class ChangesRecord(RecordFile):
    """The file; `old` and `new` are the visits' runs."""

    FILE: ClassVar[str] = "changes.json"
    old: str = ""
    new: str = ""

    changes: list[ChangeRecord] = []
    unseen: list[UnseenRecord] = []
