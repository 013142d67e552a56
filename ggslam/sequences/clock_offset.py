# SPDX-License-Identifier: Apache-2.0
"""By how much time depth and colour are apart, measured from the images.

While the camera moves, an image that is taken later shows everything a little farther on. The outlines of depth are
moved back along the motion of colour, by so many milliseconds as lay them best on the edges of colour.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np

from ggslam.errors import SequenceError
from ggslam.scene.frame import Frame
from ggslam.sequences.alignment import AlignmentTuning, edges_of, outlines_of
from ggslam.sequences.sequence import Sequence
from ggslam.system.tuning import Tuning


class ClockTuning(Tuning):
    """How the time between depth and colour is measured."""

    places = 24
    """Frames spread over the recording that are compared."""
    max_offset_s = 0.04
    """Largest offset that is tried, in seconds."""
    step_s = 0.002
    """Step between offsets, in seconds."""
    shifts_px = np.arange(-2, 3)
    """Displacements that outlines may have for other reasons, in pixels of the small images."""
    min_motion_px = 0.5
    """Motion of outlines in 10 ms in the fastest frames from which an offset can be told, in pixels."""
    min_frames = 6
    """Fewest frames with outlines."""
    max_points = 500
    """Most outline pixels of a frame."""
    max_error_s = 0.004
    """Largest standard error of an offset that is reported, in seconds."""


@dataclass(frozen=True)
class ClockOffset:
    """How depth lies to colour in time.

    Attributes:
        seconds: depth was taken so much later than colour of the same frame; negative: earlier.
        error: its standard error, seconds.
        frames: how many told it.
    """

    seconds: float
    error: float
    frames: int


@dataclass(frozen=True)
class _Outlines:
    """Outlines of a depth image over the edges of its colour image.

    Attributes:
        edges: float32 [H, W].
        places: (column, row) of the outlines, float32 [n, 2].
        speeds: of colour there, pixels a second, float32 [n, 2].
    """

    edges: np.ndarray
    places: np.ndarray
    speeds: np.ndarray


def measure_clock_offset(sequence: Sequence) -> ClockOffset | None:
    """Compares depth with colour in frames spread over a recording; None if little moves or few outlines are seen."""
    seen = []
    for index in np.unique(np.linspace(0, max(len(sequence) - 2, 0), ClockTuning.places).round().astype(int)):
        try:
            frame, later = (sequence.frame(int(index) + k, masks=False) for k in (0, 1))
        except SequenceError:
            continue
        found = _outlines(frame, later)
        if found is not None:
            seen.append(found)
    motion = [float(np.median(np.linalg.norm(outlines.speeds, axis=1))) * 0.01 for outlines in seen]
    if len(seen) < ClockTuning.min_frames or np.percentile(motion, 80) < ClockTuning.min_motion_px:
        return None
    scores = np.stack([_scores(outlines) for outlines in seen])
    return _best_offset(scores)


def _outlines(frame: Frame, later: Frame) -> _Outlines | None:
    outlines = outlines_of(frame.depth)
    interval = later.timestamp - frame.timestamp
    if outlines.sum() < AlignmentTuning.min_outlines * outlines.size or not interval > 0:
        return None
    height, width = outlines.shape
    one, other = (
        cv2.cvtColor(cv2.resize(f.color, (width, height), interpolation=cv2.INTER_AREA), cv2.COLOR_RGB2GRAY)
        for f in (frame, later)
    )
    flow = cv2.DISOpticalFlow_create(cv2.DISOPTICAL_FLOW_PRESET_FAST).calc(one, other, None)  # type: ignore[attr-defined, call-overload]
    rows, columns = np.nonzero(outlines)
    places = np.stack([columns, rows], 1).astype(np.float32)
    return _Outlines(edges_of(frame.color), places, flow[rows, columns] / np.float32(interval))


def _scores(outlines: _Outlines) -> np.ndarray:
    """Mean strength of edges under the outlines for every offset and shift, float64 [offsets, shifts, shifts]."""
    offsets = _offsets()
    scores = np.empty((len(offsets), len(ClockTuning.shifts_px), len(ClockTuning.shifts_px)))
    shifts = (
        np.stack(np.meshgrid(ClockTuning.shifts_px, ClockTuning.shifts_px, indexing="ij"), -1)
        .reshape(-1, 1, 2)
        .astype(np.float32)
    )
    step = -(-len(outlines.places) // ClockTuning.max_points)
    places, speeds = outlines.places[::step], outlines.speeds[::step]
    for k, offset in enumerate(offsets):
        at = places - offset * speeds + shifts
        hit = cv2.remap(outlines.edges, at[..., 0], at[..., 1], cv2.INTER_LINEAR, borderMode=cv2.BORDER_CONSTANT)
        scores[k] = hit.mean(1).reshape(scores.shape[1:])
    return scores


def _offsets() -> np.ndarray:
    count = round(ClockTuning.max_offset_s / ClockTuning.step_s)
    return np.arange(-count, count + 1, dtype=np.float32) * np.float32(ClockTuning.step_s)


def _best_offset(scores: np.ndarray) -> ClockOffset | None:
    """The offset that fits all frames best, with its error by leaving out an eighth of the frames in turn."""
    groups = min(8, len(scores))
    parts = [scores[np.arange(len(scores)) % groups != k].mean(0) for k in range(groups)]
    without = np.array([_peak(part) for part in parts])
    best = _peak(scores.mean(0))
    error = float(np.sqrt((groups - 1) / groups * ((without - without.mean()) ** 2).sum()))
    if error > ClockTuning.max_error_s or abs(best) > ClockTuning.max_offset_s - 2 * ClockTuning.step_s:
        return None
    return ClockOffset(best, max(error, ClockTuning.step_s / 2), len(scores))


def _peak(scores: np.ndarray) -> float:
    """Offset of the highest score over all shifts, between the steps by a parabola."""
    curve = scores.max((1, 2))
    curve = np.convolve(np.pad(curve, 1, mode="edge"), (0.25, 0.5, 0.25), mode="valid")
    at = int(np.clip(curve.argmax(), 1, len(curve) - 2))
    left, middle, right = curve[at - 1 : at + 2]
    bend = left - 2 * middle + right
    return float(_offsets()[at] + ClockTuning.step_s * (0.5 * (left - right) / bend if bend < 0 else 0.0))
