# SPDX-License-Identifier: Apache-2.0
"""Writes reports: `report.html` of a run, a page that compares several, plots as files."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np

from ggslam.errors import ConfigError, GgslamError
from ggslam.evaluation.trajectory import FEWEST_POSES, align_points
from ggslam.jobs.changes.saved_changes import ChangesShown, changes_of
from ggslam.jobs.report.comparison_page import by_recording, comparison_page
from ggslam.jobs.report.gather import has_limit, load_run, save_truth
from ggslam.jobs.report.run_data import FrameView, RunData
from ggslam.jobs.report.run_page import run_page
from ggslam.jobs.report.run_plots import all_plots
from ggslam.jobs.report.views import RENDER, TRUTH, pick_frames, rendered_views, saved_views
from ggslam.reporting.plot_files import write_plots
from ggslam.runs.folder import RunFolder, as_written
from ggslam.runs.publishing import change_in_run
from ggslam.runs.recordings import open_recording_of
from ggslam.runs.writing import REPORT_FILE, TRUTH_FILE
from ggslam.sequences import Sequence
from ggslam.system.atomic import make_folder, write_text
from ggslam.system.tuning import Tuning


class ComparisonPageTuning(Tuning):
    """What a comparison of runs shows."""

    views = 3
    """Frames that are shown of each run."""


def write_report(folder: RunFolder, sequence: Sequence | None = None, plots: Path | None = None) -> Path:
    """Writes `report.html` into a run's folder; returns its path.

    Args:
        folder: of the run.
        sequence: its recording, if it is open already. Its true poses are kept in the folder then.
        plots: folder to write the plots to as SVG and PNG, too.

    Raises:
        RunFolderError, FormatError: a file of the run is missing or damaged, or a file cannot be written.
    """
    with folder.change_files(REPORT_FILE, TRUTH_FILE), change_in_run(plots):
        return _write_report(folder, sequence, plots)


def _write_report(folder: RunFolder, sequence: Sequence | None, plots: Path | None) -> Path:
    if sequence is not None:
        save_truth(folder, sequence)
    recording = sequence if sequence is not None else _recording(folder)
    views = saved_views(folder)
    if not views and not has_limit(folder):  # a view may see far more than a run with a limit holds
        views = rendered_views(folder, recording, pick_frames(folder.keyframes().poses()))
    run = replace(load_run(folder, recording, views), changes=changes_of(folder))
    path = folder.path / REPORT_FILE
    with as_written(folder.path):
        page = run_page(run)
    write_text(path, page)
    if plots is not None:
        make_folder(plots)
        write_plots(plots, all_plots([run]))
    return path


def _recording(folder: RunFolder) -> Sequence | None:
    """The recording of a run, None if it is not there any more."""
    try:
        return open_recording_of(folder)
    except GgslamError:
        return None


def write_comparison(
    folders: list[RunFolder], out: Path, plots: Path | None = None, changes: ChangesShown | None = None
) -> Path:
    """Writes a page that compares several runs; returns its path.

    Args:
        folders: of the runs, at least two.
        out: the page.
        plots: folder to write the plots to as SVG and PNG, too.
        changes: what changed between two of them.

    Raises:
        ConfigError: fewer than two runs.
        RunFolderError, FormatError: as `write_report`.
    """
    if len(folders) < 2:
        raise ConfigError(f"expected at least two runs to compare, found {len(folders)}")
    recordings = [_recording(folder) for folder in folders]
    runs = _named_apart([load_run(f, recording) for f, recording in zip(folders, recordings, strict=True)])
    groups, views = [], []
    for numbers in by_recording(runs):
        common = set.intersection(*({*runs[i].camera_path.frames.tolist()} for i in numbers))
        frames = pick_frames(common, ComparisonPageTuning.views)
        group = [replace(runs[i], views=rendered_views(folders[i], recordings[i], frames)) for i in numbers]
        groups.append(_in_one_world(group))
        views.append(_same_views(group, frames))
    with as_written(Path(" or ".join(str(folder.path) for folder in folders))):
        page = comparison_page(groups, views, changes)
    make_folder(out.parent)
    write_text(out, page)
    if plots is not None:
        make_folder(plots)
        for number, group in enumerate(groups, start=1):
            prefix = f"{number}_" if len(groups) > 1 else ""
            write_plots(plots, [replace(plot, name=prefix + plot.name) for plot in all_plots(group)])
    return out


def _in_one_world(runs: list[RunData]) -> list[RunData]:
    """Runs of one recording whose paths can be laid over each other: each world is that of the run's first camera,
    and runs may begin at different frames. Paths are laid upon the first one's by the truth of the frames that both
    have, where it is known, else by their own positions."""
    first = runs[0].camera_path
    moved = runs[:1]
    for run in runs[1:]:
        path = run.camera_path
        _, ours, theirs = np.intersect1d(path.frames, first.frames, return_indices=True)
        source, target = path.positions[ours], first.positions[theirs]
        if path.truth is not None and first.truth is not None:
            both = np.isfinite(path.truth[ours]).all(1) & np.isfinite(first.truth[theirs]).all(1)
            if both.sum() >= FEWEST_POSES:
                source, target = path.truth[ours][both], first.truth[theirs][both]
        if len(source) >= FEWEST_POSES:
            T, _ = align_points(source, target)
            truth = None if path.truth is None else path.truth @ T[:3, :3].T + T[:3, 3]
            path = replace(path, positions=path.positions @ T[:3, :3].T + T[:3, 3], truth=truth)
        moved.append(replace(run, camera_path=path))
    return moved


def _same_views(runs: list[RunData], frames: list[int]) -> list[FrameView]:
    """The same frames of each run side by side, and as recorded."""
    views = []
    for k, frame in enumerate(frames):
        recorded = next((r.views[k].pictures[TRUTH] for r in runs if TRUTH in r.views[k].pictures), None)
        pictures = {} if recorded is None else {TRUTH: recorded}
        views.append(FrameView(frame, pictures | {run.name: run.views[k].pictures[RENDER] for run in runs}))
    return views


def _named_apart(runs: list[RunData]) -> list[RunData]:
    """Runs whose folders have one name are told apart by the folders above, or numbers."""
    names = [run.name for run in runs]
    if len(set(names)) < len(names):
        names = ["/".join(Path(run.path).parts[-2:]) for run in runs]
    if len(set(names)) < len(names):
        names = [f"{name} ({number})" for number, name in enumerate(names, start=1)]
    return [replace(run, name=name) for run, name in zip(runs, names, strict=True)]
