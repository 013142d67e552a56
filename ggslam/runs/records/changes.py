# SPDX-License-Identifier: Apache-2.0
"""changes.json: what changed between two visits, as a folder of changes has it."""

from __future__ import annotations

from typing import ClassVar

from ggslam.runs.records.movers import Pose
from ggslam.runs.records.record import Record, RecordFile
from ggslam.scene.oriented_box import OrientedBox


class ChangedSide(Record):
    """A thing as one of the visits has it: ids of the objects that it is, the share of it that the other visit looked
    at and did not find, and a box around it, world of the older run."""

    ids: list[int]
    not_there: float | None = None
    box: OrientedBox | None = None


class ChangeRecord(Record):
    """A change: what happened, to what, how sure; `T_new_old` of what moved, how far its middle went and how far it
    turned; the name of its picture."""

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
    """A thing of which nothing is said, and why; earlier files have no reason: the newer visit hardly looked at it."""

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
