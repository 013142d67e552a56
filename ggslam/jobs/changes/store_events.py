# SPDX-License-Identifier: Apache-2.0
"""Events of a grid store's objects in a visit, from the history of an updated run or from compared maps."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import replace
from typing import Any

import numpy as np

from ggslam.objects.history import History, ObjectPast
from ggslam.objects.table import ObjectTable
from ggslam.scene.poses import inverse, to_matrix
from ggslam.submaps.store_objects import Kind, ObjectEvent, StoredObject

Known = Mapping[int, StoredObject]
"""Objects of a store before a visit, by id; also those that are gone."""


def first_events(table: ObjectTable) -> list[ObjectEvent]:
    """Of a first visit: everything came."""
    return [ObjectEvent("added", record.id, record.name) for record in table.objects]


def events_of_history(history: History, known: Known, past: int) -> list[ObjectEvent]:
    """What happened to objects in the visits of an updated run after the first `past` ones, by rising id."""
    events = []
    for own in history.objects:
        kind, T = _verdict(own, known.get(own.id), past)
        if kind is not None:
            events.append(_event(kind, own.id, own.name, known, T))
    return events


def _verdict(own: ObjectPast, before: StoredObject | None, past: int) -> tuple[Kind | None, np.ndarray | None]:
    was_there = own.first_seen < past and (before is None or before.gone_since is None)
    if own.gone_since is not None:
        return ("removed" if was_there and own.gone_since >= past else None), None
    if not was_there:
        return ("added" if own.last_seen >= past else None), None
    if own.last_seen < past:
        return "unseen", None
    earlier = [number for number in own.T_now_first if number < past]
    if not earlier:
        return None, None
    old, now = (np.array(own.T_now_first[number]) for number in (max(earlier), max(own.T_now_first)))
    return ("moved", now @ inverse(old)) if not np.array_equal(old, now) else (None, None)


def add_evidence(events: list[ObjectEvent], values: Mapping[str, Any], known: Known) -> list[ObjectEvent]:
    """Events with what only a list of changes (content of changes.json) tells: confidences, whether turns are known,
    other colours, things without ids."""
    by_id = {event.id: event for event in events}
    nameless = []
    for told in events_of_changes(values, known, own_ids=False):
        if told.id is None:
            nameless.append(told)
        elif told.id not in by_id:
            if told.kind in ("look", "unseen"):
                by_id[told.id] = told
        elif by_id[told.id].kind == told.kind:
            by_id[told.id] = replace(by_id[told.id], confidence=told.confidence, turn_known=told.turn_known)
    return [by_id[i] for i in sorted(i for i in by_id if i is not None)] + nameless


def events_of_changes(values: Mapping[str, Any], known: Known, own_ids: bool) -> list[ObjectEvent]:
    """Events of a list of changes, as `ChangeTable.to_dict` gives it.

    Args:
        values: the list.
        known: the store's objects.
        own_ids: whether ids of the newer visit are unrelated to the older one's: what came has none in the store then.
    """
    events: list[ObjectEvent] = []
    for change in values["changes"]:
        old, new = change["old"], change["new"]
        ids = old["ids"] if old is not None else [] if own_ids else new["ids"]
        T = np.array(change["T_new_old"]) if "T_new_old" in change else None
        for i in ids or [None]:
            name = change["name"] if i is None else _name_of(i, change["name"], known)
            event = _event(change["kind"], i, name, known, T)
            events.append(
                replace(event, turn_known=change.get("turn_known"), confidence=change["confidence"])
            )  # fmt: skip
    events += [_event("unseen", i, _name_of(i, thing["name"], known), known) for thing in values["unseen"]
               for i in thing["ids"]]  # fmt: skip
    return events


def _name_of(i: int, label: str, known: Known) -> str | None:
    """A change is labelled with name and id."""
    if i in known:
        return known[i].name
    return label.removesuffix(f" ({i})") if label.endswith(f" ({i})") else None


def _event(kind: Kind, i: int | None, name: str | None, known: Known, T: np.ndarray | None = None) -> ObjectEvent:
    before = None if i is None or kind == "added" else known.get(i)
    return ObjectEvent(
        kind, i, name, [] if before is None else before.cells, None if before is None else before.box.center,
        None if T is None else to_matrix(T), look=kind == "look",
    )  # fmt: skip


def with_cells(events: Iterable[ObjectEvent], cells: Mapping[int, Iterable[tuple[int, int, int]]]) -> list[ObjectEvent]:
    """Events with the cells that hold their objects now beside those that held them before."""
    return [
        replace(event, cells=sorted({*event.cells, *(() if event.id is None else cells.get(event.id, ()))}))
        for event in events
    ]
