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
from ggslam.sequences.alignment import FEWEST_OUTLINES, edges_of, outlines_of
from ggslam.sequences.sequence import Sequence

PLACES = 24
"""Where in a recording one looks."""
LARGEST_S, STEP_S = 0.04, 0.002
"""Offsets that are tried."""
SHIFTS = np.arange(-2, 3)
"""Pixels by which outlines may lie off for another reason, of images some 320 columns wide."""
LEAST_MOTION = 0.5
"""Pixels that outlines have to move in 10 ms in the fastest frames, for anything to be said."""
FEWEST_FRAMES, MOST_POINTS = 6, 500
LARGEST_SPREAD_S = 0.004
"""Standard error from which an offset is no measurement."""


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
    for index in np.unique(np.linspace(0, max(len(sequence) - 2, 0), PLACES).round().astype(int)):
        try:
            frame, later = (sequence.frame(int(index) + k, masks=False) for k in (0, 1))
        except SequenceError:
            continue
        found = _outlines(frame, later)
        if found is not None:
            seen.append(found)
    motion = [float(np.median(np.linalg.norm(outlines.speeds, axis=1))) * 0.01 for outlines in seen]
    if len(seen) < FEWEST_FRAMES or np.percentile(motion, 80) < LEAST_MOTION:
        return None
    scores = np.stack([_scores(outlines) for outlines in seen])
    return _best_offset(scores)


def _outlines(frame: Frame, later: Frame) -> _Outlines | None:
    outlines = outlines_of(frame.depth)
    interval = later.timestamp - frame.timestamp
    if outlines.sum() < FEWEST_OUTLINES * outlines.size or not interval > 0:
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
    scores = np.empty((len(offsets), len(SHIFTS), len(SHIFTS)))
    shifts = np.stack(np.meshgrid(SHIFTS, SHIFTS, indexing="ij"), -1).reshape(-1, 1, 2).astype(np.float32)
    step = -(-len(outlines.places) // MOST_POINTS)
    places, speeds = outlines.places[::step], outlines.speeds[::step]
    for k, offset in enumerate(offsets):
        at = places - offset * speeds + shifts
        hit = cv2.remap(outlines.edges, at[..., 0], at[..., 1], cv2.INTER_LINEAR, borderMode=cv2.BORDER_CONSTANT)
        scores[k] = hit.mean(1).reshape(scores.shape[1:])
    return scores


def _offsets() -> np.ndarray:
    count = round(LARGEST_S / STEP_S)
    return np.arange(-count, count + 1, dtype=np.float32) * np.float32(STEP_S)


def _best_offset(scores: np.ndarray) -> ClockOffset | None:
    """The offset that fits all frames best, with its error by leaving out an eighth of the frames in turn."""
    groups = min(8, len(scores))
    parts = [scores[np.arange(len(scores)) % groups != k].mean(0) for k in range(groups)]
    without = np.array([_peak(part) for part in parts])
    best = _peak(scores.mean(0))
    error = float(np.sqrt((groups - 1) / groups * ((without - without.mean()) ** 2).sum()))
    if error > LARGEST_SPREAD_S or abs(best) > LARGEST_S - 2 * STEP_S:
        return None
    return ClockOffset(best, max(error, STEP_S / 2), len(scores))


def _peak(scores: np.ndarray) -> float:
    """Offset of the highest score over all shifts, between the steps by a parabola."""
    curve = scores.max((1, 2))
    curve = np.convolve(np.pad(curve, 1, mode="edge"), (0.25, 0.5, 0.25), mode="valid")
    at = int(np.clip(curve.argmax(), 1, len(curve) - 2))
    left, middle, right = curve[at - 1 : at + 2]
    bend = left - 2 * middle + right
    return float(_offsets()[at] + STEP_S * (0.5 * (left - right) / bend if bend < 0 else 0.0))
