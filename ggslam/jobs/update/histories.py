# SPDX-License-Identifier: Apache-2.0
"""The history of objects after an update."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from ggslam.changes.change import Detection
from ggslam.jobs.merge.sources import MergeSource
from ggslam.merging.objects import UnitedObjects
from ggslam.objects.history import History, VisitRecord
from ggslam.runs.recordings import fingerprint


def history_after(
    sources: list[MergeSource], found: Detection, objects: UnitedObjects, present: set[int]
) -> History | None:
    """What became of the objects of the older run, and of those that came.

    Args:
        sources: the older run and the newer one.
        found: what changed.
        objects: of both.
        present: ids that the updated map has.

    Returns:
        The history; None: neither run has objects.
    """
    if objects.supervision is None:
        return None
    old, new = sources
    history = _history_of(old)
    ids = objects.ids[1]
    seen = {i: objects.names.get(i) for i in sorted(set(ids.values()) & present)}
    gone, T_new_old = set[int](), dict[int, np.ndarray]()
    for change in found.changes:
        own = () if change.old is None else change.old.ids
        if change.new is None:
            gone |= set(own) - present
        elif change.T_new_old is not None:
            T_new_old |= dict.fromkeys(own, change.T_new_old)
    return history.after_visit(_visit(new), seen, gone, T_new_old)


def _history_of(run: MergeSource) -> History:
    table = None if run.objects is None else run.objects.table
    if table is not None and table.history is not None:
        return table.history
    return History.of_first(_visit(run), {} if table is None else {o.id: o.name for o in table.objects})


def _visit(run: MergeSource) -> VisitRecord:
    return VisitRecord(str(Path(run.place)), fingerprint(run.folder))
