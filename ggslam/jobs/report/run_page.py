# SPDX-License-Identifier: Apache-2.0
"""The report of one run."""

from __future__ import annotations

from ggslam.jobs.report.change_section import changes_part
from ggslam.jobs.report.latency_section import latency_part
from ggslam.jobs.report.metrics import MEANINGS, METRICS, TILES
from ggslam.jobs.report.mover_section import movers_part
from ggslam.jobs.report.run_data import RunData, stage_seconds
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
from ggslam.runs.records.metrics import SETS, MetricsRecord, SegmentationRecord, SurfaceScoresRecord
from ggslam.runs.records.record import Record
from ggslam.runs.records.verdict import GRADES
from ggslam.system.plurals import quantity
from ggslam.system.tuning import Tuning

FOOTER = "Written by ggslam. The page needs nothing but itself: no network, no other files."


class RunPageTuning(Tuning):
    """What a report shows at once."""

    open_views = 2
    """Frames that are not folded away."""


_NO_STEPS = "This run did not note its steps (it is of an older version, or was edited); there is no course over time."


def run_page(run: RunData) -> str:
    """The whole page as text."""
    parts = [
        ("scores", "Scores", _scores(run)), ("views", "Views", _views(run)), ("trajectory", "Trajectory", _path(run)),
        *([("movers", "What moved", movers_part(run))] if run.movers else []),
        *([("changes", "What changed", changes_part(run.changes))] if run.changes is not None else []),
        ("quality", "Image quality", _quality(run)), ("tracking", "Tracking", _tracking_part(run)),
        ("time", "Time", _time(run)), ("map", "Map and memory", _map(run)), ("losses", "Losses", _losses(run)),
        ("meaning", "What the numbers mean", p.definitions(MEANINGS)), ("settings", "Settings", _settings(run)),
        ("versions", "Recording and versions", _versions(run)),
    ]  # fmt: skip
    sections = [p.section(title, anchor, body) for anchor, title, body in parts]
    content = [_verdict(run), _tiles(run), _warnings(run), *sections]
    links = [(anchor, title) for anchor, title, _ in parts]
    return p.page(run.name, _lead(run), content, links, FOOTER)


def _lead(run: RunData) -> str:
    size = "" if run.recording is None else f" at {run.recording.camera.width}x{run.recording.camera.height}"
    frames = len(run.tracked.get("frame", ()))
    return f"{quantity(frames, 'frame')} of {run.recording_name()}{size}, {quantity(len(run.keyframes), 'keyframe')}"


def _verdict(run: RunData) -> Html:
    """How good the run is, and what to try."""
    verdict = run.verdict
    if verdict is None:
        return Html("")
    rows = [
        [name, p.tag("td", p.tag("span", grade), class_=f"grade-{grade}") if grade in GRADES else grade, text]
        for name, grade, text in verdict.rows()
    ]
    parts = [p.tag("p", "Verdict: ", p.tag("b", verdict.grade), f". {verdict.failure}." if verdict.failure else ".")]
    parts.append(p.table(["", "verdict", "what was measured"], rows, text_columns=(1, 2)))
    parts += [p.tag("p", f"To try: {verdict.next}")] if verdict.next else []
    return p.tag("div", *parts, class_=f"verdict grade-{verdict.grade}")


def _tiles(run: RunData) -> Html:
    found = [(m.text(m.of(run)), m.unit, m.name) for m in METRICS if m.name in TILES and m.of(run) is not None]
    return p.tiles(found)


def _warnings(run: RunData) -> Html:
    if not run.warnings:
        return Html("")
    return p.tag("div", p.tag("b", "To know of this run"), p.bullets(run.warnings), class_="warnings")


_IMAGE_COLUMNS = (
    ("frames", "frames", 1.0, ".0f"), ("PSNR, dB", "psnr", 1.0, ".2f"), ("unmasked", "psnr_unmasked", 1.0, ".2f"),
    ("SSIM", "ssim", 1.0, ".3f"), ("LPIPS", "lpips", 1.0, ".3f"), ("depth L1, cm", "depth_l1_m", 100.0, ".2f"),
)  # fmt: skip


def _scores(run: RunData) -> Html:
    if run.metrics is None:
        return p.tag("p", "This run was not scored; ggslam eval does that, and writes this page anew.")
    parts = [_image_scores(run.metrics), *_camera_scores(run.metrics), _trajectory_scores(run, run.metrics)]
    if run.metrics.surface is not None:
        parts.append(_surface_scores(run.metrics.surface))
    if run.metrics.segmentation is not None:
        parts.append(_object_scores(run.metrics.segmentation))
    return p.join(parts)


def _numbers(scores: Record | None, columns: tuple[tuple[str, str, float, str], ...]) -> list[str]:
    found = [(None if scores is None else scores.number(key), factor, form) for _, key, factor, form in columns]
    return ["-" if value is None else format(factor * value, form) for value, factor, form in found]


def _image_scores(metrics: MetricsRecord) -> Html:
    sets = metrics.images.sets()
    rows = [[name.replace("_", " "), *_numbers(scores, _IMAGE_COLUMNS)] for name, scores in sets.items()]
    return p.table(["images of", *(title for title, *_ in _IMAGE_COLUMNS)], rows)


def _camera_scores(metrics: MetricsRecord) -> list[Html]:
    """Held-out images and trajectory of each camera of a rig."""
    rows = [
        [name, *_numbers(of_camera.trajectory, (("", "ate_rmse_m", 100.0, ".2f"),)),
         *_numbers(of_camera.images.held_out, _IMAGE_COLUMNS)]
        for name, of_camera in (metrics.cameras or {}).items()
    ]  # fmt: skip
    columns = ["held-out images of camera", "ATE RMSE, cm", *(title for title, *_ in _IMAGE_COLUMNS)]
    return [p.table(columns, rows)] if rows else []


def _trajectory_scores(run: RunData, metrics: MetricsRecord) -> Html:
    scores = metrics.trajectory
    if scores is None:
        return p.tag("p", f"No trajectory scores: {run.camera_path.reason or 'too few frames have both poses'}.")
    columns = (
        ("ATE RMSE, cm", "ate_rmse_m", 100.0, ".2f"), ("mean", "ate_mean_m", 100.0, ".2f"),
        ("median", "ate_median_m", 100.0, ".2f"), ("largest", "ate_max_m", 100.0, ".2f"),
        ("not aligned", "ate_raw_rmse_m", 100.0, ".2f"), ("RPE, cm", "rpe_trans_m", 100.0, ".2f"),
        ("RPE, deg", "rpe_rot_deg", 1.0, ".3f"), ("frames", "frames_compared", 1.0, ".0f"),
    )  # fmt: skip
    return p.table(["", *(title for title, *_ in columns)], [["trajectory", *_numbers(scores, columns)]])


def _surface_scores(scores: SurfaceScoresRecord) -> Html:
    """Of the points against the measured surface."""
    columns = (
        ("number", "points", 1.0, ".0f"), ("median off, cm", "median_m", 100.0, ".2f"),
        ("95 % within, cm", "p95_m", 100.0, ".2f"), ("F1 at 1 cm, %", "f1_1cm", 100.0, ".1f"),
        ("precision", "precision_1cm", 100.0, ".1f"), ("recall", "recall_1cm", 100.0, ".1f"),
        ("F1 at 2 cm, %", "f1_2cm", 100.0, ".1f"), ("precision", "precision_2cm", 100.0, ".1f"),
        ("recall", "recall_2cm", 100.0, ".1f"),
    )  # fmt: skip
    return p.table(["", *(title for title, *_ in columns)], [["points", *_numbers(scores, columns)]])


def _object_scores(scores: SegmentationRecord) -> Html:
    columns = (
        ("objects", "objects", 1.0, ".0f"), ("mIoU, %", "miou", 100.0, ".1f"),
        ("boundary", "boundary_miou", 100.0, ".1f"), ("pixels right, %", "accuracy", 100.0, ".1f"),
        ("mIoU by votes", "votes_miou", 100.0, ".1f"),
    )  # fmt: skip
    rows = [[n.replace("_", " "), *_numbers(getattr(scores, n), columns)] for n in SETS]
    overall = p.table(["objects of", *(title for title, *_ in columns)], rows)
    each = [
        [i, o.name or "", *_numbers(o, (("", "iou", 100.0, ".1f"),))] for i, o in scores.per_object.items()
    ]
    listed = p.table(["id", "name", "IoU, %"], each, sorts=True, text_columns=(1,))
    return p.join([overall, p.tag("details", p.tag("summary", f"{quantity(len(each), 'object')} one by one"), listed)])


def _views(run: RunData) -> Html:
    if not run.views:
        return p.tag("p", "There are no pictures: no frame of this run was located.")
    shown = [
        p.tag("div", p.tag("h3", f"frame {view.frame}"), p.cells(view.pictures.items()), class_="view")
        for view in run.views
    ]
    more = shown[RunPageTuning.open_views:]
    folded = [p.tag("details", p.tag("summary", f"{len(more)} more"), *more)] if more else []
    return p.join([*shown[:RunPageTuning.open_views], *folded])


def _path(run: RunData) -> Html:
    words = (
        "Forward is where the first camera looked, right is to its right, both level; 0 is where it was. Up is that of "
        f"{run.camera_path.level.source}. One metre is as long along both axes."
    )
    missing = []
    if run.camera_path.truth is None:
        missing = [p.tag("p", f"No comparison with true poses: {run.camera_path.reason}.")]
    return p.join(
        [p.tag("p", words, class_="note"), p.figures([*trajectory_plots([run]), error_plot([run])]), *missing]
    )


def _quality(run: RunData) -> Html:
    if not run.scores:
        return p.tag("p", "This run was not scored; ggslam eval does that, and writes this page anew.")
    missing = [p.tag("p", f"{plot.title} was not scored.") for plot in score_plots([run]) if not plot.has_data()]
    return p.join([p.figures(score_plots([run])), *missing])


def _tracking_part(run: RunData) -> Html:
    counts = {name: int((run.tracked["status"] == name).sum()) for name in dict.fromkeys(run.tracked["status"])}
    words = ", ".join(f"{count} {name}" for name, count in counts.items())
    return p.join([p.tag("p", f"Frames: {words}."), p.figures(tracking_plots([run]))])


def _time(run: RunData) -> Html:
    stages = stage_seconds(run.timing)
    if not stages:
        return p.tag("p", "This run did not note where its time went.")
    total = sum(seconds for *_, seconds in stages)
    bar = p.tag("div", *(
        p.tag("i", class_=f"fill{n}", style=f"flex:{seconds:.4f} 0 0", title=f"{name}: {seconds:.2f} s")
        for n, (name, _, seconds) in enumerate(stages)
    ), class_="bar")  # fmt: skip
    frames = 1 if run.timing is None else max(1, run.timing.frames)
    rows = [
        [p.join([p.tag("span", class_=f"swatch fill{n}"), name]), f"{seconds:.2f}", f"{1000 * seconds / frames:.1f}",
         f"{100 * seconds / total:.0f}", words] for n, (name, words, seconds) in enumerate(stages)
    ]  # fmt: skip
    listed = p.table(["stage", "seconds", "ms a frame", "%", ""], rows, text_columns=(4,))
    course = p.figures(time_plots([run])) if run.steps else p.tag("p", _NO_STEPS)
    return p.join([bar, listed, *_beside(run), *latency_part(run.timing), *_energy(run), course])


def _beside(run: RunData) -> list[Html]:
    """What another thread did beside the stages, if one did."""
    timing = run.timing
    if timing is None or not timing.beside_s:
        return []
    words = (
        f"Beside these stages another thread worked for {timing.beside_s:.2f} s: keyframes joined what frames are "
        "aligned to, and loops were searched. The stages do not contain it."
    )
    return [p.tag("p", words, class_="note")]


def _energy(run: RunData) -> list[Html]:
    """What the parts used, if that was counted."""
    energy = None if run.timing is None else run.timing.energy
    if energy is None:
        return []
    words = f"Energy of the whole machine ({energy.source})." if energy.source else f"{energy.note.capitalize()}."
    known = ["J"][: energy.source is not None]
    rows = [
        [name, f"{used.seconds:.2f}", f"{used.cpu_s:.2f}", *[f"{used.joules or 0:.1f}" for _ in known]]
        for name, used in [*energy.parts.items(), ("in all", energy.whole)]
    ]
    rows += [
        [f"{name}, beside the frames", f"{used.seconds:.2f}", f"{used.cpu_s:.2f}", *["-" for _ in known]]
        for name, used in energy.beside.items()
    ]
    words += " What is in one part is in no other."
    if energy.beside:
        words += " What another thread did beside the frames is within what the parts used meanwhile."
    note = p.tag("p", words, class_="note")
    return [note, p.table(["part", "seconds", "processor seconds", *known], rows)]


def _map(run: RunData) -> Html:
    return p.figures(map_plots([run])) if run.steps else p.tag("p", _NO_STEPS)


def _losses(run: RunData) -> Html:
    if not run.steps:
        return p.tag("p", _NO_STEPS)
    plots = loss_plots([run])
    if not any(plot.has_data() for plot in plots):
        return p.tag("p", "Nothing was trained: frames were located in the map as it was.")
    return p.figures(plots)


def _settings(run: RunData) -> Html:
    if not run.settings:
        return p.tag("p", "The settings of this run are not known.")
    changed = {name for name, value in run.settings.items() if name in run.defaults and run.defaults[name] != value}
    differing = [[name, str(run.settings[name]), str(run.defaults[name])] for name in sorted(changed)]
    top = (
        p.table(["setting", "this run", "default"], differing, text_columns=(1, 2))
        if changed else p.tag("p", "All settings are the defaults.")
    )  # fmt: skip
    rows = [[name, str(value)] for name, value in run.settings.items()]
    whole = p.table(["setting", "value"], rows, text_columns=(1,))
    return p.join([top, p.tag("details", p.tag("summary", f"All {len(rows)} settings"), whole)])


def _versions(run: RunData) -> Html:
    opened = {} if run.recording is None else {k: v for k, v in run.recording.open if v is not None}
    rows = [["run folder", run.path], *([name, str(value)] for name, value in opened.items())]
    rows += [[name, str(value)] for name, value in run.mark.versions().items()]
    return p.table(["", ""], rows, text_columns=(1,))
