# SPDX-License-Identifier: Apache-2.0
"""Pairs colour with depth that was taken earlier or later than names and lists say (`depth_delay`)."""

from __future__ import annotations

import dataclasses
import re

import numpy as np

from ggslam.errors import SequenceError
from ggslam.sequences.recording import Recording, missing_depth_problems

_DELAY = re.compile(r"([+-]?\d+(?:\.\d+)?)\s*(f|frames?|ms|s)")


def delay_depth(recording: Recording, text: str) -> None:
    """Pairs colour images anew: the depth image beside each was taken so much later than it, as `text` says: "1f"
    (frames; -1f: earlier) or "33ms".

    By frames, colour n gets the depth image of frame n - delay; frames without one are left out. By time, it gets that
    whose time is nearest; what is left of the delay is told to the tracker (`Recording.depth_delays`).

    Raises:
        SequenceError: `text` is no delay, or leaves no frame.
    """
    found = _DELAY.fullmatch(text.strip())
    if found is None or ("f" in found[2] and "." in found[1]):
        raise SequenceError(f"`depth_delay`: expected frames or milliseconds, as 1f, -1f or 33ms; found '{text[:40]}'")
    count = len(recording.files)
    if "f" in found[2]:
        depths, left = np.arange(count) - int(found[1]), None
    else:
        own = 0.0 if recording.depth_delays is None else recording.depth_delays
        times = recording.timestamps + own + float(found[1]) * (1e-3 if found[2] == "ms" else 1.0)
        depths = _nearest(times, recording.timestamps)
        left = times[depths] - recording.timestamps
        depths = np.where(np.abs(left) <= _longest(recording.timestamps), depths, -1)
    chosen = np.flatnonzero((depths >= 0) & (depths < count))
    if not len(chosen):
        raise SequenceError(f"{recording.path}: `depth_delay` {text} leaves no frame of {count}")
    _pair(recording, chosen, depths[chosen])
    recording.depth_delays = None if left is None else left[chosen]


def _nearest(times: np.ndarray, wanted: np.ndarray) -> np.ndarray:
    """Of each wanted time, the number of the nearest of others."""
    order = np.argsort(times, kind="stable")
    at = np.searchsorted(times[order], wanted)
    before, after = order[np.maximum(at - 1, 0)], order[np.minimum(at, len(times) - 1)]
    return np.where(np.abs(times[before] - wanted) <= np.abs(times[after] - wanted), before, after)


def _longest(timestamps: np.ndarray) -> float:
    """Seconds by which a pair may be apart: most of an interval between frames."""
    intervals = np.diff(timestamps)
    return 0.75 * float(np.median(intervals)) if len(intervals) else np.inf


def _pair(recording: Recording, colors: np.ndarray, depths: np.ndarray) -> None:
    """Takes frames with the colour of `colors` and the depth of `depths`; poses and times are colour's."""
    files, old = recording.files, missing_depth_problems(recording.files)
    others = {i: text for i, text in recording.problems.items() if text != old.get(i)}
    recording.files = [
        dataclasses.replace(files[i], depth=files[j].depth, confidence=files[j].confidence)
        for i, j in zip(colors, depths, strict=True)
    ]
    recording.problems = {k: others[i] for k, i in enumerate(colors.tolist()) if i in others}
    recording.problems |= missing_depth_problems(recording.files)
    recording.timestamps = recording.timestamps[colors]
    if recording.poses is not None:
        recording.poses = recording.poses[colors]
