# SPDX-License-Identifier: Apache-2.0
"""A page that compares several runs."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import replace

from ggslam.jobs.changes.saved_changes import ChangesShown
from ggslam.jobs.report.change_section import changes_part
from ggslam.jobs.report.metrics import MEANINGS, METRICS, Metric
from ggslam.jobs.report.run_data import FrameView, RunData
from ggslam.jobs.report.run_page import FOOTER
from ggslam.jobs.report.run_plots import (
    error_plot,
    loss_plots,
    map_plots,
    score_plots,
    time_plots,
    tracking_plots,
    trajectory_plots,
)
from ggslam.reporting import page as p
from ggslam.reporting.page import Html
from ggslam.reporting.plots import Plot
from ggslam.system.plurals import quantity

_ABSENT = "not there"


def by_recording(runs: Sequence[RunData]) -> list[list[int]]:
    """Numbers of the runs of each recording, recordings and runs in the order given."""
    groups: dict[str, list[int]] = {}
    for number, run in enumerate(runs):
        groups.setdefault(run.recording_name(), []).append(number)
    return list(groups.values())


def comparison_page(
    groups: Sequence[Sequence[RunData]], views: Sequence[Sequence[FrameView]], changes: ChangesShown | None = None
) -> str:
    """The whole page as text.

    Args:
        groups: the runs of each recording, two or more in all; paths of one recording are in one world. Curves and
            pictures of different recordings are shown one recording after the other: their frames and places have
            nothing to do with each other.
        views: for each recording, frames as each of its runs shows them.
        changes: what changed between two runs; None: they were not compared by objects.
    """
    runs = [run for group in groups for run in group]
    parts = [
        *([("changes", "What changed", changes_part(changes))] if changes is not None else []),
        ("scores", "Scores", _scores(runs)), ("settings", "Settings that differ", _settings(runs)),
        ("views", "The same views", _each(groups, [_views(v, len(g)) for g, v in zip(groups, views, strict=True)])),
        ("trajectory", "Trajectory", _curves(groups, lambda group: [*trajectory_plots(group), error_plot(group)])),
        ("quality", "Image quality", _curves(groups, score_plots)),
        ("tracking", "Tracking", _curves(groups, tracking_plots)),
        ("course", "Time, map and memory",
         _curves(groups, lambda group: [*time_plots(group), *map_plots(group), *loss_plots(group)])),
        ("meaning", "What the numbers mean", p.definitions(MEANINGS)), ("runs", "Runs", _folders(runs)),
    ]  # fmt: skip
    content = [p.section(title, anchor, body) for anchor, title, body in parts]
    title = "Comparison of " + ", ".join(run.name for run in runs)
    return p.page(title, _lead(runs), content, [(anchor, title) for anchor, title, _ in parts], FOOTER)


def _lead(runs: Sequence[RunData]) -> str:
    count = len(_recordings(runs))
    return f"{quantity(len(runs), 'run')} of {'one recording' if count == 1 else quantity(count, 'recording')}"


def _recordings(runs: Sequence[RunData]) -> set[str]:
    return {run.recording_name() for run in runs}


def _each(groups: Sequence[Sequence[RunData]], contents: Sequence[Html]) -> Html:
    """What is shown of each recording, under its name if there are several."""
    if len(groups) == 1:
        return contents[0]
    return p.join(
        p.tag("div", p.tag("h3", f"{', '.join(run.name for run in group)}: {group[0].recording_name()}"), content,
              class_="recording")
        for group, content in zip(groups, contents, strict=True)
    )  # fmt: skip


def _scores(runs: Sequence[RunData]) -> Html:
    one, rows = len(_recordings(runs)) == 1, []
    for metric in METRICS:
        values = [metric.of(run) for run in runs]
        if any(value is not None for value in values):
            unit = f", {metric.unit}" if metric.unit else ""
            texts = [metric.text(value) for value in values]
            rows.append([f"{metric.name}{unit}", *(_mark_best(metric, values) if one else texts)])
    if any(run.verdict is not None for run in runs):
        rows.insert(0, ["verdict", *("-" if run.verdict is None else run.verdict.summary() for run in runs)])
    if not rows:
        return p.tag("p", "None of these runs was scored; ggslam eval does that.")
    unscored = [run.name for run in runs if run.metrics is None]
    note = [p.tag("p", f"Not scored: {', '.join(unscored)}.")] if unscored else []
    if not one:
        note.append(p.tag("p", "The runs are of different recordings: their scores cannot be held against each other."))
    elif len({tuple(run.tracked.get("frame", ())) for run in runs}) > 1:
        note.append(p.tag("p", "The runs are of different frames of the recording; so are their scores."))
    if one:
        note.insert(0, p.tag("p", "The best of each row is marked, unless all are equal as printed.", class_="note"))
    return p.join([p.table(["", *(run.name for run in runs)], rows), *note])


def _mark_best(metric: Metric, values: Sequence[float | None]) -> list[str]:
    """Cells of a row, the best one marked."""
    texts = [metric.text(value) for value in values]
    known = [value for value in values if value is not None and math.isfinite(value)]
    if metric.better and len(known) > 1:
        best = metric.text((max if metric.better == "higher" else min)(known))
        if texts.count(best) < len(known):
            return [p.tag("td", p.tag("span", text), class_="best") if text == best else text for text in texts]
    return texts


def _settings(runs: Sequence[RunData]) -> Html:
    names = list(dict.fromkeys(name for run in runs for name in run.settings))
    rows = []
    for name in names:
        values = [str(run.settings.get(name, _ABSENT)) for run in runs]
        if len(set(values)) > 1:
            rows.append([name, *values])
    for key in ("scale", "start", "stop", "stride", "masks"):
        opened = [None if run.recording is None else getattr(run.recording.open, key) for run in runs]
        values = ["-" if value is None else str(value) for value in opened]
        if len(set(values)) > 1:
            rows.append([f"recording: {key}", *values])
    if not rows:
        return p.tag("p", "All settings are equal.")
    return p.table(["setting", *(run.name for run in runs)], rows, text_columns=range(1, len(runs) + 1))


def _views(views: Sequence[FrameView], runs: int) -> Html:
    if not views:
        return p.tag("p", "No frame was located in all of these runs.")
    columns = min(runs + 1, 4)  # the recorded image comes first
    return p.join(
        p.tag("div", p.tag("h3", f"frame {view.frame}"), p.cells(view.pictures.items(), columns), class_="view")
        for view in views
    )


def _curves(groups: Sequence[Sequence[RunData]], plots_of: Callable[[Sequence[RunData]], Sequence[Plot]]) -> Html:
    return _each(groups, [_figures(plots_of(group), len(group) > 1) for group in groups])


def _figures(plots: Sequence[Plot], several: bool) -> Html:
    shown = [replace(plot, named=several) for plot in plots if plot.has_data()]
    words = "None of these runs has" if several else "This run does not have"
    return p.figures(shown) if shown else p.tag("p", f"{words} what would be shown here.")


def _folders(runs: Sequence[RunData]) -> Html:
    rows = []
    for run in runs:
        known = run.mark.versions()
        rows.append([run.name, run.path, *(str(known.get(key, "unknown")) for key in ("ggslam", "processor"))])
    return p.table(["run", "folder", "ggslam", "processor"], rows, text_columns=(1, 2, 3))
