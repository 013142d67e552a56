# SPDX-License-Identifier: Apache-2.0
"""What `bench_sensitivity.py` changes, and what it takes for idle."""

from __future__ import annotations

import sys
from pathlib import Path

import pytest

sys.path.insert(0, str(Path(__file__).parents[2] / "scripts" / "benchmarks"))
import bench_sensitivity as bench  # noqa: E402

from ggslam.geometry.scene_size import SceneSizeTuning  # noqa: E402
from ggslam.slam.config import load_config  # noqa: E402


def test_values_stay_in_their_ranges() -> None:
    assert bench.other_values(4, 1, 1000) == [2, 8]
    assert bench.other_values(1, 1, 16) == [2]
    assert bench.other_values(0, 0, 3) == [1]
    assert bench.other_values(0.6, 0, 1) == [0.3, 1.0]
    assert bench.other_values(True) == [False] and bench.other_values("auto") == []


def test_every_internal_number_can_be_changed() -> None:
    changes = list(bench.setting_changes(["mapping.", "loops."], internal=True))
    assert len(changes) > 100 and not any(change.name == "mapping.iterations_per_frame" for change in changes)
    for change in changes:
        load_config(None, change.overrides)


def test_tuning_holds_another_value_meanwhile() -> None:
    changes = [c for c in bench.tuning_changes(["geometry"]) if c.name == "geometry.SceneSizeTuning:near_m"]
    assert [change.value for change in changes] == [0.5, 2.0] and SceneSizeTuning.near_m == 1.0
    with bench.applied(changes[0]):
        assert SceneSizeTuning.near_m == 0.5
    assert SceneSizeTuning.near_m == 1.0


@pytest.mark.parametrize(("hashes", "idle"), [(("a", "a"), True), (("a", "b"), False), (("a", ""), True)])
def test_idle_is_what_leaves_the_run_as_it_is(tmp_path: Path, hashes: tuple[str, str], idle: bool) -> None:
    table = bench.Table(tmp_path / "rows.csv")
    table.add({"recording": "room", "number": bench.BASE, "value": "", "hash": "a"})
    for value, found in zip((1, 4), hashes, strict=True):
        table.add({"recording": "room", "number": "loops.x", "value": value, "hash": found})
    again = bench.Table(tmp_path / "rows.csv")
    assert again.is_idle("room", "loops.x") is idle and not again.is_idle("desk", "loops.x")
    assert again.row("room", "loops.x", 4) is not None and again.row("room", "loops.x", 5) is None
