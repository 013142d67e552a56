# SPDX-License-Identifier: Apache-2.0
"""Verdicts on recordings and runs: what seems wrong, the number that shows it, and the remedy.

Here are those that the numbers of a recording alone allow; `ggslam inspect` and runs tell them in the same words.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final, Literal

import numpy as np

from ggslam.system.plurals import plural, quantity
from ggslam.system.tuning import Tuning

Severity = Literal["doubtful", "wrong"]


class VerdictTuning(Tuning):
    """What is usual of rooms, cameras and their motion."""

    min_median_m = 0.1
    """Median depth below which the depth scale is doubted, in metres."""
    max_median_m = 6.0
    """Median depth above which a room's depth scale is doubted, in metres."""
    max_outdoor_m = 60.0
    """Largest median depth outdoors, in metres."""
    usual_median_m = 1.8
    """Usual median depth of rooms, in metres."""
    small_near_m = 0.25
    """Nearest depth of a room that was read too small, in metres: nearer than cameras measure."""
    small_median_m = 0.65
    """Largest median depth of such a room, in metres."""
    small_far_m = 1.4
    """Largest depth of such a room, in metres."""
    max_far_m = 12.0
    """Farthest depth that cameras measure, in metres."""
    min_height_m = 0.5
    """Lowest height above the floor at which cameras are carried, in metres."""
    max_height_m = 2.5
    """Highest height above the floor at which cameras are carried, in metres."""
    min_speed = 0.35
    """Slowest usual speed of a camera, in metres per second."""
    max_speed = 1.5
    """Fastest usual speed of a camera, in metres per second."""
    gap = 2.5
    """Intervals longer than so many usual ones lack frames."""
    missing = 0.05
    """Share of missing frames from which they are reported."""
    missing_s = 0.5
    """Length of a gap from which it is reported, in seconds."""


MILLIMETRES: Final = 1000.0
"""Depth units per metre of depth in millimetres."""
USUAL_SCALES: Final = (1000.0, 5000.0, 6553.5, 4000.0, 10000.0, 512.0, 256.0, 1.0)
"""Depth units per metre that cameras and data sets use."""


@dataclass(frozen=True)
class Verdict:
    """Something that seems wrong.

    Attributes:
        code: which check says so.
        severity: "wrong": results are; "doubtful": they may be.
        text: one sentence with what was measured and what to do.
    """

    code: str
    severity: Severity
    text: str


def usual_scale(scale: float, tolerance: float = 0.15) -> float:
    """The depth scale in use that is nearest to one, or the power of ten, or that itself if none is so near (natural
    logarithm)."""
    power = float(10.0 ** round(np.log10(scale)))
    nearest = min((*USUAL_SCALES, power), key=lambda known: abs(np.log(known / scale)))
    return nearest if abs(np.log(nearest / scale)) < tolerance else float(f"{scale:.3g}")


def judge_depth_scale(scale: float, median_m: float) -> list[Verdict]:
    """What the median depth in metres says of depth with `scale` units per metre."""
    if not median_m > 0 or VerdictTuning.min_median_m <= median_m <= VerdictTuning.max_median_m:
        return []
    candidates = {*USUAL_SCALES, *(scale * 10.0**power for power in range(-4, 5)), *(scale * f for f in (5, 1 / 5))}
    likely = min(candidates, key=lambda known: abs(np.log(median_m * scale / known / VerdictTuning.usual_median_m)))
    found = median_m * scale / likely
    remedy = f"try `depth_scale` {likely:g}, with which it is {found:.2g} m"
    if VerdictTuning.max_median_m < median_m <= VerdictTuning.max_outdoor_m:
        text = f"depth scale {scale:g} is doubtful if this is a room: the median depth is {median_m:.3g} m"
        return [Verdict("depth_scale", "doubtful", f"{text}; outdoors it may be right, indoors {remedy}")]
    text = f"depth scale {scale:g} is suspicious: the median depth is {median_m:.3g} m"
    return [Verdict("depth_scale", "wrong", f"{text}; {remedy}")]


def judge_inverse_scale(scale: float, median_m: float) -> list[Verdict]:
    """Whether a depth scale is metres per unit instead of units per metre."""
    read_so = median_m * scale * scale
    if not (
        scale < 1
        and median_m > VerdictTuning.max_outdoor_m
        and VerdictTuning.min_median_m <= read_so <= VerdictTuning.max_outdoor_m
    ):
        return []
    text = (
        f"depth scale {scale:g} looks like metres per unit, with units per metre expected: the median depth is "
        f"{median_m:.3g} m; try `depth_scale` {1 / scale:.6g} (1 / {scale:g}), with which it is {read_so:.2g} m"
    )
    return [Verdict("depth_scale", "wrong", text)]


@dataclass(frozen=True)
class ScaleSigns:
    """Signs of the size of a recording's world, in metres at its depth scale.

    Attributes:
        near, median, far: 1st, 50th and 99th percentile of depth.
        floor: height of the camera above the floor, or a table; None if none is seen.
        speed: of the camera, metres a second; None if it cannot be told.
    """

    near: float
    median: float
    far: float
    floor: float | None
    speed: float | None


def judge_scale_signs(scale: float, signs: ScaleSigns) -> list[Verdict]:
    """What the size of the world says of depth with `scale` units per metre, where no pose tells more: nothing unless
    all that was measured points the same way. Millimetres are never called too small: cameras write them of near things
    too."""
    carried = signs.floor is None or signs.floor < VerdictTuning.min_height_m
    slow = signs.speed is None or signs.speed < VerdictTuning.min_speed
    low = signs.near < VerdictTuning.small_near_m or (
        signs.floor is not None and signs.floor < VerdictTuning.min_height_m
    )
    small = (
        signs.median < VerdictTuning.small_median_m
        and signs.far < VerdictTuning.small_far_m
        and low
        and carried
        and slow
    )
    high = signs.floor is None or signs.floor > VerdictTuning.max_height_m
    large = (
        signs.far > VerdictTuning.max_far_m and high and (signs.speed is None or signs.speed > VerdictTuning.max_speed)
    )
    if not (small or large):
        return []
    others = [known for known in USUAL_SCALES if (MILLIMETRES <= known < scale if small else known > scale)]
    if not others:
        return []
    likely = min(others, key=lambda known: abs(np.log(signs.median * scale / known / VerdictTuning.usual_median_m)))
    words = [f"depth from {signs.near:.2g} to {signs.far:.2g} m, median {signs.median:.2g} m"]
    words += [f"the camera {signs.floor:.2g} m above the floor"] if signs.floor is not None else []
    words += [f"moving {signs.speed:.2g} m a second"] if signs.speed is not None else []
    text = f"depth scale {scale:g} is doubtful if this is a room: {', '.join(words)}"
    text += f"; try `depth_scale` {likely:g}, with which the median depth is {signs.median * scale / likely:.2g} m"
    return [Verdict("depth_scale", "doubtful", text)]


def judge_scale_by(scale: float, ratio: float, how: str, tolerance: float = 0.15) -> list[Verdict]:
    """That lengths come out `ratio` times too large with `scale` units per metre, as `how` says; the ratio is known to
    `tolerance` (natural logarithm)."""
    likely = usual_scale(scale * ratio, tolerance)
    text = f"depth scale {scale:g} is suspicious: {how}; try `depth_scale` {likely:g}"
    return [Verdict("depth_scale", "wrong", text)]


def judge_times(timestamps: np.ndarray, nominal: bool = False) -> list[Verdict]:
    """What timestamps [n] in seconds, in the order of the frames, say. `nominal`: they only count frames, by the
    numbers in the images' names."""
    intervals = np.diff(timestamps)
    verdicts = []
    back = np.flatnonzero(intervals <= 0)
    if len(intervals) and not intervals.any():
        text = f"all {len(timestamps)} time stamps are the same, {timestamps[0]:.6g} s; delete them (times then follow "
        return [Verdict("time", "doubtful", f"{text}from the frame rate) or write them again")]
    if len(back):
        where, step = int(back[0]) + 1, intervals[back[0]]
        text = f"{len(back)} timestamps are not later than the one before (frame {where}: {step:+.3g} s)"
        verdicts.append(
            Verdict("time", "doubtful", f"timestamps do not increase from frame to frame: {text}; sort the recording")
        )
    usual = float(np.median(intervals[intervals > 0])) if (intervals > 0).any() else 0.0
    gaps = np.flatnonzero(intervals > VerdictTuning.gap * usual) if usual else np.zeros(0, int)
    if len(gaps):
        missing, longest = int(np.rint(intervals[gaps] / usual - 1).sum()), gaps[intervals[gaps].argmax()]
        if missing > VerdictTuning.missing * len(timestamps) or intervals[longest] > max(
            VerdictTuning.missing_s, 6 * usual
        ):
            place = "numbers of the images" if nominal else "timestamps"
            length = (
                quantity(round(intervals[longest] / usual) - 1, "frame") if nominal else f"{intervals[longest]:.2f} s"
            )
            are = plural(missing, "is", "are")
            text = f"about {quantity(missing, 'frame')} {are} missing in {quantity(len(gaps), 'gap')} of the {place}"
            text += f" (the longest: {length} before frame {longest + 1})"
            verdicts.append(Verdict("frames_missing", "doubtful", f"{text}; record to a faster disk, or fewer pixels"))
    return verdicts
