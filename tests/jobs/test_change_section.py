# SPDX-License-Identifier: Apache-2.0
"""What changed, in the report of an updated run."""

from __future__ import annotations

import json
from pathlib import Path

import cv2
import numpy as np
import pytest

from ggslam.errors import ConfigError, RunFolderError
from ggslam.jobs.changes.saved_changes import ChangesShown, changes_of, read_changes, sentence_of
from ggslam.jobs.report.change_section import changes_part
from ggslam.objects.history import History, VisitRecord
from ggslam.runs.folder import RunFolder
from ggslam.runs.records.changes import ChangesRecord

MOVED = {
    "kind": "moved", "name": "mug <7>", "confidence": 0.9, "old": {"ids": [7], "not_there": 0.97},
    "new": {"ids": [7], "not_there": 1.0}, "T_new_old": np.eye(4).tolist(), "turn_known": False, "moved_m": 0.123,
    "turned_deg": 41.0, "picture": "change00_moved.png",
}  # fmt: skip
REMOVED = {"kind": "removed", "name": "milk (2)", "confidence": 0.8, "old": {"ids": [2], "not_there": 1.0}, "new": None}
RECORD = {
    "old": "runs/monday", "new": "runs/tuesday", "changes": [MOVED, REMOVED],
    "unseen": [{"name": "lamp (5)", "ids": [5]}],
}  # fmt: skip


def folder_with(tmp_path: Path, record: dict | None) -> RunFolder:
    """A run's folder with changes, and a picture of the first."""
    (tmp_path / "keyframes.json").write_text("{}")
    if record is not None:
        (tmp_path / "changes").mkdir()
        (tmp_path / "changes" / "changes.json").write_text(json.dumps(record))
        picture = np.zeros((20, 40, 3), np.uint8)
        cv2.imwrite(str(tmp_path / "changes" / "change00_moved.png"), picture)
    return RunFolder(tmp_path)


def test_what_changed_is_told_with_pictures_and_what_was_not_seen(tmp_path: Path) -> None:
    shown = changes_of(folder_with(tmp_path, RECORD))
    assert shown is not None and list(shown.pictures) == [0]
    page = changes_part(shown)
    assert "mug &lt;7&gt;: moved" in page
    for words in ("mug &lt;7&gt;", "12.3", "not known", "milk (2)", "removed", "lamp (5)", "runs/monday", "97"):
        assert words in page
    assert "41" not in page and page.count("<img") == 1  # a turn that is not known is not told


def test_a_picture_that_is_not_there_leaves_the_table(tmp_path: Path) -> None:
    folder = folder_with(tmp_path, RECORD)
    (tmp_path / "changes" / "change00_moved.png").unlink()
    shown = changes_of(folder)
    assert shown is not None and not shown.pictures and "12.3" in changes_part(shown)
    assert "missing or damaged: change00_moved.png" in changes_part(shown)


def test_pictures_that_are_not_shown_are_counted(tmp_path: Path) -> None:
    folder = folder_with(tmp_path, {**RECORD, "changes": [MOVED, MOVED, MOVED]})
    shown = changes_of(folder, most=1)
    assert shown is not None and list(shown.pictures) == [0]
    assert "2 more changes have pictures that are not shown here." in changes_part(shown)


def test_a_folder_without_changes_is_refused(tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match=r"changes\.json"):
        read_changes(tmp_path)


def test_a_change_in_a_line() -> None:
    moved, removed = ChangesRecord.of(RECORD).changes
    assert sentence_of(moved) == "mug <7>: moved by 12.3 cm, turn not known"
    assert sentence_of(removed) == "milk (2): removed"
    turned = moved.model_copy(update={"turn_known": True})
    assert sentence_of(turned) == "mug <7>: moved by 12.3 cm, turned by 41.0 deg"


def test_pictures_are_of_the_folder_of_changes_alone(tmp_path: Path) -> None:
    cv2.imwrite(str(tmp_path / "secret.png"), np.zeros((20, 40, 3), np.uint8))
    shown = changes_of(folder_with(tmp_path, {"changes": [{**MOVED, "picture": "../secret.png"}]}))
    assert shown is not None and not shown.pictures


def test_nothing_that_changed_is_said() -> None:
    assert "Nothing was found that changed." in changes_part(ChangesShown(ChangesRecord()))


def test_a_run_that_is_no_updated_one_has_no_such_part(tmp_path: Path) -> None:
    assert changes_of(folder_with(tmp_path, None)) is None


def test_a_damaged_file_is_named(tmp_path: Path) -> None:
    with pytest.raises(RunFolderError, match=r"changes\.json.*confidence"):
        changes_of(folder_with(tmp_path, {"changes": [{"kind": "moved", "name": "mug"}]}))

    change = {"kind": "moved", "name": "mug", "confidence": 0.5, "T_new_old": [[1, 2], [3]]}
    (tmp_path / "other").mkdir()
    with pytest.raises(RunFolderError, match=r"changes\.json.*T_new_old"):
        changes_of(folder_with(tmp_path / "other", {"changes": [change]}))


def test_the_past_of_objects_is_told_by_visit() -> None:
    moved = np.eye(4)
    moved[0, 3] = 0.2
    history = History.of_first(VisitRecord("runs/monday", "a"), {1: "table", 2: "milk", 7: "mug"})
    history = history.after_visit(VisitRecord("runs/tuesday", "b"), {1: "table", 7: "mug", 9: None}, [2], {7: moved})
    page = changes_part(ChangesShown(ChangesRecord(), history=history))
    rows = {row.split("</th>")[0].split(">")[-1]: row for row in page.split("<tr>")}
    assert "visit 2: elsewhere" in rows["mug (7)"] and "visit 2: there" in rows["table (1)"]
    assert rows["milk (2)"].count(">1<") == 2 and ">2<" in rows["milk (2)"]  # seen by the first, gone since the second
    assert rows["object 9"].count(">2<") == 2


def test_how_far_an_object_went_is_told_where_its_place_is_known() -> None:
    turned = np.array([[0, -1, 0, 0], [1, 0, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1.0]])  # about the origin, by 90 degrees
    history = History.of_first(VisitRecord("runs/monday", "a"), {7: "mug"})
    history = history.after_visit(VisitRecord("runs/tuesday", "b"), {7: "mug"}, [], {7: turned})
    page = changes_part(ChangesShown(ChangesRecord(), history=history, middles={7: (0.0, 0.3, 0.0)}))
    assert "visit 2: 42.4 cm away" in page  # from (0.3, 0, 0)
