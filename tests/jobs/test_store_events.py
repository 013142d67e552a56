# SPDX-License-Identifier: Apache-2.0
"""What visits did to the objects of a store: from histories, joined over visits, kept in a file."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import torch

from ggslam.errors import FormatError
from ggslam.jobs.changes.store_events import events_of_history
from ggslam.jobs.changes.store_visits import _Comparison, _drop_ghosts
from ggslam.jobs.submaps.cell_gaussians import GAUSSIANS, arrays_of_map, cell_arrays, gaussians_to_bytes
from ggslam.jobs.submaps.fill import list_store
from ggslam.objects.history import History, VisitRecord
from ggslam.scene.gaussian_map import GaussianMap
from ggslam.scene.oriented_box import OrientedBox
from ggslam.scene.poses import to_matrix
from ggslam.submaps.grid import GridStore
from ggslam.submaps.store_copy import copy_store
from ggslam.submaps.store_objects import (
    OBJECTS_FILE,
    ObjectEvent,
    StoredObject,
    StoreObjects,
    VisitObjects,
    read_objects,
    write_objects,
)

BOX = OrientedBox((1.0, 0.0, 0.0), ((1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (0.0, 0.0, 1.0)), (0.1, 0.1, 0.1))


def shift(x: float) -> np.ndarray:
    T = np.eye(4)
    T[0, 3] = x
    return T


def stored(i: int) -> StoredObject:
    return StoredObject(i, None, BOX, 5, [(0, 0, 0)], "monday", "monday")


def three_visits() -> History:
    """1 moves twice, 2 goes, 3 comes and goes, 4 comes, 5 is not seen again, 6 stays."""
    first = History.of_first(VisitRecord("a", "a"), dict.fromkeys((1, 2, 5, 6)))
    second = first.after_visit(VisitRecord("b", "b"), dict.fromkeys((1, 3, 6)), {2}, {1: shift(0.3)})
    return second.after_visit(VisitRecord("c", "c"), dict.fromkeys((1, 4, 6)), {3}, {1: shift(0.2)})


def test_a_history_tells_what_happened() -> None:
    known = {i: stored(i) for i in (1, 2, 5, 6)}
    events = events_of_history(three_visits(), known, 1)
    assert [(e.id, e.kind) for e in events] == [(1, "moved"), (2, "removed"), (4, "added"), (5, "unseen")]
    assert events[0].motion() == pytest.approx((0.5, 0.0)) and events[2].motion() is None
    later = events_of_history(three_visits(), known, 2)
    assert [e.id for e in later if e.kind == "moved"] == [1] and later[0].motion() == pytest.approx((0.2, 0.0))


def test_visits_are_joined_object_by_object(tmp_path: Path) -> None:
    def moved(i: int, x: float) -> ObjectEvent:
        return ObjectEvent("moved", i, None, [(0, 0, 0)], (1.0, 0.0, 0.0), to_matrix(shift(x)))

    came = [ObjectEvent("added", 2, "mug"), ObjectEvent("added", 3, None)]
    tuesday = [moved(1, 0.3), *came, ObjectEvent("unseen", 4, None)]
    wednesday = [moved(1, 0.2), ObjectEvent("removed", 2, "mug"), moved(3, 1.0)]
    visits = [VisitObjects(name, "run", [], "history", events=events)
              for name, events in (("tuesday", tuesday), ("wednesday", wednesday))]  # fmt: skip
    objects = StoreObjects(visits=visits, objects=[stored(1)])
    both = objects.events_since(["tuesday", "wednesday"])
    assert [(e.id, e.kind) for e in both] == [(1, "moved"), (3, "added"), (4, "unseen")]
    assert both[0].motion() == pytest.approx((0.5, 0.0))
    assert [(e.id, e.kind) for e in objects.events_since(["wednesday"])] == [(1, "moved"), (2, "removed"), (3, "moved")]
    with GridStore.create(tmp_path / "map.grid") as store:
        for visit in ("monday", "tuesday", "wednesday"):
            store.begin_visit(visit)
        assert read_objects(store) is None
        write_objects(store, objects)
        assert read_objects(store) == objects
    copy_store(tmp_path / "map.grid", tmp_path / "copy.grid")
    listing = list_store(tmp_path / "copy.grid", "wednesday")
    assert listing.events is not None and len(listing.events) == 3 and listing.unknown == []
    assert listing.to_dict()["events"][0]["moved_m"] == pytest.approx(0.2)
    assert list_store(tmp_path / "copy.grid", "monday").unknown == ["monday"]


@pytest.mark.parametrize("damage", ["", "[]", "{", '{"version": 2}', '{"version": 1, "visits": 3}', "[" * 100_000])
def test_damaged_records_are_told_and_cells_still_listed(tmp_path: Path, damage: str) -> None:
    with GridStore.create(tmp_path / "map.grid") as store:
        store.begin_visit("monday")
        store.put((0, 0, 0), {"points.pcd": b"p"}, 1.0)
    assert list_store(tmp_path / "map.grid", "monday").unknown == ["monday"]
    (tmp_path / "map.grid" / OBJECTS_FILE).write_text(damage)
    with GridStore.open(tmp_path / "map.grid") as store, pytest.raises(FormatError, match=OBJECTS_FILE):
        read_objects(store)
    listing = list_store(tmp_path / "map.grid", "monday")
    assert listing.cells == 1 and listing.events is None and OBJECTS_FILE in listing.problems[0]


def test_what_went_leaves_the_cells_that_have_the_same_ids(tmp_path: Path) -> None:
    """Of three earlier cells one belongs to a visit whose ids name other things."""

    def cell_of(ids: list[int], visit: str) -> bytes:
        made = GaussianMap(0, 2)
        count = len(ids)
        zeros, owner = torch.zeros(count, 3), torch.tensor(ids, dtype=torch.int32)
        made.insert(zeros, torch.eye(4)[:1].repeat(count, 1), zeros, zeros[:, 0], zeros, object_id=owner)
        return gaussians_to_bytes(arrays_of_map(made), visit)

    keys = [(0, 0, 0), (1, 0, 0), (2, 0, 0), (3, 0, 0)]
    contents = {keys[0]: ([1, 2, 2], "monday"), keys[1]: ([2], "monday"), keys[2]: ([2, 7], "others")}
    entry = VisitObjects("wednesday", "run", ["c"], None, events=[ObjectEvent("removed", 2, "milk")])
    with GridStore.create(tmp_path / "map.grid") as store:
        for visit in ("monday", "others", "wednesday"):
            store.begin_visit(visit)
            for key, (ids, by) in {**contents, keys[3]: ([1], "wednesday")}.items():
                if by == visit:
                    store.put(key, {GAUSSIANS: cell_of(ids, by)}, counts={GAUSSIANS: len(ids)})
        assert _drop_ghosts(store, _Comparison(entry, {}, set()), {"others"}) == []
        left = {key: cell_arrays(store, key)[0]["object_id"].tolist() for key in store.counts(GAUSSIANS)}
    assert left == {keys[0]: [1], keys[2]: [2, 7], keys[3]: [1]}
