# SPDX-License-Identifier: Apache-2.0
"""Whole runs on the shared recordings: short ones always (where the recordings are), full ones with `-m slow`.

Quality only; speed is the benchmarks' business.
"""

from __future__ import annotations

import sys
from pathlib import Path
from typing import Any

import pytest

from ggslam.jobs.eval.run import score_run
from ggslam.jobs.progress import SilentObserver
from ggslam.jobs.run.pipeline import RunRequest, execute
from ggslam.runs.folder import RunFolder
from ggslam.runs.recordings import SequenceRequest, open_recording_of
from ggslam.runs.records.metrics import MetricsRecord

sys.path.insert(0, str(Path(__file__).parents[1] / "scripts" / "tools"))
from scramble_masks import scramble_recording  # noqa: E402


def run(recording: Path, out: Path, overrides: list[str], **selection: Any) -> tuple[MetricsRecord, list[str]]:
    """Metrics of a run at 320x240, without LPIPS, and the status of each frame."""
    if not recording.is_dir():
        pytest.skip(f"no recording at {recording}")
    outcome = execute(RunRequest(SequenceRequest(recording, scale=0.5, **selection), out, None, overrides, False))
    assert outcome.error is None
    metrics = score_run(outcome.folder, open_recording_of(outcome.folder), SilentObserver(), lpips=False)
    return metrics, [frame.status for frame in outcome.result.frames]


@pytest.mark.long("a true recording shows what a generated one does not")
def test_livingroom_begins_well(shared_data: Path, tmp_path: Path) -> None:
    m, status = run(shared_data / "livingroom", tmp_path / "run", [], stop=20)
    assert "lost" not in status
    assert m.trajectory.ate_rmse_m < 0.0005
    assert m.images.held_out.psnr > 31 and m.images.all.depth_l1_m < 0.012


@pytest.mark.long("a true recording shows what a generated one does not")
def test_redkitchen_begins_well(shared_data: Path, tmp_path: Path) -> None:
    m, status = run(shared_data / "redkitchen", tmp_path / "run", [], stop=20)
    assert "lost" not in status
    assert m.trajectory.ate_rmse_m < 0.02
    assert m.images.held_out.psnr > 21 and m.images.all.psnr_unmasked > 20


@pytest.mark.slow
def test_shelf_is_tracked_to_the_end(shared_data: Path, tmp_path: Path) -> None:
    m, status = run(shared_data / "shelf", tmp_path / "run", ["mapping.iterations_per_frame=8"])
    assert len(status) == 15 and "lost" not in status
    assert m.trajectory.ate_rmse_m < 0.03


@pytest.mark.slow
def test_livingroom(shared_data: Path, tmp_path: Path) -> None:
    m, _ = run(shared_data / "livingroom", tmp_path / "run", [])
    assert m.images.held_out.psnr >= 35.0 and m.map.gaussians <= 120_000
    assert m.segmentation.held_out.miou >= 0.97
    assert m.trajectory.ate_rmse_m <= 0.0005 and m.images.all.depth_l1_m <= 0.008


@pytest.mark.slow
def test_livingroom_one_iteration(shared_data: Path, tmp_path: Path) -> None:
    m, _ = run(shared_data / "livingroom", tmp_path / "run", ["mapping.iterations_per_frame=1"])
    assert m.images.held_out.psnr >= 31.5


@pytest.mark.slow
def test_livingroom_refined(shared_data: Path, tmp_path: Path) -> None:
    m, _ = run(shared_data / "livingroom", tmp_path / "run", ["refine_iterations=1000"])
    assert m.images.held_out.psnr >= 37.0


@pytest.mark.slow
def test_redkitchen(shared_data: Path, tmp_path: Path) -> None:
    m, status = run(shared_data / "redkitchen", tmp_path / "run", [])
    assert "lost" not in status
    assert m.images.held_out.psnr >= 24.0 and m.images.all.psnr_unmasked >= 21.0
    assert m.trajectory.ate_rmse_m <= 0.03


@pytest.mark.slow
def test_cabinet_is_tracked_to_the_end(shared_data: Path, tmp_path: Path) -> None:
    recording = shared_data / "rgbd_dataset_freiburg3_cabinet"
    _, status = run(recording, tmp_path / "run", ["mapping.iterations_per_frame=8"])
    assert len(status) == 58 and "lost" not in status


@pytest.mark.slow
def test_livingroom_with_ids_shuffled_in_every_frame(shared_data: Path, tmp_path: Path) -> None:
    """A fifth of the segments is split, a twentieth dropped, a hundredth of the pixels are dots."""
    recording = shared_data / "livingroom"
    scramble_recording(recording, tmp_path / "masks", 0, 0.2, 0.05, 0.01)
    run(recording, tmp_path / "run", [], masks=tmp_path / "masks")
    true_masks = recording / "semantic_instance"
    folder = RunFolder(tmp_path / "run")
    truth = open_recording_of(folder, masks=true_masks)
    segmentation = score_run(folder, truth, SilentObserver(), lpips=False, masks=true_masks).segmentation
    assert segmentation.matching == "assignment" and segmentation.held_out.miou >= 0.85


@pytest.mark.slow
def test_redkitchen_without_masks(shared_data: Path, tmp_path: Path) -> None:
    m, _ = run(shared_data / "redkitchen", tmp_path / "run", ["masks.source=geometry"])
    assert m.segmentation.matching == "assignment" and m.segmentation.held_out.accuracy > 0.75
