# SPDX-License-Identifier: Apache-2.0
"""The scores of a run in one call."""

from __future__ import annotations

from pathlib import Path

from ggslam.jobs.eval.run import score_run
from ggslam.jobs.progress import Observer, SilentObserver
from ggslam.jobs.run.run_verdict import judge_scores
from ggslam.runs.folder import RunFolder
from ggslam.runs.recordings import open_recording_of
from ggslam.runs.records.metrics import MetricsRecord
from ggslam.runs.records.verdict import RunVerdict
from ggslam.sequences import Sequence


def evaluate_run(
    run: str | Path | RunFolder,
    *,
    recording: str | Path | None = None,
    masks: str | Path | None = None,
    lpips: bool = True,
    every: int = 1,
    observer: Observer | None = None,
) -> MetricsRecord:
    """Scores a run against its recording, as `ggslam eval` does: trajectory, images, objects.

    Args:
        run: the run, or its folder.
        recording: where the recording is now, if it was moved.
        masks: folder of true instance masks, if not the recording's own.
        lpips: also LPIPS, if its weights are there.
        every: score the images of every n-th frame only.
        observer: receives progress updates.

    Returns:
        What was written to the run's metrics.json, see `docs/formats.md`. The run's verdict.json is renewed likewise.

    Raises:
        RunFolderError: no run, or a damaged one, or its frames were not kept.
        SequenceError: the recording is not there any more.
    """
    folder = run if isinstance(run, RunFolder) else RunFolder.open(Path(run))
    truth = None if masks is None else Path(masks)
    sequence = open_recording_of(folder, None if recording is None else Path(recording), truth)
    return evaluate_folder(folder, sequence, observer or SilentObserver(), lpips, every, truth)


def evaluate_folder(
    folder: RunFolder, sequence: Sequence, observer: Observer, lpips: bool = True, every: int = 1,
    masks: Path | None = None,
) -> MetricsRecord:  # fmt: skip
    """As `evaluate_run`, of a recording that is open already."""
    metrics = score_run(folder, sequence, observer, lpips=lpips, every=every, masks=masks)
    _renew_verdict(folder, metrics)
    return metrics


def _renew_verdict(folder: RunFolder, metrics: MetricsRecord) -> None:
    """Lets the verdict on a run, if it has one, go with its new scores."""
    verdict = folder.verdict()
    if verdict is None:
        return
    table = folder.object_table() if folder.has_objects() else None
    with folder.change_files(RunVerdict.FILE):
        judge_scores(verdict, table, metrics).write(folder.path)
