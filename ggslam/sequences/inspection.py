# SPDX-License-Identifier: Apache-2.0
"""Looking a recording over before working with it: sizes, ranges, motion, and what seems wrong."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from ggslam.errors import SequenceError
from ggslam.scene.camera import Camera
from ggslam.scene.frame import Frame
from ggslam.scene.poses import inverse
from ggslam.sequences.alignment import Alignment, measure_alignment
from ggslam.sequences.pose_conventions import CONVENTIONS, OURS
from ggslam.sequences.pose_doubts import PoseDoubt, doubt_poses, pairs_apart
from ggslam.sequences.sequence import Sequence

SMALLEST_MEDIAN_DEPTH, LARGEST_MEDIAN_DEPTH = 0.1, 6.0
"""Metres; a median depth outside suggests a wrong depth scale: RGB-D cameras see rooms."""


@dataclass(frozen=True)
class Motion:
    """Camera motion between successive frames by the true poses: median, 90th percentile, largest; and in all."""

    step_m: tuple[float, float, float]
    turn_deg: tuple[float, float, float]
    path_m: float


@dataclass
class SequenceReport:
    """What `inspect_sequence` found.

    Attributes:
        name, format, frames: of the sequence.
        duration_s, rate_hz: by the timestamps; rate is the median one (NaN for a single frame).
        time_source, pose_source: where they come from.
        camera, native_camera: delivered and stored intrinsics.
        color_size, depth_size: (width, height) of the stored images.
        lens: what is undone, for people; "" for a pinhole camera.
        registered: whether depth of another camera is registered to colour.
        min_confidence: depth less sure is dropped; None: the recording does not tell.
        depth_scale: units per metre.
        depth_m: 1st percentile, median, 99th percentile of the valid depths of the sampled frames (NaN: none valid).
        valid_share: share of sampled pixels with depth.
        posed_frames: frames with a true pose.
        motion: None without two successive true poses.
        pose_depth_error: median relative difference between the depth seen in a frame and the depth predicted from an
            earlier frame by the true poses; None when it cannot be told.
        alignment: where depth fits colour best; None when too few outlines are seen.
        mask_kinds: how the masks of all frames are stored ("grey", "palette", "RGB-coded", ...) -> number of frames.
        masked_frames: share of sampled frames with a mask; mask_ids: ids seen in them; labelled_share: of their pixels.
        named_ids: how many ids have names.
        damaged: reasons of sampled frames that could not be read.
        warnings: everything that looks wrong or needs to be known.
    """

    name: str
    format: str
    frames: int
    duration_s: float
    rate_hz: float
    time_source: str
    pose_source: str
    camera: Camera
    native_camera: Camera
    depth_scale: float
    color_size: tuple[int, int] = (0, 0)
    depth_size: tuple[int, int] = (0, 0)
    lens: str = ""
    registered: bool = False
    min_confidence: int | None = None
    depth_m: tuple[float, float, float] = (np.nan, np.nan, np.nan)
    valid_share: float = 0.0
    posed_frames: int = 0
    motion: Motion | None = None
    pose_depth_error: float | None = None
    alignment: Alignment | None = None
    mask_kinds: dict[str, int] = field(default_factory=dict)
    masked_frames: float = 0.0
    mask_ids: list[int] = field(default_factory=list)
    labelled_share: float = 0.0
    named_ids: int = 0
    damaged: list[str] = field(default_factory=list)
    warnings: list[str] = field(default_factory=list)


def inspect_sequence(sequence: Sequence, samples: int = 8) -> SequenceReport:
    """Reads `samples` frames spread over the sequence and reports what they hold."""
    times = sequence.timestamps
    intervals = np.diff(times)
    report = SequenceReport(
        sequence.name, sequence.format, len(sequence), float(times[-1] - times[0]), _rate(intervals),
        sequence.time_source, sequence.pose_source, sequence.camera, sequence.native_camera, sequence.depth_scale,
        sequence.color_size, sequence.depth_size, sequence.lens, sequence.registered, sequence.min_confidence,
        named_ids=len(sequence.instance_names), warnings=list(sequence.warnings),
    )  # fmt: skip
    chosen = np.unique(np.linspace(0, len(sequence) - 1, max(1, min(samples, len(sequence)))).round().astype(int))
    frames = [frame for i in chosen if (frame := _try(sequence, int(i), report)) is not None]
    _describe_images(report, frames)
    try:
        report.mask_kinds = dict(sequence.mask_kinds())
    except SequenceError as error:
        report.warnings.append(str(error))
    if sequence.ground_truth is not None:
        report.posed_frames = int(np.isfinite(sequence.ground_truth).all((1, 2)).sum())
        report.motion = _motion(sequence.ground_truth)
        _check_poses(report, doubt_poses(pairs_apart(sequence, frames)))
    report.alignment = measure_alignment(frames)
    _check_alignment(report)
    _warn(report, intervals, frames)
    return report


def _try(sequence: Sequence, index: int, report: SequenceReport) -> Frame | None:
    try:
        return sequence.frame(index)
    except SequenceError as error:
        report.damaged.append(str(error))
        return None


def _rate(intervals: np.ndarray) -> float:
    positive = intervals[intervals > 0]
    return float(1 / np.median(positive)) if len(positive) else float("nan")


def _describe_images(report: SequenceReport, frames: list[Frame]) -> None:
    if not frames:
        return
    depths = np.concatenate([frame.depth[frame.depth > 0] for frame in frames])
    report.valid_share = float(np.mean([(frame.depth > 0).mean() for frame in frames]))
    if len(depths):
        low, median, high = np.percentile(depths, [1, 50, 99])
        report.depth_m = (float(low), float(median), float(high))
    masks = [frame.mask for frame in frames if frame.mask is not None]
    report.masked_frames = len(masks) / len(frames)
    if masks:
        report.mask_ids = [int(i) for i in np.unique(np.concatenate([np.unique(mask) for mask in masks])) if i > 0]
        report.labelled_share = float(np.mean([(mask > 0).mean() for mask in masks]))


def _motion(poses: np.ndarray) -> Motion | None:
    step = inverse(poses[:-1]) @ poses[1:]
    step = step[np.isfinite(step).all((1, 2))]
    if len(step) == 0:
        return None
    distance = np.linalg.norm(step[:, :3, 3], axis=1)
    turn = np.degrees(np.arccos(np.clip((np.trace(step[:, :3, :3], axis1=1, axis2=2) - 1) / 2, -1, 1)))

    def summary(values: np.ndarray) -> tuple[float, float, float]:
        median, high, largest = np.percentile(values, [50, 90, 100])
        return float(median), float(high), float(largest)

    return Motion(summary(distance), summary(turn), float(distance.sum()))


USUAL_SCALES = (1000.0, 5000.0, 6553.5, 4000.0, 10000.0, 512.0, 256.0, 1.0)
"""Depth units per metre that cameras and data sets use."""


def _check_poses(report: SequenceReport, doubt: PoseDoubt | None) -> None:
    """Tells what depth images of neighbouring frames say about poses and depth scale."""
    if doubt is None:
        return
    report.pose_depth_error = doubt.error
    add = report.warnings.append
    if doubt.wrong_convention:
        add(
            f"the true poses look like {CONVENTIONS[doubt.convention].description}: read so, neighbouring depth images "
            f"agree to {doubt.best:.2%}, as {CONVENTIONS[OURS].description} only to {doubt.error:.2%}; "
            f"try `pose_convention` {doubt.convention}"
        )
    elif doubt.wrong_scale:
        found = report.depth_scale / doubt.ratio
        usual = min(USUAL_SCALES, key=lambda scale: abs(np.log(scale / found)))
        scale = usual if abs(np.log(usual / found)) < 0.1 else found
        add(
            f"depth scale {report.depth_scale:g} is suspicious: with about {scale:g} units a metre neighbouring "
            f"depth images agree with the poses to {doubt.best:.2%}, so only to {doubt.error:.2%}; "
            f"try `depth_scale` {scale:g}"
        )
    elif doubt.error > 0.05:
        add(f"true poses and depth disagree by {doubt.error:.0%}: wrong depth scale or poses, or little seen twice")


def _check_alignment(report: SequenceReport) -> None:
    found = report.alignment
    if found is None or not found.doubtful:
        return
    width = report.camera.width
    parts = [f"{axis} {share * width:+.0f} pixels" for axis, share in zip(("right", "down"), found.shift, strict=True)]
    size = "" if found.scale == 1 else f" and enlarged by {found.scale:g}"
    report.warnings.append(
        "depth does not lie on colour: its outlines fit the edges of the colour images better when moved "
        f"{', '.join(parts)}{size}; wrong intrinsics, depth that is not registered (`depth_camera`), or images of "
        "different times"
    )


def _warn(report: SequenceReport, intervals: np.ndarray, frames: list[Frame]) -> None:
    add = report.warnings.append
    median = report.depth_m[1]
    if report.damaged:
        add(f"{len(report.damaged)} of the sampled frames are damaged; the first: {report.damaged[0]}")
    if frames and not report.valid_share:
        add("no depth at all in the sampled frames")
    elif median < SMALLEST_MEDIAN_DEPTH or median > LARGEST_MEDIAN_DEPTH:
        told = any(f"depth scale {report.depth_scale:g} is suspicious" in warning for warning in report.warnings)
        if not told:  # the poses tell more
            add(f"depth scale {report.depth_scale:g} is suspicious: the median depth is {median:.3g} m")
    elif frames and report.valid_share < 0.2:
        add(f"only {report.valid_share:.0%} of the pixels have depth")
    if len(intervals) and intervals.min() <= 0:
        add("timestamps do not increase from frame to frame")
    if report.motion is not None and (report.motion.step_m[1] > 0.2 or report.motion.turn_deg[1] > 15):
        add(
            f"large motion between frames (90th percentile {report.motion.step_m[1]:.2f} m, "
            f"{report.motion.turn_deg[1]:.0f} degrees): tracking may be lost"
        )
    angle = 2 * np.degrees(np.arctan(report.camera.width / (2 * report.camera.fx)))
    if not 20 <= angle <= 120:
        add(f"intrinsics are suspicious: horizontal angle of view {angle:.0f} degrees")
