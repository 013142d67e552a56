# SPDX-License-Identifier: Apache-2.0
"""`ggslam eval`: score a run."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from ggslam.cli import options
from ggslam.cli.console import console, progress_bar
from ggslam.cli.observer import ProgressObserver
from ggslam.cli.summary import print_scores

EPILOG = """
[bold]Examples[/]

  ggslam eval runs/kitchen

  ggslam eval runs/kitchen --sequence elsewhere/kitchen

  ggslam eval runs/kitchen --masks kitchen/true_masks
"""


def evaluate(
    run: options.RunPath,
    sequence: options.MovedSequence = None,
    lpips: Annotated[bool, typer.Option("--lpips/--no-lpips", help="Also score LPIPS (needs its weights).")] = True,
    every: Annotated[int, typer.Option(help="Score only every n-th frame.", min=1)] = 1,
    masks: Annotated[
        Path | None, typer.Option(help="Folder with true instance masks, instead of the recording's own.")
    ] = None,
) -> None:
    """Score a run against its recording: trajectory, images and objects of keyframes, held-out and all frames."""
    from ggslam.jobs.report.pages import write_report
    from ggslam.jobs.run.evaluate_run import evaluate_folder
    from ggslam.runs.folder import RunFolder
    from ggslam.runs.recordings import open_recording_of

    folder = RunFolder.open(run)
    recording = open_recording_of(folder, sequence, masks)
    with progress_bar() as bar:
        metrics = evaluate_folder(folder, recording, ProgressObserver(bar), lpips, every, masks)
    print_scores(metrics)
    for path in (folder.path / "metrics.json", write_report(folder, recording)):
        console.print(f"wrote {path}", highlight=False, markup=False)
