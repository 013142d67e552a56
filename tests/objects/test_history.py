# SPDX-License-Identifier: Apache-2.0
"""What became of objects from visit to visit, and how it is kept."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from ggslam.errors import FormatError
from ggslam.objects.history import History, VisitRecord
from ggslam.objects.table import ObjectTable


def shift(x: float) -> np.ndarray:
    T = np.eye(4)
    T[0, 3] = x
    return T


@pytest.fixture
def history() -> History:
    """A cup that is moved twice, a crate that goes and comes back, a plate that comes."""
    first = History.of_first(VisitRecord("monday", "a"), {1: "cup", 2: "crate"})
    second = first.after_visit(VisitRecord("tuesday", "b"), {1: None, 3: "plate"}, {2}, {1: shift(0.2)})
    return second.after_visit(VisitRecord("wednesday", "c"), {1: None, 2: None}, set(), {1: shift(0.3)})


def test_objects_are_followed_from_visit_to_visit(history: History) -> None:
    cup, crate, plate = history.objects
    assert [visit.run for visit in history.visits] == ["monday", "tuesday", "wednesday"]
    assert (cup.name, cup.first_seen, cup.last_seen, cup.gone_since) == ("cup", 0, 2, None)
    assert [np.array(cup.T_now_first[k])[0, 3] for k in range(3)] == pytest.approx([0, 0.2, 0.5])
    assert (crate.first_seen, crate.last_seen, crate.gone_since) == (0, 2, None)
    assert sorted(crate.T_now_first) == [0, 2]
    assert (plate.first_seen, plate.last_seen) == (1, 1)  # the last visit did not see it, and says nothing of it


def test_what_is_gone_stays_in_the_history(history: History) -> None:
    after = history.after_visit(VisitRecord("thursday", "d"), {1: None}, {2, 9}, {})
    assert after.ids_gone() == {2} and after.objects[1].gone_since == 3
    assert history.ids_gone() == set()  # the former is as it was


def test_a_table_keeps_its_history(history: History, tmp_path: Path) -> None:
    table = ObjectTable("masks", 0, history=history)
    table.save(tmp_path / "objects.json")
    assert ObjectTable.load(tmp_path / "objects.json").history == history
    replace(table, history=None).save(tmp_path / "objects.json")
    assert "history" not in (tmp_path / "objects.json").read_text()


@pytest.mark.parametrize(("old", "new"), [('"first_seen": 0', '"first_seen": -1'), ('"id": 3', '"id": 70000')])
def test_a_damaged_history_is_refused(history: History, tmp_path: Path, old: str, new: str) -> None:
    path = tmp_path / "objects.json"
    ObjectTable("masks", 0, history=history).save(path)
    assert old in path.read_text()
    path.write_text(path.read_text().replace(old, new, 1))
    with pytest.raises(FormatError, match="objects.json"):
        ObjectTable.load(path)
