# SPDX-License-Identifier: Apache-2.0
"""Things that were added, removed, moved, repainted or not looked at are told apart; what stayed is left alone."""

from __future__ import annotations

from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from small_visits import Box, SmallVisit, detect

from ggslam.changes.alignment_score import Fit
from ggslam.changes.candidates import Candidate
from ggslam.changes.change import UNCLEAR, Change, Detection
from ggslam.changes.change_table import ChangeTable
from ggslam.changes.detection import ChangeDetector
from ggslam.changes.settings import ChangeSettings
from ggslam.native.loader import NativeContext
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


@pytest.mark.long("shapes are compared from starts all around")
def test_a_thing_turned_in_place_is_moved() -> None:
    turned = Box(2, CUP.at, turn=60)
    found, _ = detect(SmallVisit([CUP, CRATE]), SmallVisit([turned, CRATE]))
    assert kinds(found) == ["moved"]
    check_moved(found.changes[0], CUP, turned)


@pytest.mark.long("shapes are compared from starts all around")
def test_a_thin_thing_that_was_pushed_along_the_floor_is_moved() -> None:
    size = (0.3, 0.12, 0.006)
    before, after = Box(5, (-0.1, -0.3), size), Box(5, (-0.02, -0.26), size, turn=30)
    found, detector = detect(SmallVisit([before, CUP, BRICK]), SmallVisit([after, CUP, BRICK]))
    thing = next(t for t in detector.candidates[0] if t.label == 5)
    assert thing.changed < detector.settings.min_changed  # neither gone nor come by its surface
    assert kinds(found) == ["moved"]
    check_moved(found.changes[0], before, after)


@pytest.mark.long("shapes are compared from starts all around")
def test_ids_that_were_shuffled_are_not_believed_and_not_needed() -> None:
    moved = Box(4, (-0.05, -0.3), turn=30)
    found, _ = detect(SmallVisit([CUP, CRATE, BRICK]), SmallVisit([moved, Box(2, CRATE.at, CRATE.size, 20, 2.0),
                                                                  Box(3, BRICK.at, hue=4.0)]))  # fmt: skip
    assert not found.ids_believed and kinds(found) == ["moved"]
    check_moved(found.changes[0], CUP, moved)


@pytest.mark.long("shapes are compared from starts all around")
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


TWIN, THIRD = Box(7, (0.35, 0.3), CUP.size, hue=3.0), Box(8, (-0.35, -0.35), hue=1.0)


@pytest.mark.long("shapes are compared from starts all around")
def test_without_ids_what_another_stands_for_is_told_once() -> None:
    old, new = Box(2, (0.0, 0.0), (0.16, 0.16, 0.14)), Box(3, (0.0, 0.0), (0.16, 0.16, 0.1), hue=2.5)
    found, _ = detect(SmallVisit([old]), SmallVisit([new]), False)
    assert kinds(found) == ["added", "removed"] and not found.unseen and found.stayed == 1  # the floor


def test_a_visit_that_measured_nothing_is_compared() -> None:
    visit, other = SmallVisit([CUP]).build(), SmallVisit([CUP]).build()
    nothing = replace(other, measured=np.zeros((0, 3)), normals=np.zeros((0, 3)))
    for pair in ((visit, nothing), (nothing, visit)):
        assert not ChangeDetector(*pair, ChangeSettings(), NativeContext(2)).detect().changes


@pytest.mark.long("shapes are compared from starts all around: 20 s beside others")
def test_what_moved_may_stand_where_something_was_taken_away() -> None:
    """Two things of one shape: one is gone, and the other one stands in its place."""
    here = Box(TWIN.id, CUP.at, TWIN.size, CUP.turn, TWIN.hue)
    found, _ = detect(SmallVisit([CUP, TWIN, CRATE, THIRD]), SmallVisit([here, CRATE, THIRD]))
    assert kinds(found) == ["moved", "removed"] and found.ids_believed
    gone = next(change for change in found.changes if change.kind == "removed")
    assert gone.old is not None and gone.old.ids == (CUP.id,) and gone.confidence > 0.8


@pytest.mark.long("shapes are compared from starts all around")
def test_where_something_moved_away_from_another_may_have_come() -> None:
    moved, came = Box(CUP.id, TWIN.at, CUP.size, CUP.turn), Box(TWIN.id, CUP.at, CUP.size, CUP.turn, hue=3.0)
    found, _ = detect(SmallVisit([CUP, CRATE, THIRD]), SmallVisit([moved, came, CRATE, THIRD]))
    assert kinds(found) == ["added", "moved"] and found.ids_believed
    new = next(change for change in found.changes if change.kind == "added").new
    assert new is not None and new.ids == (TWIN.id,)


@pytest.mark.long("shapes are compared from starts all around")
def test_two_things_that_changed_places_do_not_make_ids_doubtful() -> None:
    here, there = Box(TWIN.id, CUP.at, CUP.size, hue=3.0), Box(CUP.id, TWIN.at, CUP.size)
    found, _ = detect(SmallVisit([Box(CUP.id, CUP.at), TWIN, CRATE, THIRD]), SmallVisit([here, there, CRATE, THIRD]))
    assert found.ids_believed and kinds(found) == ["moved", "moved"]


def test_a_thing_that_shrank_changed_in_a_way_that_cannot_be_told() -> None:
    """It is the same by its id, and not by its shape: it neither moved nor stayed."""
    less = Box(CUP.id, CUP.at, (0.06, 0.06, 0.06), CUP.turn)
    found, detector = detect(SmallVisit([CUP, CRATE, BRICK]), SmallVisit([less, CRATE, BRICK]), True)
    assert found.changes == []
    assert [(c.old.ids, c.reason) for c in found.unseen if c.old is not None] == [((CUP.id,), UNCLEAR)]
    said = ChangeTable(found, detector.judged, ({}, {})).to_dict()["unseen"]
    assert said[0]["reason"] == UNCLEAR


def test_a_repainted_thing_changed_its_look() -> None:
    found, _ = detect(SmallVisit([CUP, CRATE]), SmallVisit([Box(2, CUP.at, hue=2.5), CRATE]))
    assert kinds(found) == ["look"]
    assert found.changes[0].old is not None and found.changes[0].old.ids == (2,)


def test_of_what_the_second_visit_did_not_look_at_nothing_is_said() -> None:
    corner = SmallVisit([CUP], around=(150, 180, 210), target=(-0.55, 0.3, 0.0), distance=0.25)
    found, _ = detect(SmallVisit([CUP, CRATE, BRICK]), corner)
    assert found.changes == []
    assert {change.old.ids for change in found.unseen if change.old is not None} >= {(3,)}


@pytest.mark.long("shapes are compared from starts all around")
def test_a_thing_that_moved_to_where_the_first_visit_saw_nothing_is_moved() -> None:
    wall = Box(6, (0.0, 0.0), (0.5, 0.06, 0.3), hue=3.0)
    before, after = Box(2, (-0.1, -0.3)), Box(2, (0.0, 0.3), turn=20)
    front = SmallVisit([before, wall], around=(-130, -110, -90, -70, -50))
    found, detector = detect(front, SmallVisit([after, wall]), True)
    new = next(t for t in detector.candidates[1] if t.label == 2)
    assert new.seen < detector.settings.min_seen
    assert kinds(found) == ["moved"]


@pytest.mark.long("shapes are compared from starts all around")
def test_the_turn_of_a_plain_thing_is_said_not_to_be_known() -> None:
    plain, painted = Box(2, (-0.2, 0.1), (0.14, 0.14, 0.1), plain=True), Box(3, (0.2, -0.1))
    moved, turned = Box(2, (-0.15, -0.2), plain.size, turn=90, plain=True), Box(3, (0.2, 0.15), turn=60)
    found, detector = detect(SmallVisit([plain, painted]), SmallVisit([moved, turned]))
    by_id = {change.old.ids[0]: change for change in found.changes if change.old is not None}
    assert kinds(found) == ["moved", "moved"]
    assert by_id[2].fit is not None and not by_id[2].fit.turn_known
    assert by_id[3].fit is not None and by_id[3].fit.turn_known
    check_moved(by_id[3], painted, turned)
    assert by_id[2].T_new_old is not None  # its place is known all the same
    place = transform_points(np.array([[*plain.at, 0.05]]), by_id[2].T_new_old)[0]
    assert np.allclose(place, [*moved.at, 0.05], atol=0.01)
    entries = ChangeTable(found, detector.judged, ({}, {})).to_dict()["changes"]
    said = {entry["old"]["ids"][0]: (entry["turn_known"], "turn_reason" in entry) for entry in entries}
    assert said == {2: (False, True), 3: (True, False)}


@pytest.mark.parametrize(
    ("doubts", "reason"),
    [
        ({}, None), ({"seen": 0.4}, "only 40 %"), ({"as_good_deg": 15.0}, "15 degrees"),
        ({"sides_may_differ": True}, "different sides"), ({"repainted": True}, "colours"),
    ],
)  # fmt: skip
def test_why_a_turn_is_not_known(doubts: dict[str, Any], reason: str | None) -> None:
    fit = Fit(**{"T_new_old": np.eye(4), "share": 1.0, "seen": 0.9, "color_apart": 0.0, **doubts})
    assert fit.turn_known == (reason is None)
    assert reason is None or reason in str(fit.turn_reason)


def test_what_the_first_visit_hardly_saw_was_not_added() -> None:
    speck = Box(2, (-0.3, 0.3), (0.004, 0.004, 0.004))
    found, detector = detect(SmallVisit([speck, CRATE, BRICK]), SmallVisit([CUP, CRATE, BRICK]), True)
    assert all(t.label != 2 for t in detector.candidates[0])
    assert found.changes == []


@pytest.mark.parametrize("count, shifted", [(310, True), (742, False)])
def test_what_only_one_visit_shows_much_of_was_not_pushed(count: int, shifted: bool) -> None:
    """A strip of a cupboard behind a chair, 259 points of it from one side and 742 from the other, bore other ids at
    its ends: it was said to have been pushed."""

    def strip(points: int) -> Candidate:
        return Candidate(19, (19,), np.arange(points), 1.0, 0.0, 0.05)

    judged = SimpleNamespace(points=np.zeros((1000, 3)))
    others = SimpleNamespace(
        settings=ChangeSettings(), judged=[judged, judged], _ids_at=lambda _, points: np.zeros(len(points), int)
    )
    assert ChangeDetector._has_shifted(others, strip(259), strip(count)) is shifted  # type: ignore[arg-type]


@pytest.mark.parametrize("placed_m, told", [(0.3, True), (0.0, False)])
def test_what_moved_is_placed_before_it_is_told(placed_m: float, told: bool) -> None:
    """What lies where it lay once it is placed did not move."""

    def shifted(by: float) -> np.ndarray:
        T = np.eye(4)
        T[0, 3] = by
        return T

    detector = SimpleNamespace(
        _has_moved=lambda old, T: T[0, 3] > 0.01, _place=lambda old, new, T: shifted(placed_m),
        _with_turn=lambda old, new, fit: fit,
    )  # fmt: skip
    fit = Fit(shifted(0.27), share=0.9, seen=1.0, color_apart=0.0)
    thing = Candidate(2, (2,), np.arange(3), 1.0, 1.0, 0.0)
    change = ChangeDetector._motion_change(detector, thing, thing, fit)  # type: ignore[arg-type]
    assert (change is not None) is told
    if change is not None:
        assert change.fit is not None and change.T_new_old is not None
        assert change.T_new_old[0, 3] == change.fit.T_new_old[0, 3] == placed_m and change.fit.share == 0.9
