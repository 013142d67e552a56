# SPDX-License-Identifier: Apache-2.0
"""`ggslam update`: a run and a later visit become a run of the latest state."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
from command_line import ggslam, refuse, succeed
from kept import session_folder
from small_runs import run_of

from ggslam.jobs.update.update import update_run
from ggslam.merging.settings import MergeSettings
from ggslam.runs.folder import RunFolder

pytest.importorskip("gtsam")
FEW = MergeSettings(steps=4)


@pytest.fixture(scope="module")
def visits(room: Path, tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Path]:
    """Two runs of pieces of one recording: nothing changed between them."""
    folder = session_folder(tmp_path_factory) / "merging"
    return run_of(room, folder / "first", 0, 16), run_of(room, folder / "second", 8, 24)


@pytest.fixture(scope="module")
def updated(visits: tuple[Path, Path], tmp_path_factory: pytest.TempPathFactory) -> RunFolder:
    return update_run(*visits, tmp_path_factory.mktemp("updated") / "run", merging=FEW).folder


@pytest.mark.long("two runs of a generated room are made, compared and joined")
def test_where_nothing_changed_both_maps_are_one(visits: tuple[Path, Path], updated: RunFolder) -> None:
    table, runs = updated.object_table(), [RunFolder.open(path) for path in visits]
    assert set(table.ids()) == set(runs[0].object_table().ids()) | set(runs[1].object_table().ids())
    assert len(updated.keyframes().frames) == 32
    assert np.isfinite(updated.gaussians().means.numpy()).all()
    history = table.history
    assert history is not None and [visit.run for visit in history.visits] == [str(path) for path in visits]
    seen_twice = set(runs[0].object_table().ids()) & set(runs[1].object_table().ids())
    for past in history.objects:
        assert past.gone_since is None and (past.last_seen == 1) == (past.id in runs[1].object_table().ids())
        if past.id in seen_twice:
            assert np.array_equal(past.T_now_first[1], np.eye(4))
    assert json.loads((updated.path / "changes" / "changes.json").read_text())["changes"] == []
    succeed("verify", updated.path)


def test_images_of_the_earlier_visit_are_not_scored(updated: RunFolder) -> None:
    said = succeed("eval", updated.path, "--no-lpips")
    metrics = updated.metrics()
    assert metrics is not None and metrics.images.all is not None
    assert metrics.images.all.frames == 16 and "16 frames of earlier visits" in " ".join(said.split())
    assert metrics.images.all.psnr > 15


@pytest.mark.long("an updated run is updated again")
def test_an_updated_run_is_updated_again(visits: tuple[Path, Path], updated: RunFolder, tmp_path: Path) -> None:
    done = succeed("update", updated.path, visits[0], "--out", tmp_path / "again", "--steps", "0")
    assert "nothing changed" in done
    again = RunFolder.open(tmp_path / "again")
    history = again.object_table().history
    assert history is not None and len(history.visits) == 3
    assert {past.last_seen for past in history.objects} == {1, 2}
    assert [part.past for part in again.sequence().parts or []] == [True, True, False]
    assert "brought up to date by" in " ".join(again.mark().notes())


def test_what_cannot_be_updated_is_refused(visits: tuple[Path, Path], tmp_path: Path) -> None:
    refuse(ggslam("update", visits[0], tmp_path / "nothing", "--out", tmp_path / "out"), "nothing")
    refuse(ggslam("update", *visits, "--out", visits[0]), "is one of the runs")
    assert not (tmp_path / "out").exists()
    assert ggslam("update", visits[0]).returncode == 2
