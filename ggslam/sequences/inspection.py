# SPDX-License-Identifier: Apache-2.0
"""Inspects a recording before it is used: sizes, ranges, motion, and what seems wrong."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from ggslam.errors import SequenceError
from ggslam.scene.camera import Camera
from ggslam.scene.frame import Frame
from ggslam.scene.poses import inverse
from ggslam.sequences.alignment import Alignment, measure_alignment
from ggslam.sequences.camera_doubts import judge_intrinsics
from ggslam.sequences.clock_offset import ClockOffset, measure_clock_offset
from ggslam.sequences.depth_doubts import DepthDoubts
from ggslam.sequences.focal_doubts import doubt_focal_length, pairs_matched
from ggslam.sequences.pose_conventions import CONVENTIONS, OURS
from ggslam.sequences.pose_doubts import SIDES, PoseDoubt, doubt_poses, pairs_apart
from ggslam.sequences.scale_doubts import measure_scale_signs
from ggslam.sequences.sequence import Sequence
from ggslam.sequences.step_doubts import StepTuning, doubt_steps
from ggslam.sequences.verdicts import (
    Verdict,
    judge_depth_scale,
    judge_scale_by,
    judge_scale_signs,
    judge_times,
)
from ggslam.sequences.void_ids import has_void_id
from ggslam.system.tuning import Tuning


class InspectionTuning(Tuning):
    """When the depth scale is doubted by true poses."""

    max_ratio = 1.25
    """Factor between depth and true poses, or its reciprocal, from which the depth scale is doubted."""
    scale_error = 0.05
    """Accuracy of that factor (natural logarithm)."""


VOID_TEXT = (
    "id 255 stands in most masks and is far from all other ids: it seems to mean no label; `void_id` 255 leaves it out"
)

OTHER_SCENES = {"unrelated", "color_noise", "depth_noise", "color_repeats", "depth_repeats"}
"""Codes of verdicts that say that colour and depth of many frames show other things."""


@dataclass(frozen=True)
class Motion:
    """Camera motion between successive frames by the true poses: median, 90th percentile, largest; and in all."""

    step_m: tuple[float, float, float]
    turn_deg: tuple[float, float, float]
    path_m: float


@dataclass
class SequenceReport:
    """The result of `inspect_sequence`.

    Attributes:
        name, format, frames: of the sequence.
        duration_s, rate_hz: by the timestamps; rate is the median one (NaN for a single frame).
        time_source, pose_source, camera_source: where they come from.
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
        clocks: by how much time depth and colour are apart; None when it cannot be told, or was not asked for.
        damaged: reasons of sampled frames that could not be read.
        scale_known: whether true poses tell the depth scale: then only they are heard.
        verdicts: what seems wrong by the numbers.
        warnings: everything that looks wrong or needs to be known, the texts of the verdicts among it.
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
    camera_source: str = ""
    clocks: ClockOffset | None = None
    damaged: list[str] = field(default_factory=list)
    scale_known: bool = False
    verdicts: list[Verdict] = field(default_factory=list)
    warnings: list[str] = field(default_factory=list)

    def has_verdict(self, code: str) -> bool:
        """Whether there is a verdict of this kind."""
        return any(verdict.code == code for verdict in self.verdicts)

    def judge(self, verdicts: list[Verdict]) -> None:
        """Takes verdicts in."""
        self.verdicts += verdicts
        self.warnings += [verdict.text for verdict in verdicts]


def inspect_sequence(
    sequence: Sequence, samples: int = 8, masks: bool = True, clocks: bool = False, depth: list[Verdict] | None = None
) -> SequenceReport:
    """Reads `samples` frames spread over the sequence, with or without their masks, and reports what they hold; with
    `clocks` also by how much time depth and colour are apart, for which it reads some 50 frames more. `depth`:
    what `DepthDoubts` said before; None: it is asked."""
    times = sequence.timestamps
    intervals = np.diff(times)
    report = SequenceReport(
        sequence.name, sequence.format, len(sequence), float(times[-1] - times[0]), _rate(intervals),
        sequence.time_source, sequence.pose_source, sequence.camera, sequence.native_camera, sequence.depth_scale,
        sequence.color_size, sequence.depth_size, sequence.lens, sequence.registered, sequence.min_confidence,
        named_ids=len(sequence.instance_names), camera_source=sequence.camera_source, warnings=list(sequence.warnings),
    )  # fmt: skip
    chosen = np.unique(np.linspace(0, len(sequence) - 1, max(1, min(samples, len(sequence)))).round().astype(int))
    frames = [frame for i in chosen if (frame := _try(sequence, int(i), report, masks)) is not None]
    _describe_images(report, frames)
    try:
        report.mask_kinds = dict(sequence.mask_kinds()) if masks else {}
    except SequenceError as error:
        report.warnings.append(str(error))
    doubts = DepthDoubts(sequence, frames)
    report.judge(depth if depth is not None else doubts.judge() if frames else [])
    certain = any(verdict.severity == "wrong" for verdict in report.verdicts)
    report.judge(judge_intrinsics(sequence.native_camera, sequence.stated_size, sequence.camera_source))
    if masks and has_void_id(sequence):
        report.judge([Verdict("void_id", "doubtful", VOID_TEXT)])
    if sequence.ground_truth is not None:
        pairs = pairs_apart(sequence, frames)
        report.posed_frames = int(np.isfinite(sequence.ground_truth).all((1, 2)).sum())
        report.motion = _motion(sequence.ground_truth)
        _check_poses(report, doubt_poses(pairs), doubts)
    report.alignment = measure_alignment(frames)
    explained = any(verdict.code in OTHER_SCENES for verdict in report.verdicts)
    if not certain and not explained:  # or it would be blamed on others
        _check_alignment(report)
        _check_camera(report, sequence, frames)
        _check_steps(report, sequence)
    report.clocks = measure_clock_offset(sequence) if clocks else None
    _warn(report, times, frames)
    _check_scale(report, sequence, frames, certain)
    return report


def _check_scale(report: SequenceReport, sequence: Sequence, frames: list[Frame], certain: bool) -> None:
    """Judges the depth scale by the size of what is seen, where no pose tells more and depth is depth."""
    if certain or report.has_verdict("depth_scale") or not report.valid_share or report.scale_known:
        return
    report.judge(judge_depth_scale(report.depth_scale, report.depth_m[1]))
    if not report.posed_frames and not report.has_verdict("depth_scale"):
        signs = measure_scale_signs(sequence, frames)
        report.judge([] if signs is None else judge_scale_signs(report.depth_scale, signs))


def _try(sequence: Sequence, index: int, report: SequenceReport, masks: bool) -> Frame | None:
    try:
        return sequence.frame(index, masks=masks)
    except SequenceError as error:
        if str(error) not in report.damaged:  # a frame may be asked for twice
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


def _check_poses(report: SequenceReport, doubt: PoseDoubt | None, doubts: DepthDoubts) -> None:
    """Tells what depth images of neighbouring frames, and points triangulated, say about poses and depth scale."""
    if doubt is not None:
        report.pose_depth_error = doubt.error
    if report.verdicts and any(verdict.severity == "wrong" for verdict in report.verdicts):
        return  # depth or intrinsics would be blamed on the poses
    points = doubts.points
    misread = doubt is not None and doubt.wrong_convention
    if points.tell and not misread:
        report.scale_known = True
        factor = points.factor("z")
        if abs(np.log(factor)) > np.log(InspectionTuning.max_ratio) and points.agree("z"):
            how = f"points triangulated by the true poses are {1 / factor:.3g} times as far as depth has them"
            report.judge(judge_scale_by(report.depth_scale, factor, how, InspectionTuning.scale_error))
            return
    if doubt is None:
        return
    if doubt.wrong_convention and doubt.convention in SIDES:
        text = (
            f"the true poses are not of these images, but of {SIDES[doubt.convention].description}: read so, "
            f"neighbouring depth images agree to {doubt.best:.2%}, as they are only to {doubt.error:.2%}; turn colour, "
            "depth and masks back"
        )
        turned = doubt.convention == "turned"  # the world comes out as it is, and the poses' camera stands on its head
        text += "" if turned else ", or text and rooms come out mirrored"
        report.judge([Verdict("mirrored", "doubtful" if turned else "wrong", text)])
    elif doubt.wrong_convention:
        text = (
            f"the true poses look like {CONVENTIONS[doubt.convention].description}: read so, neighbouring depth images "
            f"agree to {doubt.best:.2%}, as {CONVENTIONS[OURS].description} only to {doubt.error:.2%}; "
            f"try `pose_convention` {doubt.convention}"
        )
        report.judge([Verdict("poses", "wrong", text)])
    elif doubt.wrong_scale and not report.scale_known:
        how = f"with another one neighbouring depth images agree with the poses to {doubt.best:.2%}, with this one "
        report.judge(judge_scale_by(report.depth_scale, 1 / doubt.ratio, f"{how}only to {doubt.error:.2%}"))
    elif doubt.error > 0.05:
        causes = "intrinsics or poses" if report.scale_known else "intrinsics, depth scale or poses"
        text = f"true poses and depth disagree by {doubt.error:.0%}: wrong {causes}, or little seen twice"
        report.judge([Verdict("poses", "doubtful", text)])


def _check_camera(report: SequenceReport, sequence: Sequence, frames: list[Frame]) -> None:
    """Judges intrinsics by pairs of frames, unless they are implausible by themselves."""
    doubt = None if report.has_verdict("intrinsics") else doubt_focal_length(pairs_matched(sequence, frames))
    if doubt is not None and doubt.wrong:
        text = (
            f"intrinsics are suspicious: with fx {report.native_camera.fx * doubt.likely:.0f} instead of "
            f"{report.native_camera.fx:.0f} distances of points seen twice agree to {doubt.best:.2%}, so only to "
            f"{doubt.error:.2%}; check fx and fy, and whether they are for this image size"
        )
        report.judge([Verdict("intrinsics", "wrong", text)])


def _check_steps(report: SequenceReport, sequence: Sequence) -> None:
    """Judges whether colour and depth are of the same moment."""
    doubt = doubt_steps(sequence)
    if doubt is None or not doubt.wrong:
        return
    steps = abs(doubt.behind)
    count = f"{steps} or more frames" if steps == StepTuning.reach else "1 frame"
    side = "before" if doubt.behind > 0 else "after"
    text = (
        f"colour and depth are out of step: depth fits the colour of {count} {side} it better (strength of edges "
        f"{doubt.best:.2f}, not {doubt.strength:.2f}); pair images of the same time, perhaps with `depth_delay` "
        f"{-doubt.behind}f"
    )
    report.judge([Verdict("step", "wrong", text)])


def _check_alignment(report: SequenceReport) -> None:
    found = report.alignment
    if found is None or not found.doubtful:
        return
    width = report.camera.width
    parts = [f"{axis} {share * width:+.0f} pixels" for axis, share in zip(("right", "down"), found.shift, strict=True)]
    size = "" if found.scale == 1 else f" and enlarged by {found.scale:g}"
    text = (
        "depth does not lie on colour: its outlines fit the edges of the colour images better when moved "
        f"{', '.join(parts)}{size}; wrong intrinsics, depth that is not registered (`depth_camera`), or images of "
        "different times"
    )
    report.judge([Verdict("alignment", "doubtful", text)])


def _warn(report: SequenceReport, times: np.ndarray, frames: list[Frame]) -> None:
    add = report.warnings.append
    if report.damaged:
        add(f"{len(report.damaged)} of the sampled frames are damaged; the first: {report.damaged[0]}")
    if frames and not report.valid_share:
        add("no depth at all in the sampled frames")
    if frames and 0 < report.valid_share < 0.2:
        add(f"only {report.valid_share:.0%} of the pixels have depth")
    report.judge(judge_times(times, report.time_source.startswith("nominal")))
    if report.motion is not None and (report.motion.step_m[1] > 0.2 or report.motion.turn_deg[1] > 15):
        add(
            f"large motion between frames (90th percentile {report.motion.step_m[1]:.2f} m, "
            f"{report.motion.turn_deg[1]:.0f} degrees): tracking may be lost"
        )
