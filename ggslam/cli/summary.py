# SPDX-License-Identifier: Apache-2.0
"""Prints scores."""

from __future__ import annotations

from typing import TYPE_CHECKING

from rich.markup import escape

from ggslam.cli.console import console, table
from ggslam.system.plurals import quantity
from ggslam.system.tuning import Tuning

if TYPE_CHECKING:
    from ggslam.runs.records.metrics import (
        CameraScoresRecord,
        MetricsRecord,
        SegmentationRecord,
        SurfaceScoresRecord,
        TrajectoryScoresRecord,
    )
    from ggslam.runs.records.record import Record
    from ggslam.runs.records.verdict import RunVerdict

_IMAGE_COLUMNS = [
    ("frames", "frames", 1.0, ".0f"), ("PSNR", "psnr", 1.0, ".2f"), ("PSNR unmasked", "psnr_unmasked", 1.0, ".2f"),
    ("SSIM", "ssim", 1.0, ".3f"), ("LPIPS", "lpips", 1.0, ".3f"), ("depth L1 cm", "depth_l1_m", 100.0, ".2f"),
]  # fmt: skip


_SEGMENTATION_COLUMNS = [
    ("objects", "objects", 1.0, ".0f"), ("mIoU", "miou", 100.0, ".1f"), ("boundary", "boundary_miou", 100.0, ".1f"),
    ("accuracy", "accuracy", 100.0, ".1f"), ("precision", "precision", 100.0, ".0f"),
    ("recall", "recall", 100.0, ".0f"), ("votes", "votes_miou", 100.0, ".1f"),
]  # fmt: skip


class SummaryTuning(Tuning):
    """How much of the scores is printed."""

    lowest = 5
    """Objects with the lowest scores."""


def _text(value: float | None, factor: float, form: str) -> str:
    return "-" if value is None else format(factor * value, form)


def _cells(scores: Record, columns: list[tuple[str, str, float, str]]) -> list[str]:
    return [_text(scores.number(key), factor, form) for _, key, factor, form in columns]


def print_scores(metrics: MetricsRecord) -> None:
    """A table of the image scores, one of the objects, and a line each for trajectory and speed."""
    rows = [
        [name.replace("_", " "), *_cells(scores, _IMAGE_COLUMNS)] for name, scores in metrics.images.sets().items()
    ]
    columns = ["scores", *(title for title, *_ in _IMAGE_COLUMNS)]
    for name, scores in metrics.images.sets().items():
        if scores.psnr_exposed is not None:
            text = f"{name.replace('_', ' ')}: PSNR {scores.psnr_exposed:.2f} of frames brought to the usual exposure"
            console.print(text, highlight=False)
    console.print(table("images; all but 'unmasked' over pixels with measured depth", columns, rows))
    if metrics.cameras:
        _print_cameras(metrics.cameras)
    if metrics.segmentation is not None:
        _print_segmentation(metrics.segmentation)
    console.print(_trajectory_line(metrics.trajectory), highlight=False)
    if metrics.surface is not None:
        console.print(_surface_line(metrics.surface), highlight=False)
    console.print(_speed_line(metrics), highlight=False)
    for note in metrics.notes:
        console.print(f"note: {note}", highlight=False, markup=False)


GRADE_COLORS = {"good": "green", "doubtful": "yellow", "bad": "bold red"}


def print_verdict(verdict: RunVerdict) -> None:
    """The grade of a run, a line for each aspect, and what to try next."""
    color = GRADE_COLORS[verdict.grade]
    console.print(f"verdict: [{color}]{verdict.grade}[/]", highlight=False)
    for name, aspect in verdict.aspects().items():
        grade = aspect.grade or "-"
        shown = f"[{GRADE_COLORS[grade]}]{grade:<8}[/]" if aspect.grade else f"{grade:<8}"
        console.print(f"  {name:<8}  {shown}  {escape(aspect.text)}", highlight=False)
    if verdict.next:
        console.print(f"  try:      {escape(verdict.next)}", highlight=False, soft_wrap=True)


def _print_cameras(cameras: dict[str, CameraScoresRecord]) -> None:
    """Held-out images and trajectory of each camera of a rig; of all images where none was held out."""
    rows = []
    for name, of_camera in cameras.items():
        images = of_camera.images.held_out or of_camera.images.all
        ate = None if of_camera.trajectory is None else of_camera.trajectory.ate_rmse_m
        rows.append([name, _text(ate, 100, ".2f"), *(_cells(images, _IMAGE_COLUMNS) if images is not None else [])])
    columns = ["camera", "ATE cm", *(title for title, *_ in _IMAGE_COLUMNS)]
    console.print(table("cameras of the rig, held-out images", columns, rows))


def _print_segmentation(s: SegmentationRecord) -> None:
    rows = [
        [name.replace("_", " "), *_cells(scores, _SEGMENTATION_COLUMNS)] for name, scores in s.sets().items()
    ]
    matched = "equal ids" if s.matching == "same" else "ids matched one to one"
    columns = ["scores", *(title for title, *_ in _SEGMENTATION_COLUMNS)]
    console.print(table(f"objects against masks, %; {matched}", columns, rows))
    scored = [(i, o, o.iou) for i, o in s.per_object.items() if o.iou is not None]
    lowest = sorted(scored, key=lambda item: item[2])[:SummaryTuning.lowest]
    labels = [f"{o.name} ({i})" if o.name else f"object {i}" for i, o, _ in lowest]
    texts = [f"{label} {_text(iou, 100, '.1f')} %" for label, (_, _, iou) in zip(labels, lowest, strict=True)]
    console.print(f"lowest IoU: {', '.join(texts)}", highlight=False, markup=False)
    g = s.gaussians
    if g is not None:
        right, by_opacity = _text(g.accuracy, 100, ".1f"), _text(g.accuracy_by_opacity, 100, ".1f")
        console.print(
            f"Gaussians: {right} % ({by_opacity} % by opacity) labelled right of {g.labelled} with a true label",
            highlight=False,
        )


def _trajectory_line(t: TrajectoryScoresRecord | None) -> str:
    if t is None:
        return "trajectory: no ground truth to compare with"
    lengths = (t.ate_rmse_m, t.ate_mean_m, t.ate_raw_rmse_m, t.rpe_trans_m)
    ate, mean, raw, rpe = (f"{_text(length, 100, '.2f')} cm" for length in lengths)
    turn = _text(t.rpe_rot_deg, 1, ".3f")
    frames = quantity(t.frames_compared or 0, "frame")
    return f"trajectory: ATE RMSE {ate}, mean {mean} (aligned), raw {raw}; RPE {rpe}, {turn} deg; over {frames}"


def _surface_line(s: SurfaceScoresRecord) -> str:
    half, most = (f"{_text(length, 100, '.2f')} cm" for length in (s.median_m, s.p95_m))
    near, far = (
        f"F1 {_text(f1, 100, '.1f')} % at {at} cm (precision {_text(p, 100, '.1f')}, recall {_text(r, 100, '.1f')})"
        for at, f1, p, r in ((1, s.f1_1cm, s.precision_1cm, s.recall_1cm), (2, s.f1_2cm, s.precision_2cm, s.recall_2cm))
    )
    return f"points: {s.points}, half within {half} of the measured surface, 95 % within {most}; {near}; {far}"


def _speed_line(metrics: MetricsRecord) -> str:
    s = metrics.speed
    return (
        f"speed: {_text(s.frames_per_s, 1, '.1f')} frames/s, tracking {_text(s.tracking_ms, 1, '.1f')} ms a "
        f"frame, mapping {_text(s.mapping_iteration_ms, 1, '.1f')} ms an iteration; {metrics.map.gaussians} "
        f"Gaussians, peak memory {_text(metrics.memory.peak_rss_mb, 1, '.0f')} MB"
    )
