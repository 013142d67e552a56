# SPDX-License-Identifier: Apache-2.0
"""Whether images show a scene at all: neighbouring pixels of noise have nothing to do with one another; and whether a
recording shows more than one view of it."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from ggslam.sequences.glances import Glance
from ggslam.sequences.sequence import Sequence
from ggslam.sequences.verdicts import Verdict

LEAST_GRAIN = 0.4
"""Correlation of neighbouring pixels. Recordings, real and generated, have 0.87 and more, noise 0.01."""
LEAST_SURFACE = 0.4
"""Share of neighbours at about the same depth. Recordings have 0.94 and more, random depth 0.05."""
FEWEST, LEAST_SHARE = 2, 0.1
"""Frames that show noise, and their share, from which it is told: a decoder's broken frame is one."""
MOST_NOISE = 0.9
"""Share of the frames from which all are taken to do so."""
REMEDY = "look how the images were written: order of bytes, 8 or 16 bits, compression, a loose cable"
FEWEST_FRAMES = 3
"""Frames of a recording that show whether it is tracked well."""


def judge_noise(glances: list[Glance], numbers: range) -> list[Verdict]:
    """Whether colour or depth is noise; `numbers`: of the frames, by their index."""
    color = [view for view in glances if view.grain < LEAST_GRAIN]
    depth = [view for view in glances if view.surface < LEAST_SURFACE]
    found = []
    if _many(color, glances):
        value = max(0.0, float(np.median([view.grain for view in color])))
        how = f"neighbouring pixels have a correlation of {value:.2f}, those of scenes more than 0.8"
        text = f"colour images show noise {_where(color, glances, numbers)}: {how}"
        found.append(Verdict("color_noise", "doubtful", text))
    if _many(depth, glances):
        value = float(np.median([view.surface for view in depth]))
        how = f"{value:.0%} of neighbouring pixels are about equally far, of scenes more than 90%"
        text = f"depth images show noise {_where(depth, glances, numbers)}: {how}"
        certain = len(depth) >= MOST_NOISE * len(glances)
        text += ", and nothing can be tracked by them" if certain else ""
        found.append(Verdict("depth_noise", "wrong" if certain else "doubtful", text))
    return [replace(verdict, text=f"{verdict.text}; {REMEDY}") for verdict in found]


def _many(noisy: list[Glance], glances: list[Glance]) -> bool:
    return len(noisy) >= min(FEWEST, len(glances)) and len(noisy) > LEAST_SHARE * len(glances)


def _where(noisy: list[Glance], glances: list[Glance], numbers: range) -> str:
    if len(noisy) >= MOST_NOISE * len(glances):
        return "in all frames"
    first, last = numbers[noisy[0].index], numbers[noisy[-1].index]
    return f"in {len(noisy)} of {len(glances)} frames that were looked at, from {first} to {last}"


def judge_views(sequence: Sequence, glances: list[Glance]) -> list[Verdict]:
    """Whether there is but one view, once or again and again: then no motion is seen."""
    if len(sequence) < FEWEST_FRAMES:
        number = "one frame shows" if len(sequence) == 1 else f"{len(sequence)} frames show"
        text = f"{number} no motion that could be checked; record {FEWEST_FRAMES} frames at least, with a moving camera"
        return [Verdict("no_motion", "doubtful", text)]
    same = all(
        np.array_equal(a.grey, b.grey) and np.array_equal(a.depth, b.depth)
        for a, b in zip(glances, glances[1:], strict=False)
    )
    if not same or len(glances) < FEWEST_FRAMES or glances[0].blank:  # along a bare wall, all images are alike
        return []
    text = f"all {len(sequence)} frames hold the same images: one frame, repeated, shows no motion"
    return [Verdict("no_motion", "doubtful", f"{text}; record with a moving camera")]
