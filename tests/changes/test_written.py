# SPDX-License-Identifier: Apache-2.0
"""Changes as files: numbers, and pictures with boxes where things were and are."""

from __future__ import annotations

import json
from pathlib import Path

import cv2
import numpy as np
import pytest
from small_visits import Box, SmallVisit

from ggslam.changes.change_table import ChangeTable
from ggslam.changes.detection import ChangeDetector
from ggslam.changes.settings import ChangeSettings
from ggslam.jobs.changes.changes import ChangesOutcome, write_changes
from ggslam.jobs.changes.pictures import PictureTuning
from ggslam.native.loader import NativeContext


@pytest.mark.long("shapes are compared from starts all around")
def test_every_change_has_numbers_and_a_picture(tmp_path: Path) -> None:
    old, new = SmallVisit([Box(2, (-0.2, 0.1))]), SmallVisit([Box(2, (0.2, -0.1)), Box(3, (-0.2, 0.15), hue=2)])
    visits, context = (old.build(), new.build()), NativeContext(2)
    detector = ChangeDetector(*visits, ChangeSettings(), context)
    table = ChangeTable(detector.detect(), detector.judged, ({2: "cup"}, {2: "cup", 3: "crate"}))
    written = write_changes(ChangesOutcome(table, visits, detector, 0.0, context), tmp_path / "out", "a", "b")
    values = json.loads((tmp_path / "out" / "changes.json").read_text())
    assert [values["old"], values["new"]] == ["a", "b"] and len(written) == 3
    by_kind = {entry["kind"]: entry for entry in values["changes"]}
    assert set(by_kind) == {"moved", "added"} and by_kind["moved"]["name"] == "cup (2)"
    assert np.allclose(np.array(by_kind["moved"]["T_new_old"])[:3, 3], (0.4, -0.2, 0), atol=0.01)
    assert by_kind["added"]["old"] is None and by_kind["added"]["new"]["ids"] == [3]
    names = [str(tmp_path / "out" / by_kind[kind]["picture"]) for kind in ("moved", "added")]
    moved, added = (cv2.imread(name)[..., ::-1] for name in names)
    assert has_color(moved, PictureTuning.old_color) and has_color(moved, PictureTuning.new_color)
    assert has_color(added, PictureTuning.new_color) and not has_color(added, PictureTuning.old_color)


def has_color(picture: np.ndarray, color: tuple[int, int, int]) -> bool:
    return bool((np.abs(picture.astype(int) - color).max(2) < 12).sum() > 15)
