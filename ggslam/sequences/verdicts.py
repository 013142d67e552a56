# SPDX-License-Identifier: Apache-2.0
"""Verdicts on recordings and runs: what seems wrong, with the number that says so, and what to do about it.

Here are those that the numbers of a recording alone allow; `ggslam inspect` and runs tell them in the same words.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np

Severity = Literal["doubtful", "wrong"]

SMALLEST_MEDIAN_DEPTH, LARGEST_MEDIAN_DEPTH = 0.1, 6.0
"""Metres; a median depth outside suggests a wrong depth scale in rooms."""
FARTHEST = 60.0
"""Metres, beyond the median depth of what is seen outdoors."""
USUAL_MEDIAN_DEPTH = 1.8
"""Metres; of rooms."""
MILLIMETRES = 1000.0
SMALL_NEAR, SMALL_MEDIAN, SMALL_FAR = 0.25, 0.65, 1.4
"""Metres: depth of a room that is read too small lies nearer than cameras measure, and ends where a room begins."""
LARGEST_FAR = 12.0
"""Metres, beyond what depth cameras measure."""
LOWEST_CARRIED, HIGHEST_CARRIED = 0.5, 2.5
"""Metres above the floor, between which cameras are carried."""
SLOW, FAST = 0.35, 1.5
"""Metres a second, between which cameras usually move."""
USUAL_SCALES = (1000.0, 5000.0, 6553.5, 4000.0, 10000.0, 512.0, 256.0, 1.0)
"""Depth units per metre that cameras and data sets use."""
GAP = 2.5
"""Intervals that are longer than so many usual ones lack frames."""
MISSING_SHARE, MISSING_S = 0.05, 0.5
"""Share of the frames that lack, and length of one gap in seconds, from which it is told."""


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
    if not median_m > 0 or SMALLEST_MEDIAN_DEPTH <= median_m <= LARGEST_MEDIAN_DEPTH:
        return []
    candidates = {*USUAL_SCALES, *(scale * 10.0**power for power in range(-4, 5)), *(scale * f for f in (5, 1 / 5))}
    likely = min(candidates, key=lambda known: abs(np.log(median_m * scale / known / USUAL_MEDIAN_DEPTH)))
    found = median_m * scale / likely
    remedy = f"try `depth_scale` {likely:g}, with which it is {found:.2g} m"
    if LARGEST_MEDIAN_DEPTH < median_m <= FARTHEST:
        text = f"depth scale {scale:g} is doubtful if this is a room: the median depth is {median_m:.3g} m"
        return [Verdict("depth_scale", "doubtful", f"{text}; outdoors it may be right, indoors {remedy}")]
    text = f"depth scale {scale:g} is suspicious: the median depth is {median_m:.3g} m"
    return [Verdict("depth_scale", "wrong", f"{text}; {remedy}")]


def judge_inverse_scale(scale: float, median_m: float) -> list[Verdict]:
    """Whether a depth scale is metres per unit instead of units per metre."""
    read_so = median_m * scale * scale
    if not (scale < 1 and median_m > FARTHEST and SMALLEST_MEDIAN_DEPTH <= read_so <= FARTHEST):
        return []
    text = (
        f"depth scale {scale:g} looks like metres per unit, with units per metre expected: the median depth is "
        f"{median_m:.3g} m; try `depth_scale` {1 / scale:.6g} (1 / {scale:g}), with which it is {read_so:.2g} m"
    )
    return [Verdict("depth_scale", "wrong", text)]


@dataclass(frozen=True)
class ScaleSigns:
    """What tells how large the world of a recording is, in metres of its depth scale.

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
    carried = signs.floor is None or signs.floor < LOWEST_CARRIED
    slow = signs.speed is None or signs.speed < SLOW
    low = signs.near < SMALL_NEAR or (signs.floor is not None and signs.floor < LOWEST_CARRIED)
    small = signs.median < SMALL_MEDIAN and signs.far < SMALL_FAR and low and carried and slow
    high = signs.floor is None or signs.floor > HIGHEST_CARRIED
    large = signs.far > LARGEST_FAR and high and (signs.speed is None or signs.speed > FAST)
    if not (small or large):
        return []
    others = [known for known in USUAL_SCALES if (MILLIMETRES <= known < scale if small else known > scale)]
    if not others:
        return []
    likely = min(others, key=lambda known: abs(np.log(signs.median * scale / known / USUAL_MEDIAN_DEPTH)))
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
    gaps = np.flatnonzero(intervals > GAP * usual) if usual else np.zeros(0, int)
    if len(gaps):
        missing, longest = int(np.rint(intervals[gaps] / usual - 1).sum()), gaps[intervals[gaps].argmax()]
        if missing > MISSING_SHARE * len(timestamps) or intervals[longest] > max(MISSING_S, 6 * usual):
            place = "numbers of the images" if nominal else "timestamps"
            length = f"{round(intervals[longest] / usual) - 1} frames" if nominal else f"{intervals[longest]:.2f} s"
            text = f"about {missing} frames are missing in {len(gaps)} gaps of the {place}"
            text += f" (the longest: {length} before frame {longest + 1})"
            verdicts.append(Verdict("frames_missing", "doubtful", f"{text}; record to a faster disk, or fewer pixels"))
    return verdicts
