# SPDX-License-Identifier: Apache-2.0
"""Adds a run to a grid store as a visit: its cells, its objects, and what happened to earlier objects."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np

from ggslam.errors import ConfigError, GgslamError, RunFolderError
from ggslam.jobs.changes.changes import ChangesOutcome, find_changes
from ggslam.jobs.changes.stale_gaussians import own_keyframes
from ggslam.jobs.changes.store_events import (
    add_evidence,
    events_of_changes,
    events_of_history,
    first_events,
    with_cells,
)
from ggslam.jobs.progress import Observer
from ggslam.jobs.submaps.cell_gaussians import GAUSSIANS, cell_arrays, gaussians_to_bytes
from ggslam.jobs.submaps.stores import store_of_run, visit_of
from ggslam.objects.table import ObjectTable
from ggslam.runs.folder import RunFolder
from ggslam.runs.recordings import fingerprint
from ggslam.runs.records.changes import ChangesRecord
from ggslam.runs.writing import CHANGES_FOLDER
from ggslam.scene.poses import separation
from ggslam.submaps.cell_keys import CellKey
from ggslam.submaps.grid import GridStore
from ggslam.submaps.store_objects import (
    Kind,
    StoredObject,
    StoreObjects,
    VisitObjects,
    read_objects,
    write_objects,
)
from ggslam.system.plurals import quantity
from ggslam.system.tuning import Tuning


class SameWorldTuning(Tuning):
    """When a run lies in the world of a store."""

    max_shift_m = 0.2
    """Largest distance between the two worlds, in metres."""
    max_rotation_deg = 5.0
    """Largest rotation between them, in degrees."""
    min_keyframes = 3
    """Fewest keyframes that are compared."""


@dataclass
class _Comparison:
    """The objects of a visit before its cells are written."""

    entry: VisitObjects
    known: dict[int, StoredObject]
    seen: set[int]
    replaced: list[str] = field(default_factory=list)
    """Visits that the run shows the latest state of."""
    against: str | None = None
    """The visit that the maps were compared with."""


def add_run(
    run: Path, store: GridStore, visit: str | None = None, at: float | None = None, observer: Observer | None = None
) -> VisitObjects | None:
    """Writes a run into a store as a visit, like `store_of_run`, and what it tells of objects.

    - The first run with objects: all of them came.
    - An updated run takes the place of the visits that it continues, in all their cells and whenever they were; what
      happened to objects is its history.
    - Another run is compared with the run of the visit before, if that is still there and the two have common ground.
      Its cells are written as they are due; where ids are the same in both runs, what was removed leaves the cells that
      were not, and so does what moved and is in those that were.

    Returns:
        What was found of objects; None: the run has none.

    Raises:
        ConfigError: the store holds a later state of the run, or the run's world is not the store's.
        GgslamError: as of `store_of_run`.
    """
    folder = RunFolder.open(run)
    name = visit or visit_of(folder)
    objects = read_objects(store) or StoreObjects()
    if not folder.has_objects():
        store_of_run(run, store, visit, at)
        if observer is not None and objects.visits:
            observer.note("the run has no objects: nothing is said of those of the store")
        return None
    table = folder.object_table()
    states = _states(folder, table)
    earlier = [entry for entry in objects.visits if entry.visit != name]
    for entry in earlier:
        if set(states) < set(entry.states):
            raise ConfigError(f"{store.path}: holds a later state of {run} already, from visit {entry.visit!r}")
    found = _compare(folder, table, VisitObjects(name, str(folder.path.absolute()), states, None), earlier, objects,
                     observer)  # fmt: skip
    found.replaced += [v for v in store.visits() if v != name and v in {f"run {state[:16]}" for state in states}]
    store_of_run(run, store, visit, at, found.replaced)
    unrelated = {e.visit for e in earlier if e.own_ids}
    if found.against is not None and not found.entry.own_ids:
        found.entry.notes.extend(_drop_ghosts(store, found, unrelated))
    after = _objects_after(store, table, found, unrelated)
    cells = {known.id: known.cells for known in after}
    entry = replace(found.entry, events=with_cells(found.entry.events, cells))
    write_objects(store, StoreObjects(visits=[*earlier, entry], objects=after))
    if observer is not None:
        for note in entry.notes:
            observer.note(note)
    return entry


def _states(folder: RunFolder, table: ObjectTable) -> list[str]:
    return [fingerprint(folder)] if table.history is None else [visit.fingerprint for visit in table.history.visits]


# --- what happened ---------------------------------------------------------------------------------------------------


def _compare(
    folder: RunFolder, table: ObjectTable, entry: VisitObjects, earlier: list[VisitObjects], objects: StoreObjects,
    observer: Observer | None,
) -> _Comparison:  # fmt: skip
    known = {  # without what the visit itself told, if it is written again
        own.id: replace(own, gone_since=None) if own.gone_since == entry.visit else own
        for own in objects.objects if own.first_seen != entry.visit
    }  # fmt: skip
    history, last = table.history, len(entry.states) - 1
    seen = set(table.ids())
    if history is not None:
        seen &= {past.id for past in history.objects if past.last_seen == last}
    if not earlier:
        return _Comparison(replace(entry, compared="first", events=first_events(table)), {}, seen)
    continued = [other for other in earlier if set(other.states) <= set(entry.states) and not other.own_ids]
    if continued and history is not None:
        past = len(continued[-1].states)
        events = events_of_history(history, known, past)
        if past == last:
            events = add_evidence(events, _told_changes(folder), known)
        else:
            entry.notes.append(f"{quantity(last + 1 - past, 'visit')} at once: changed looks are not told")
        done = replace(entry, compared="history", events=events)
        return _Comparison(done, known, seen, [other.visit for other in continued])
    if continued:  # the same run again
        done = replace(entry, compared="history")
        return _Comparison(done, known, seen, [other.visit for other in continued])
    return _compare_maps(folder, entry, earlier[-1], known, seen, observer)


def _told_changes(folder: RunFolder) -> Mapping[str, Any]:
    record = ChangesRecord.read_if_there(folder.path / CHANGES_FOLDER)
    return {"changes": [], "unseen": []} if record is None else {"changes": [], "unseen": [], **record.values()}


def _compare_maps(
    folder: RunFolder, entry: VisitObjects, before: VisitObjects, known: dict[int, StoredObject], seen: set[int],
    observer: Observer | None,
) -> _Comparison:  # fmt: skip
    try:
        old = RunFolder.open(Path(before.run))
        if _states(old, old.object_table()) != before.states:
            raise RunFolderError(f"{before.run}: holds another run now")
        outcome = find_changes(old.path, folder.path, observer=observer)
    except GgslamError as error:
        entry.notes.append(f"not compared with visit {before.visit!r}, its objects are not listed: {error}")
        return _Comparison(replace(entry, own_ids=True), known, seen)
    _check_world(folder, outcome, before.visit)
    own_ids = not outcome.table.found.ids_believed
    events = events_of_changes(outcome.table.to_dict(), known, own_ids)
    if own_ids:
        entry.notes.append("object ids are others than the store's: its objects are not listed, only what changed; "
                           "a run that `ggslam update` makes keeps ids")  # fmt: skip
    unseen = {i for thing in outcome.table.found.unseen if thing.old is not None for i in thing.old.ids}
    done = replace(entry, compared="runs", own_ids=own_ids, events=events)
    return _Comparison(done, known, set() if own_ids else seen - unseen, against=before.visit)


def _check_world(folder: RunFolder, outcome: ChangesOutcome, visit: str) -> None:
    record, placed = folder.keyframes(), outcome.visits[1].T_world_camera
    own = own_keyframes(record)
    if len(own) != len(placed) or len(own) < SameWorldTuning.min_keyframes:
        return
    apart = [separation(record.keyframes[k].T_world_camera, T) for k, T in zip(own, placed, strict=True)]
    metres, degrees = np.median(apart, axis=0)
    if metres > SameWorldTuning.max_shift_m or degrees > SameWorldTuning.max_rotation_deg:
        raise ConfigError(
            f"{folder.path}: lies {metres:.2f} m and {degrees:.0f} degrees from where visit {visit!r} has it; "
            "add the run that `ggslam update` makes of the two, or start this one in the earlier run's map"
        )


# --- the cells -------------------------------------------------------------------------------------------------------


def _drop_ghosts(store: GridStore, found: _Comparison, unrelated: set[str]) -> list[str]:
    """Takes what is gone, and what moved and is in new cells, out of the cells of earlier visits; returns notes.
    `unrelated`: visits whose object ids mean other objects; their cells stay as they are."""
    old_cells, own_ids = {}, set[int]()
    for key in store.counts(GAUSSIANS):
        arrays, visit = cell_arrays(store, key)
        if visit == store.visit:
            own_ids |= set(np.unique(arrays["object_id"]).tolist())
        elif visit not in unrelated:
            old_cells[key] = visit
    gone, moved, added = (_ids(found.entry, kind) for kind in ("removed", "moved", "added"))
    leaving = sorted(gone | (moved & own_ids))
    for key, visit in old_cells.items() if leaving else ():
        arrays, _ = cell_arrays(store, key)
        keep = ~np.isin(arrays["object_id"], leaving)
        if not keep.any():
            store.remove_part(key, GAUSSIANS)
        elif not keep.all():
            data = gaussians_to_bytes({name: values[keep] for name, values in arrays.items()}, visit)
            store.put(key, {GAUSSIANS: data}, counts={GAUSSIANS: int(keep.sum())})
    notes = {
        "moved, and still at the old place": sorted(moved - own_ids),
        "added, and not in the store yet": sorted(added - own_ids),
    }
    return [f"{what}, for no cell of the new one was due: objects {ids}" for what, ids in notes.items() if ids]


def _ids(entry: VisitObjects, kind: Kind) -> set[int]:
    return {event.id for event in entry.events if event.kind == kind and event.id is not None}


# --- the objects -----------------------------------------------------------------------------------------------------


def _objects_after(
    store: GridStore, table: ObjectTable, found: _Comparison, unrelated: set[str]
) -> list[StoredObject]:
    """The store's objects after a visit, counted in its cells; `unrelated`: earlier visits with ids of their own."""
    visit = found.entry.visit
    others = unrelated | ({visit} if found.entry.own_ids else set())
    count: dict[int, int] = {}
    cells: dict[int, list[CellKey]] = {}
    for key in store.counts(GAUSSIANS):
        arrays, filled_by = cell_arrays(store, key)
        if filled_by in others:
            continue
        for i, n in zip(*(a.tolist() for a in np.unique(arrays["object_id"], return_counts=True)), strict=True):
            count[i] = count.get(i, 0) + n
            cells.setdefault(i, []).append(key)
    after = dict(found.known)
    for record in [] if found.entry.own_ids else table.objects:
        before = after.get(record.id)
        first = visit if before is None else before.first_seen
        last = visit if before is None or record.id in found.seen else before.last_seen
        after[record.id] = StoredObject(record.id, record.name, record.box, 0, [], first, last)
    for i in _ids(found.entry, "removed") & set(after):
        after[i] = replace(after[i], gone_since=visit)
    return [
        replace(after[i], gaussians=count.get(i, 0), cells=sorted(cells.get(i, []))) for i in sorted(after)
    ]
