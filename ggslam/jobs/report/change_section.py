# SPDX-License-Identifier: Apache-2.0
"""The part of an updated run's report that tells what changed between its visits, and what became of its objects."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import cv2
import numpy as np

from ggslam.jobs.report.run_data import ChangesShown
from ggslam.objects.history import History, ObjectPast
from ggslam.reporting import page as p
from ggslam.reporting.page import Html
from ggslam.runs.folder import RunFolder
from ggslam.runs.records.changes import ChangeRecord, ChangesRecord
from ggslam.runs.writing import CHANGES_FOLDER
from ggslam.scene.object_names import object_label

MOST = 12
"""Pictures that are shown."""
_HEAD = ("what", "happened", "moved by, cm", "turned, deg", "not there any more, %", "new there, %", "confidence")
_WORDS = (
    "Moved by: of the middle of its surface. A turn is told where one way round fits clearly better than all others. "
    "Not there any more: share of the surface of the older visit that the newer one looked at and did not find; new "
    "there: of the surface of the newer visit that the older one did not find."
)
_PAST = ("what", "first seen", "last seen", "gone since", "against where it was first seen")


def changes_of(folder: RunFolder) -> ChangesShown | None:
    """What `ggslam update` noted in a run's folder; None: it is no updated run.

    Raises:
        RunFolderError, FormatError: a file is damaged.
    """
    place = folder.path / CHANGES_FOLDER
    record = ChangesRecord.read_if_there(place)
    if record is None:
        return None
    history = folder.object_table().history if folder.has_objects() else None
    return ChangesShown(record, _pictures(place, record.changes), history)


def _pictures(place: Path, changes: Sequence[ChangeRecord]) -> list[tuple[str, np.ndarray]]:
    found = []
    for change in [c for c in changes if c.picture][:MOST]:
        picture = cv2.imread(str(place / Path(change.picture).name), cv2.IMREAD_COLOR)
        if picture is not None:  # without it the table still tells
            found.append((f"{change.name}: {_kind_of(change)}", np.ascontiguousarray(picture[..., ::-1])))
    return found


def changes_part(shown: ChangesShown) -> Html:
    """A table of changes, pictures, what was not seen, and the objects' past."""
    record, parts = shown.record, list[Html]()
    if record.old and record.new:
        parts.append(p.tag("p", f"From {record.old} to {record.new}."))
    if record.changes:
        parts += [p.table(_HEAD, map(_row, record.changes), text_columns=(1,)), p.tag("p", _WORDS, class_="note")]
    else:
        parts.append(p.tag("p", "Nothing was found that changed."))
    if record.unseen:
        names = ", ".join(u.name for u in record.unseen)
        parts.append(p.tag("p", f"Hardly looked at by the newer visit, so that nothing is said of them: {names}."))
    if shown.pictures:
        words = "The older visit on the left, the newer one on the right; red: where it was, green: where it is."
        parts += [p.tag("p", words, class_="note"), p.cells(shown.pictures, 2)]
    if shown.history is not None and len(shown.history.visits) > 1:
        parts.append(_history_part(shown.history))
    return p.join(parts)


def _kind_of(change: ChangeRecord) -> str:
    return "changed its look" if change.kind == "look" else change.kind


def _row(change: ChangeRecord) -> list[str]:
    by = turned = "-"
    if change.moved_m is not None and change.turned_deg is not None:
        by = f"{100 * change.moved_m:.1f}"
        turned = f"{change.turned_deg:.1f}" if change.turn_known else "not known"
    shares = ["-" if side is None or side.not_there is None else f"{100 * side.not_there:.0f}"
              for side in (change.old, change.new)]  # fmt: skip
    return [change.name, _kind_of(change), by, turned, *shares, f"{change.confidence:.2f}"]


def _history_part(history: History) -> Html:
    visits = [f"{number + 1}: {Path(visit.run).name}" for number, visit in enumerate(history.visits)]
    rows = [_past(past) for past in history.objects]
    return p.join([
        p.tag("h3", "Objects from visit to visit"), p.tag("p", "Visits: " + ", ".join(visits) + "."),
        p.table(_PAST, rows, sorts=True, text_columns=(4,)),
    ])  # fmt: skip


def _past(past: ObjectPast) -> list[str]:
    """A row; visits are counted from one."""
    steps = []
    for number, T in sorted(past.T_now_first.items()):
        if number == past.first_seen:
            continue
        moved = not np.allclose(np.array(T), np.eye(4), atol=1e-6)
        steps.append(f"visit {number + 1}: {'elsewhere' if moved else 'there'}")
    gone = "-" if past.gone_since is None else str(past.gone_since + 1)
    name = object_label(past.id, past.name)
    return [name, str(past.first_seen + 1), str(past.last_seen + 1), gone, "; ".join(steps) or "-"]
