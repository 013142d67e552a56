# SPDX-License-Identifier: Apache-2.0
"""The section of a page on changes between two visits and the history of objects."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from ggslam.jobs.changes.saved_changes import ChangesShown, motion_words, word_of_kind
from ggslam.objects.history import History, ObjectPast
from ggslam.reporting import page as p
from ggslam.reporting.page import Html
from ggslam.runs.records.changes import ChangeRecord
from ggslam.scene.object_names import object_label
from ggslam.scene.oriented_box import Vector
from ggslam.scene.poses import inverse, motion_of, transform_points

_HEAD = ("what", "happened", "moved by, cm", "turned, deg", "not there any more, %", "new there, %", "confidence")
_WORDS = (
    "Moved by: of the middle of its surface. A turn is told where one way round fits clearly better than all others. "
    "Not there any more: share of the surface of the older visit that the newer one looked at and did not find; new "
    "there: of the surface of the newer visit that the older one did not find."
)
_PAST = ("what", "first seen", "last seen", "gone since", "against where it was first seen")


def changes_part(shown: ChangesShown) -> Html:
    """A table of changes, pictures, what was not seen, and the objects' past."""
    record, parts = shown.record, list[Html]()
    if record.old and record.new:
        parts.append(p.tag("p", f"From {record.old} to {record.new}."))
    if record.changes:
        parts += [p.table(_HEAD, map(_row, record.changes), text_columns=(1,)), p.tag("p", _WORDS, class_="note")]
    else:
        parts.append(p.tag("p", "Nothing was found that changed."))
    for reason in dict.fromkeys(thing.reason for thing in record.unseen):
        names = ", ".join(thing.name for thing in record.unseen if thing.reason == reason)
        parts.append(p.tag("p", f"{reason.capitalize()}, so that nothing is said of them: {names}."))
    if shown.pictures:
        words = "The older visit on the left, the newer one on the right; red: where it was, green: where it is."
        named = [(f"{record.changes[k].name}: {word_of_kind(record.changes[k])}", v) for k, v in shown.pictures.items()]
        parts += [p.tag("p", words, class_="note"), p.cells(named, 2)]
    if shown.left_out:
        words = f"{shown.left_out} more changes have pictures that are not shown here."
        parts.append(p.tag("p", words, class_="note"))
    if shown.unreadable:
        words = f"Pictures that are missing or damaged: {', '.join(shown.unreadable)}."
        parts.append(p.tag("p", words, class_="note"))
    if shown.history is not None and len(shown.history.visits) > 1:
        parts.append(_history_part(shown.history, shown.middles))
    return p.join(parts)


def _row(change: ChangeRecord) -> list[str]:
    shares = ["-" if side is None or side.not_there is None else f"{100 * side.not_there:.0f}"
              for side in (change.old, change.new)]  # fmt: skip
    return [change.name, word_of_kind(change), *motion_words(change), *shares, f"{change.confidence:.2f}"]


def _history_part(history: History, middles: dict[int, Vector]) -> Html:
    visits = [f"{number + 1}: {Path(visit.run).name}" for number, visit in enumerate(history.visits)]
    rows = [_past(past, middles.get(past.id)) for past in history.objects]
    return p.join([
        p.tag("h3", "Objects from visit to visit"), p.tag("p", "Visits: " + ", ".join(visits) + "."),
        p.table(_PAST, rows, sorts=True, text_columns=(4,)),
    ])  # fmt: skip


def _past(past: ObjectPast, middle: Vector | None) -> list[str]:
    """A row; visits are counted from one. `middle`: where the object is now; None: it is gone."""
    steps = [
        f"visit {number + 1}: {_whereabouts(past, number, middle)}"
        for number in sorted(past.T_now_first) if number != past.first_seen
    ]  # fmt: skip
    gone = "-" if past.gone_since is None else str(past.gone_since + 1)
    name = object_label(past.id, past.name)
    return [name, str(past.first_seen + 1), str(past.last_seen + 1), gone, "; ".join(steps) or "-"]


def _whereabouts(past: ObjectPast, number: int, middle: Vector | None) -> str:
    T = np.array(past.T_now_first[number])
    if np.allclose(T, np.eye(4), atol=1e-6):
        return "there"
    if middle is None:  # a motion's length is that of a place, and the place is not known any more
        return "elsewhere"
    at_first = transform_points(np.array([middle]), inverse(np.array(past.T_now_first[max(past.T_now_first)])))[0]
    return f"{100 * motion_of(T, at_first)[0]:.1f} cm away"
