# SPDX-License-Identifier: Apache-2.0
"""Reports of real runs: after a run, after scoring, of older and damaged folders, of several."""

from __future__ import annotations

import json
import shutil
from pathlib import Path

import numpy as np
import pytest
from test_run_page import checked
from typer.testing import CliRunner

from ggslam.cli.main import app
from ggslam.errors import FormatError, RunFolderError
from ggslam.jobs.eval.run import score_run
from ggslam.jobs.progress import SilentObserver
from ggslam.jobs.report.gather import load_run
from ggslam.jobs.report.pages import write_comparison, write_report
from ggslam.runs.folder import RunFolder
from ggslam.runs.recordings import open_recording_of
from ggslam.slam.step_log import COLUMNS, read_table


@pytest.fixture(scope="module")
def small(room_run: RunFolder, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A run of ten frames, not scored."""
    return Path(shutil.copytree(room_run.path, tmp_path_factory.mktemp("reports") / "small"))


@pytest.fixture
def copied(small: Path, tmp_path: Path) -> RunFolder:
    shutil.copytree(small, tmp_path / "run")
    return RunFolder.open(tmp_path / "run")


def words(path: Path) -> str:
    return " ".join(checked(path.read_text()).words)


def test_a_run_writes_its_steps_and_a_report(small: Path) -> None:
    steps = read_table(small / "steps.csv")
    assert tuple(steps) == COLUMNS
    np.testing.assert_array_equal(steps["frame"], range(10))
    assert steps["iterations"].tolist() == [10] + 9 * [2]
    timing = json.loads((small / "timing.json").read_text())
    assert steps["end_s"][-1] == pytest.approx(timing["wall_s"], rel=1e-4) and (np.diff(steps["end_s"]) > 0).all()
    assert steps["tracking_ms"].sum() == pytest.approx(1e3 * timing["tracking_s"], rel=1e-4)
    assert timing["refine_iterations"] == 20 and timing["mapping"]["iterations"] == 48  # 20 were asked for
    assert (steps["forward_ms"] > 0).all()
    assert steps["forward_ms"].sum() < 1e3 * timing["mapping"]["forward"]  # the rest is the steps after the last frame
    assert steps["keyframe"][0] == 1
    assert timing["gaussians"] == len(RunFolder.open(small).gaussians())
    assert timing["gaussians"] < steps["gaussians"][-1]  # what surfaces hide went before the refinement
    assert (steps["resident_mb"] > 50).all() and (steps["resident_mb"] <= 1.001 * timing["peak_rss_mb"]).all()
    weighted = 0.8 * steps["loss_color"] + 0.2 * (1 - steps["loss_ssim"]) + 0.6 * steps["loss_depth"]
    np.testing.assert_allclose(steps["loss_total"], weighted, rtol=1e-3)
    found = checked((small / "report.html").read_text())
    assert "This run was not scored" in " ".join(found.words)
    assert found.counts["img"] == 4 * 7  # recorded and rendered, their difference, the same of depth; objects
    assert RunFolder.open(small).mark().versions()["torch"]


def test_errors_over_time_agree_with_the_score(copied: RunFolder) -> None:
    recording = open_recording_of(copied)
    metrics = score_run(copied, recording, SilentObserver(), lpips=False)
    run = load_run(copied)  # the truth from the folder alone
    assert run.camera_path.error_m is not None
    rms = float(np.sqrt((run.camera_path.error_m**2).mean()))
    assert rms == pytest.approx(metrics.trajectory.ate_rmse_m, rel=1e-4)
    text = words(write_report(copied, recording))
    assert f"{metrics.images.all.psnr:.2f}" in text and "This run was not scored" not in text
    assert "LPIPS was not scored." in text


def test_an_older_run_whose_recording_is_gone_has_a_report(copied: RunFolder) -> None:
    for name in ("steps.csv", "ground_truth.txt", "report.html", "timing.json", "loops.json", "config.yaml"):
        (copied.path / name).unlink(missing_ok=name == "ground_truth.txt")  # runs that are not scored write none
    mark = {"ggslam": "0.0.1", "complete": True, "stopped_by": None}
    (copied.path / "run.json").write_text(json.dumps(mark))
    record = json.loads((copied.path / "sequence.json").read_text())
    record["open"]["path"] = str(copied.path / "gone")
    (copied.path / "sequence.json").write_text(json.dumps(record))
    found = checked(write_report(copied).read_text())
    text = " ".join(found.words)
    assert "the recording is not where it was" in text and "did not note its steps" in text
    assert found.counts["img"] == 4 * 3  # rendered colour, depth, objects


def test_damaged_files_are_named(copied: RunFolder) -> None:
    (copied.path / "steps.csv").write_text("frame,step_ms\n1\n")
    with pytest.raises(FormatError, match=r"steps\.csv.* 2.* 2 .* 1"):
        write_report(copied)
    (copied.path / "steps.csv").unlink()
    (copied.path / "timing.json").write_text("[]")
    with pytest.raises(RunFolderError, match=r"timing\.json"):
        write_report(copied)


@pytest.mark.parametrize("damage", [
    ("keyframes.json", "[]"), ("sequence.json", '{"open": 3, "camera": {}}'), ("run.json", '{"environment": "x"}'),
    ("steps.csv", "frame,step_ms,gaussians\nx,x,x\n"), ("timing.json", '{"frames": NaN, "tracking_s": 3}'),
])  # fmt: skip
def test_no_damage_ends_in_a_traceback(copied: RunFolder, damage: tuple[str, str]) -> None:
    (copied.path / damage[0]).write_text(damage[1])
    with pytest.raises((RunFolderError, FormatError)):
        write_report(copied)


def test_settings_that_are_no_text_are_told(copied: RunFolder) -> None:
    (copied.path / "config.yaml").write_bytes(b"seed: \xe9\xff")
    with pytest.raises(RunFolderError, match="config.yaml"):
        write_report(copied)


def test_a_page_compares_runs_and_plots_are_files(copied: RunFolder, small: Path, tmp_path: Path) -> None:
    other = tmp_path / "other" / "small"  # of one name with the first: the folders above tell them apart
    shutil.copytree(small, other)
    (other / "steps.csv").unlink()
    folders = [RunFolder.open(small), RunFolder.open(other)]
    page = write_comparison(folders, tmp_path / "out" / "page.html", tmp_path / "figures")
    found = checked(page.read_text())
    assert found.counts["img"] == 3 * 3
    text = " ".join(found.words)
    assert "other/small" in text and "All settings are equal." in text
    names = {path.name for path in (tmp_path / "figures").iterdir()}
    assert {"trajectory_top.svg", "trajectory_top.png", "memory.svg", "loss.png"} <= names


def test_the_command_writes_pages(copied: RunFolder, small: Path, tmp_path: Path) -> None:
    run = CliRunner()
    (copied.path / "report.html").unlink()
    done = run.invoke(app, ["report", str(copied.path), "--plots", str(tmp_path / "plots")])
    assert done.exit_code == 0 and (copied.path / "report.html").is_file()
    assert (tmp_path / "plots" / "gaussians.svg").is_file()
    page = tmp_path / "c.html"
    assert run.invoke(app, ["report", str(copied.path), str(small), "--out", str(page)]).exit_code == 0
    checked(page.read_text())
    refused = run.invoke(app, ["report", str(copied.path), "--out", str(page)])
    assert "--out is for the comparison" in str(refused.exception)


def test_a_folder_named_like_markup_is_no_markup(copied: RunFolder) -> None:
    odd = copied.path.with_name("<script>alert('1')<")
    copied.path.rename(odd)
    found = checked(write_report(RunFolder.open(odd)).read_text())
    assert found.counts["script"] == 1 and odd.name in found.words
