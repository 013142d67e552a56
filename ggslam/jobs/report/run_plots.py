# SPDX-License-Identifier: Apache-2.0
"""The plots of one run, or of several laid over each other."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np

from ggslam.jobs.report.run_data import RunData
from ggslam.reporting.plots import Band, Plot, PlotTuning, Series
from ggslam.system.tuning import Tuning

FRAME = "frame"


class RunPlotTuning(Tuning):
    """How a run is plotted."""

    truth_color = 7
    """Number of the colour of the true trajectory."""
    smoothed_frames = 9
    """Frames over which losses are averaged: each loss is of the few keyframes that were drawn."""


def trajectory_plots(runs: Sequence[RunData]) -> list[Plot]:
    """The camera's path from above and from the side, with the truth if it is known; of several runs, which are in
    one world, in the directions of the first."""
    level = runs[0].camera_path.level
    right, forward, up = level.axes
    height, ground = ("height above the floor (m)", level.floor) if level.floor is not None else ("height (m)", 0.0)
    views = (
        ("trajectory_top", "From above", "right (m)", "forward (m)", lambda p: (p @ right, p @ forward)),
        ("trajectory_side", "From the side", "forward (m)", height, lambda p: (p @ forward, p @ up - ground)),
    )
    return [Plot(name, title, x, y, _paths(runs, project), equal=True) for name, title, x, y, project in views]


def _paths(runs: Sequence[RunData], project: Callable[[np.ndarray], tuple[np.ndarray, np.ndarray]]) -> list[Series]:
    series = []
    known = next((run.camera_path for run in runs if run.camera_path.truth is not None), None)
    if known is not None and known.truth is not None:
        series.append(
            Series("truth", *project(known.in_order(known.truth)), color=RunPlotTuning.truth_color, dashed=True)
        )
    for number, run in enumerate(runs):
        label = "estimate" if len(runs) == 1 else run.name
        path = run.camera_path
        series.append(_curve(label, *project(path.in_order(path.positions)), number))
    if len(runs) == 1:
        path = runs[0].camera_path
        made = np.isin(path.frames, runs[0].keyframes)
        series.append(Series("keyframes", *project(path.positions[made]), kind="dots", color=1))
    return series


def _curve(label: str, x: np.ndarray, y: np.ndarray, number: int) -> Series:
    """The curve of a run among several; after all colours they begin again, dashed."""
    usual = PlotTuning.colors - 1
    return Series(label, x, y, color=number % usual, dashed=number >= usual)


def error_plot(runs: Sequence[RunData]) -> Plot:
    """Distance from the truth over the recording."""
    known = [(n, run) for n, run in enumerate(runs) if run.camera_path.error_m is not None]
    series = [
        _curve(_label(runs, run, "error"), run.camera_path.frames, 100 * run.camera_path.error_m, n)
        for n, run in known if run.camera_path.error_m is not None
    ]  # fmt: skip
    return Plot(
        "trajectory_error", "Distance from the true position, aligned", FRAME, "error (cm)", series, _lost_bands(runs),
        from_zero=True,
    )  # fmt: skip


def _label(runs: Sequence[RunData], run: RunData, words: str) -> str:
    return words if len(runs) == 1 else run.name


def _lost_bands(runs: Sequence[RunData]) -> list[Band]:
    """Stretches of frames without a pose, of a single run."""
    if len(runs) != 1 or "status" not in runs[0].tracked:
        return []
    frames, lost = runs[0].tracked["frame"], runs[0].tracked["status"] == "lost"
    edges = np.flatnonzero(np.diff(np.concatenate([[0], lost.astype(int), [0]])))
    return [Band(frames[a] - 0.5, frames[b - 1] + 0.5, "lost") for a, b in edges.reshape(-1, 2)]


_SCORES = (
    ("psnr", "PSNR", "PSNR (dB)", 1.0), ("ssim", "SSIM", "SSIM", 1.0), ("lpips", "LPIPS", "LPIPS", 1.0),
    ("depth_l1_m", "Depth L1", "depth L1 (cm)", 100.0),
)  # fmt: skip


def score_plots(runs: Sequence[RunData]) -> list[Plot]:
    """Image scores frame by frame; of one run with keyframes and held-out frames marked."""
    plots = []
    for column, title, y_label, factor in _SCORES:
        series: list[Series] = []
        for number, run in enumerate(runs):
            if column not in run.scores or "frame" not in run.scores:
                continue
            frame, value = run.scores["frame"], factor * run.scores[column]
            series.append(_curve(_label(runs, run, "all frames"), frame, value, number))
            if len(runs) == 1 and "kind" in run.scores:
                kinds = run.scores["kind"]
                for kind, label, color in (("keyframe", "keyframes", 1), ("held_out", "held out", 2)):
                    chosen = kinds == kind
                    series.append(Series(label, frame[chosen], value[chosen], "dots", color))
        plots.append(Plot(column, title, FRAME, y_label, series, _lost_bands(runs)))
    return plots


def tracking_plots(runs: Sequence[RunData]) -> list[Plot]:
    """How well frames fitted the map."""
    columns = (
        ("overlap", "Overlap with the map", "overlap (%)", 100.0),
        ("rmse_m", "Fit of the matched points", "fit (mm)", 1000.0),
    )
    return [
        Plot(f"tracking_{column}", title, FRAME, y_label, [
            _curve(_label(runs, run, title), run.tracked["frame"], factor * run.tracked[column], n)
            for n, run in enumerate(runs) if column in run.tracked
        ], _lost_bands(runs), from_zero=column != "overlap")
        for column, title, y_label, factor in columns
    ]  # fmt: skip


def _steps(
    runs: Sequence[RunData], columns: Sequence[tuple[str, str]], change: Callable[[np.ndarray], np.ndarray]
) -> list[Series]:
    """Columns (name, label) of the steps of one run, or the first one of several."""
    if len(runs) > 1:
        return [
            _curve(run.name, run.steps["frame"], change(run.steps[columns[0][0]]), n)
            for n, run in enumerate(runs) if columns[0][0] in run.steps
        ]  # fmt: skip
    steps = runs[0].steps
    return [
        Series(label, steps["frame"], change(steps[name]), color=n)
        for n, (name, label) in enumerate(columns) if name in steps
    ]  # fmt: skip


def time_plots(runs: Sequence[RunData]) -> list[Plot]:
    """Milliseconds a frame."""
    own = _steps(runs, [("step_ms", "whole step"), ("tracking_ms", "tracking"), ("insertion_ms", "inserting")], _as_is)
    plots = [Plot("time", "Time a frame", FRAME, "time (ms)", own, from_zero=True)]
    if len(runs) == 1:
        parts = _steps(runs, [("forward_ms", "rendering"), ("loss_ms", "loss"), ("backward_ms", "gradients"),
                              ("identity_ms", "objects")], _as_is)  # fmt: skip
        plots.append(Plot("time_training", "Training of the map, a frame", FRAME, "time (ms)", parts, from_zero=True))
    return plots


def map_plots(runs: Sequence[RunData]) -> list[Plot]:
    """Gaussians and memory."""
    return [
        Plot("gaussians", "Gaussians of the map", FRAME, "Gaussians (thousands)",
             _steps(runs, [("gaussians", "Gaussians")], lambda v: v / 1000), from_zero=True),
        Plot("memory", "Resident memory of the process", FRAME, "memory (MB)",
             _steps(runs, [("resident_mb", "memory")], _as_is), from_zero=True),
    ]  # fmt: skip


def loss_plots(runs: Sequence[RunData]) -> list[Plot]:
    """What the optimiser made small."""
    note = f"Means over the iterations of {RunPlotTuning.smoothed_frames} frames."
    plots = [
        Plot("loss", "Loss", FRAME, "loss", _steps(runs, [("loss_total", "loss")], _smooth), from_zero=True,
             note=note),
    ]  # fmt: skip
    if len(runs) == 1:
        terms = [("loss_color", "colour, mean absolute difference"), ("loss_depth", "depth (m)")]
        plots.append(Plot("loss_terms", "Its terms, unweighted", FRAME, "value", _steps(runs, terms, _smooth),
                          from_zero=True, note=note))  # fmt: skip
    return plots


def _as_is(values: np.ndarray) -> np.ndarray:
    return values


def _smooth(values: np.ndarray) -> np.ndarray:
    """Running mean of what is finite."""
    known, window = np.isfinite(values), np.ones(RunPlotTuning.smoothed_frames)
    count = np.convolve(known, window, "same")[: len(values)] if len(values) >= RunPlotTuning.smoothed_frames else known
    total = (
        np.convolve(np.where(known, values, 0), window, "same")
        if len(values) >= RunPlotTuning.smoothed_frames
        else values
    )
    with np.errstate(invalid="ignore", divide="ignore"):
        return np.where(known & (count > 0), total / count, np.nan)


def all_plots(runs: Sequence[RunData]) -> list[Plot]:
    """Every plot that has something to show."""
    plots = [
        *trajectory_plots(runs), error_plot(runs), *score_plots(runs), *tracking_plots(runs), *time_plots(runs),
        *map_plots(runs), *loss_plots(runs),
    ]  # fmt: skip
    return [plot for plot in plots if plot.has_data()]
