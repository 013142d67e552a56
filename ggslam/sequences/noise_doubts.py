# SPDX-License-Identifier: Apache-2.0
"""Checks whether images show a scene, not noise, and whether a recording has more than one view of it."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from ggslam.sequences.sequence import Sequence
from ggslam.sequences.thumbnails import Thumbnail
from ggslam.sequences.verdicts import Verdict
from ggslam.system.tuning import Tuning


class NoiseTuning(Tuning):
    """When images are said to show noise instead of a scene."""

    min_grain = 0.4
    """Smallest correlation of neighbouring grey values. Recordings have 0.87 and more, noise 0.01."""
    min_surface = 0.4
    """Smallest share of neighbours at about the same depth. Recordings have 0.94 and more, random depth 0.05."""
    min_frames = 2
    """Fewest frames that show noise: a decoder's broken frame is one."""
    min_share = 0.1
    """Smallest share of the frames that show noise."""
    all_share = 0.9
    """Share of the frames from which all are said to."""
    min_tracked = 3
    """Fewest frames of a recording for its tracking to be judged."""


REMEDY = "check how the images were written: order of bytes, 8 or 16 bits, compression, a loose cable"


def judge_noise(thumbnails: list[Thumbnail], numbers: range) -> list[Verdict]:
    """Whether colour or depth is noise; `numbers`: of the frames, by their index."""
    color = [view for view in thumbnails if view.grain < NoiseTuning.min_grain]
    depth = [view for view in thumbnails if view.surface < NoiseTuning.min_surface]
    found = []
    if _many(color, thumbnails):
        value = max(0.0, float(np.median([view.grain for view in color])))
        how = f"neighbouring pixels have a correlation of {value:.2f}, those of scenes more than 0.8"
        text = f"colour images show noise {_where(color, thumbnails, numbers)}: {how}"
        found.append(Verdict("color_noise", "doubtful", text))
    if _many(depth, thumbnails):
        value = float(np.median([view.surface for view in depth]))
        how = f"{value:.0%} of neighbouring pixels are about equally far, of scenes more than 90%"
        text = f"depth images show noise {_where(depth, thumbnails, numbers)}: {how}"
        certain = len(depth) >= NoiseTuning.all_share * len(thumbnails)
        text += ", and nothing can be tracked by them" if certain else ""
        found.append(Verdict("depth_noise", "wrong" if certain else "doubtful", text))
    return [replace(verdict, text=f"{verdict.text}; {REMEDY}") for verdict in found]


def _many(noisy: list[Thumbnail], thumbnails: list[Thumbnail]) -> bool:
    return len(noisy) >= min(NoiseTuning.min_frames, len(thumbnails)) and len(noisy) > NoiseTuning.min_share * len(
        thumbnails
    )


def _where(noisy: list[Thumbnail], thumbnails: list[Thumbnail], numbers: range) -> str:
    if len(noisy) >= NoiseTuning.all_share * len(thumbnails):
        return "in all frames"
    first, last = numbers[noisy[0].index], numbers[noisy[-1].index]
    return f"in {len(noisy)} of {len(thumbnails)} frames that were looked at, from {first} to {last}"


def judge_views(sequence: Sequence, thumbnails: list[Thumbnail]) -> list[Verdict]:
    """Whether there is but one view, once or again and again: then no motion is seen."""
    if len(sequence) < NoiseTuning.min_tracked:
        number = "one frame shows" if len(sequence) == 1 else f"{len(sequence)} frames show"
        text = (
            f"{number} no motion that could be checked; record at least {NoiseTuning.min_tracked} frames with a moving "
            "camera"
        )
        return [Verdict("no_motion", "doubtful", text)]
    same = all(
        np.array_equal(a.grey, b.grey) and np.array_equal(a.depth, b.depth)
        for a, b in zip(thumbnails, thumbnails[1:], strict=False)
    )
    if (
        not same or len(thumbnails) < NoiseTuning.min_tracked or thumbnails[0].blank
    ):  # along a bare wall, all images are alike
        return []
    text = f"all {len(sequence)} frames hold the same images: one frame, repeated, shows no motion"
    return [Verdict("no_motion", "doubtful", f"{text}; record with a moving camera")]
