# SPDX-License-Identifier: Apache-2.0
"""Things that were added, removed, moved, repainted or not looked at are told apart; what stayed is left alone."""

from __future__ import annotations

import numpy as np
import pytest
from small_visits import Box, SmallVisit, detect

from ggslam.changes.detection import Change, Detection
from ggslam.changes.found import ChangeTable
from ggslam.scene.poses import inverse, transform_points, turning_angle

CUP, CRATE, BRICK = Box(2, (-0.2, 0.1)), Box(3, (0.25, -0.15), (0.12, 0.12, 0.2), 20, 2.0), Box(4, (0.1, 0.3), hue=4.0)


def kinds(found: Detection) -> list[str]:
    return sorted(change.kind for change in found.changes)


def check_moved(change: Change, old: Box, new: Box) -> None:
    """Within 1 cm and 3 degrees of the truth."""
    assert change.kind == "moved" and change.T_new_old is not None
    true, middle = new.pose() @ inverse(old.pose()), old.pose()[None, :3, 3]
    off = transform_points(middle, change.T_new_old) - transform_points(middle, true)
    assert np.linalg.norm(off) < 0.01
    assert np.degrees(turning_angle(change.T_new_old, true)) < 3


def test_nothing_changed_between_equal_visits() -> None:
    boxes = [CUP, CRATE, BRICK]
    found, _ = detect(SmallVisit(boxes), SmallVisit(boxes, around=(25, 75, 125, 190, 260, 320)))
    assert found.changes == [] and found.unseen == [] and found.ids_believed
    assert found.stayed == 4  # the floor, too


@pytest.mark.long("shapes are compared from starts all around")
@pytest.mark.parametrize("ids", [None, False])
def test_moved_removed_and_added_things_are_found(ids: bool | None) -> None:
    moved, plate = Box(2, (-0.05, -0.3), turn=50), Box(5, (-0.35, -0.2), (0.1, 0.1, 0.15), hue=1.0)
    found, detector = detect(SmallVisit([CUP, CRATE, BRICK]), SmallVisit([moved, BRICK, plate]), ids)
    assert kinds(found) == ["added", "moved", "removed"] and found.ids_believed is (ids is None)
    by_kind = {change.kind: change for change in found.changes}
    check_moved(by_kind["moved"], CUP, moved)
    table = ChangeTable(found, detector.judged, ({3: "crate"}, {5: "plate"}))
    assert table.label(by_kind["removed"]) == "crate (3)" and table.label(by_kind["added"]) == "plate (5)"
    box = table.box(by_kind["removed"], 0)
    assert box is not None and np.allclose(box.center[:2], CRATE.at, atol=0.03)
    assert table.box(by_kind["removed"], 1) is None
    entry = next(e for e in table.to_dict()["changes"] if e["kind"] == "moved")
    assert entry["old"]["ids"] == [2] and entry["moved_m"] > 0.3 and 45 < entry["turned_deg"] < 55


def test_a_thing_turned_in_place_is_moved() -> None:
    turned = Box(2, CUP.at, turn=60)
    found, _ = detect(SmallVisit([CUP, CRATE]), SmallVisit([turned, CRATE]))
    assert kinds(found) == ["moved"]
    check_moved(found.changes[0], CUP, turned)


def test_a_thin_thing_that_was_pushed_along_the_floor_is_moved() -> None:
    size = (0.3, 0.12, 0.006)
    before, after = Box(5, (-0.1, -0.3), size), Box(5, (-0.02, -0.26), size, turn=30)
    found, detector = detect(SmallVisit([before, CUP, BRICK]), SmallVisit([after, CUP, BRICK]))
    thing = next(t for t in detector.things[0] if t.label == 5)
    assert thing.changed < detector.settings.min_changed  # neither gone nor come by its surface
    assert kinds(found) == ["moved"]
    check_moved(found.changes[0], before, after)


def test_ids_that_were_shuffled_are_not_believed_and_not_needed() -> None:
    moved = Box(4, (-0.05, -0.3), turn=30)
    found, _ = detect(SmallVisit([CUP, CRATE, BRICK]), SmallVisit([moved, Box(2, CRATE.at, CRATE.size, 20, 2.0),
                                                                  Box(3, BRICK.at, hue=4.0)]))  # fmt: skip
    assert not found.ids_believed and kinds(found) == ["moved"]
    check_moved(found.changes[0], CUP, moved)


def test_a_thing_that_one_visit_cut_in_two_is_one() -> None:
    moved = Box(2, (-0.05, -0.3), turn=30, cut=9)
    found, _ = detect(SmallVisit([CUP, CRATE, BRICK]), SmallVisit([moved, CRATE, BRICK]), ids=False)
    assert kinds(found) == ["moved"]
    assert found.changes[0].new is not None and set(found.changes[0].new.ids) == {2, 9}
    check_moved(found.changes[0], CUP, moved)


def test_where_another_thing_stands_in_its_place_one_went_and_one_came() -> None:
    other = Box(7, CUP.at, (0.1, 0.1, 0.2), hue=3.0)
    found, _ = detect(SmallVisit([CUP, CRATE]), SmallVisit([other, CRATE]))
    assert kinds(found) == ["added", "removed"]


def test_a_repainted_thing_changed_its_look() -> None:
    found, _ = detect(SmallVisit([CUP, CRATE]), SmallVisit([Box(2, CUP.at, hue=2.5), CRATE]))
    assert kinds(found) == ["look"]
    assert found.changes[0].old is not None and found.changes[0].old.ids == (2,)


def test_of_what_the_second_visit_did_not_look_at_nothing_is_said() -> None:
    corner = SmallVisit([CUP], around=(150, 180, 210), target=(-0.55, 0.3, 0.0), distance=0.25)
    found, _ = detect(SmallVisit([CUP, CRATE, BRICK]), corner)
    assert found.changes == []
    assert {change.old.ids for change in found.unseen if change.old is not None} >= {(3,)}
