# SPDX-License-Identifier: Apache-2.0
"""Looking a recording over before working with it: sizes, ranges, motion, and what seems wrong."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field

import numpy as np

from ggslam.errors import SequenceError
from ggslam.scene.camera import Camera
from ggslam.scene.frame import Frame
from ggslam.scene.poses import inverse, transformed
from ggslam.sequences.sequence import Sequence

SMALLEST_MEDIAN_DEPTH, LARGEST_MEDIAN_DEPTH = 0.1, 20.0
"""Metres; a median depth outside suggests a wrong depth scale."""


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
        time_source, pose_source: what told them.
        camera, native_camera: delivered and stored intrinsics.
        depth_scale: units per metre.
        depth_m: 1st percentile, median, 99th percentile of the valid depths of the sampled frames (NaN: none valid).
        valid_share: share of sampled pixels with depth.
        posed_frames: frames with a true pose.
        motion: None without two successive true poses.
        pose_depth_error: median relative difference between the depth seen in a frame and the depth predicted from the
            frame before by the true poses; None when it cannot be told.
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
    depth_m: tuple[float, float, float] = (np.nan, np.nan, np.nan)
    valid_share: float = 0.0
    posed_frames: int = 0
    motion: Motion | None = None
    pose_depth_error: float | None = None
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
        _check_poses(report, _neighbours(sequence, frames))
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


def _neighbours(sequence: Sequence, frames: list[Frame]) -> list[tuple[Frame, Frame]]:
    """Pairs of a frame and the next one where both have a true pose."""
    pairs = []
    for frame in frames:
        if frame.T_world_camera is None or frame.index + 1 >= len(sequence):
            continue
        try:
            after = sequence.frame(frame.index + 1)
        except SequenceError:
            continue
        if after.T_world_camera is not None:
            pairs.append((frame, after))
    return pairs


_CONVENTIONS: dict[str, Callable[[np.ndarray], np.ndarray]] = {
    "world to camera": inverse,
    "OpenGL camera axes (y up, z back)": lambda T: T @ np.diag([1.0, -1.0, -1.0, 1.0]),
}
"""Ways in which poses are often written; each function turns such a pose into ours."""


def _check_poses(report: SequenceReport, pairs: list[tuple[Frame, Frame]]) -> None:
    """Compares neighbouring depth images by the true poses, read as they should be and as they are often written."""
    error = report.pose_depth_error = _pose_depth_error(pairs, lambda T: T)
    if error is None:
        return
    for name, convert in _CONVENTIONS.items():
        other = _pose_depth_error(pairs, convert)
        if other is not None and other < 0.4 * error and error > 0.004:
            report.warnings.append(
                f"the true poses look like {name}: read so, neighbouring depth images agree to {other:.2%}, as "
                f"camera to world with OpenCV axes only to {error:.2%}"
            )
            return
    if error > 0.05:
        report.warnings.append(
            f"true poses and depth disagree by {error:.0%}: wrong depth scale or poses, or little seen twice"
        )


def _pose_depth_error(pairs: list[tuple[Frame, Frame]], convert: Callable[[np.ndarray], np.ndarray]) -> float | None:
    """Median relative depth difference of neighbouring frames by converted poses; None when too little overlaps."""
    errors = [_relative_depth_error(a, b, convert) for a, b in pairs]
    known = np.concatenate(errors) if errors else np.zeros(0)
    return float(np.median(known)) if len(known) >= 100 else None


def _relative_depth_error(frame: Frame, other: Frame, convert: Callable[[np.ndarray], np.ndarray]) -> np.ndarray:
    """|seen - predicted| / predicted for pixels of `frame` (every 8th row and column) that fall into `other`."""
    assert frame.T_world_camera is not None and other.T_world_camera is not None
    points = frame.camera.back_project(frame.depth)[::8, ::8].reshape(-1, 3)
    points = points[points[:, 2] > 0]
    T = inverse(convert(other.T_world_camera)) @ convert(frame.T_world_camera)
    points = transformed(points, T)
    points = points[points[:, 2] > 0.05]
    c = other.camera
    u = np.rint(c.fx * points[:, 0] / points[:, 2] + c.cx).astype(int)
    v = np.rint(c.fy * points[:, 1] / points[:, 2] + c.cy).astype(int)
    inside = (u >= 0) & (u < c.width) & (v >= 0) & (v < c.height)
    predicted, seen = points[inside, 2], other.depth[v[inside], u[inside]]
    return np.abs(seen - predicted)[seen > 0] / predicted[seen > 0]


def _warn(report: SequenceReport, intervals: np.ndarray, frames: list[Frame]) -> None:
    add = report.warnings.append
    median = report.depth_m[1]
    if report.damaged:
        add(f"{len(report.damaged)} of the sampled frames are damaged; the first: {report.damaged[0]}")
    if frames and not report.valid_share:
        add("no depth at all in the sampled frames")
    elif median < SMALLEST_MEDIAN_DEPTH or median > LARGEST_MEDIAN_DEPTH:
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
