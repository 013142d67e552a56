# SPDX-License-Identifier: Apache-2.0
"""Changes with names, boxes and evidence, as changes.json holds them."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict
from typing import Any, Final

import numpy as np

from ggslam.changes.candidates import Candidate, JudgedSurface
from ggslam.changes.change import Change, Detection
from ggslam.objects.boxes import oriented_box
from ggslam.scene.object_names import object_label
from ggslam.scene.oriented_box import OrientedBox
from ggslam.scene.poses import motion_of

VERSION: Final = 1
"""Version of changes.json."""
Names = Mapping[int, str | None]
"""Of objects, by id."""


class ChangeTable:
    """Detected changes, for files and people.

    Args:
        found: the changes.
        judged: surfaces of the older and the newer visit.
        names: of their objects.
    """

    def __init__(self, found: Detection, judged: list[JudgedSurface], names: tuple[Names, Names]) -> None:
        self.found, self._judged, self._names = found, judged, names

    def label(self, change: Change) -> str:
        """For people: the name and id of what changed."""
        for thing, names in zip((change.old, change.new), self._names, strict=True):
            for i in () if thing is None else thing.ids:
                return object_label(i, names.get(i))
        return "something without an id"

    def box(self, change: Change, number: int) -> OrientedBox | None:
        """Around what changed in the older (0) or newer (1) visit, in the older one's world; None: it is not there."""
        points = self.points(change, number)
        return oriented_box(points) if len(points) else None

    def points(self, change: Change, number: int) -> np.ndarray:
        """Its surface, float64 [n, 3], in the older visit's world."""
        thing = (change.old, change.new)[number]
        return np.zeros((0, 3)) if thing is None else self._judged[number].points[thing.rows]

    def motion(self, change: Change) -> tuple[float, float]:
        """How far the middle of what moved went, metres, and by how many degrees it turned."""
        assert change.T_new_old is not None
        return motion_of(change.T_new_old, self.points(change, 0).mean(0))

    def to_dict(self) -> dict[str, Any]:
        """For JSON."""
        found = self.found
        return {
            "version": VERSION, "ids_believed": found.ids_believed, "stayed": found.stayed,
            "tolerance": {"metres": found.tolerance.least, "share": found.tolerance.share},
            "changes": [self._entry(change) for change in found.changes],
            "unseen": [
                {"name": self.label(c), "ids": list(c.old.ids) if c.old else [], "reason": c.reason}
                for c in found.unseen
            ],
            "notes": found.notes,
        }  # fmt: skip

    def _entry(self, change: Change) -> dict[str, Any]:
        entry: dict[str, Any] = {"kind": change.kind, "name": self.label(change), "confidence": change.confidence}
        for number, (word, thing) in enumerate((("old", change.old), ("new", change.new))):
            entry[word] = None if thing is None else self._side(change, number, thing)
        if change.T_new_old is not None and change.fit is not None:
            entry["moved_m"], entry["turned_deg"] = self.motion(change)
            entry["T_new_old"] = change.T_new_old.tolist()
            entry["turn_known"] = change.fit.turn_known
            if not change.fit.turn_known:
                entry["turn_reason"] = change.fit.turn_reason
            entry["fit"] = {k: v for k, v in asdict(change.fit).items() if k != "T_new_old"}
        return entry

    def _side(self, change: Change, number: int, thing: Candidate) -> dict[str, Any]:
        box = self.box(change, number)
        return {
            "ids": list(thing.ids), "points": len(thing), "seen_by_other": thing.seen, "not_there": thing.changed,
            "color_apart": thing.color_apart if np.isfinite(thing.color_apart) else None,
            "box": None if box is None else asdict(box),
        }  # fmt: skip
