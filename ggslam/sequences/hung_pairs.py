# SPDX-License-Identifier: Apache-2.0
"""Recordings whose two streams hang at once: for some frames colour and depth are both those of one frame. A camera at
rest records that only without noise, so that noise in the repeated depth, or a jump where images go on, has to tell."""

from __future__ import annotations

import numpy as np

from ggslam.errors import SequenceError
from ggslam.sequences.glances import Glance, glance_of
from ggslam.sequences.hung_streams import HungTuning, Spans, Stretch, numbers_of, remedy_for, spans_of
from ggslam.sequences.sequence import Sequence
from ggslam.sequences.verdicts import Verdict
from ggslam.system.tuning import Tuning


class HungPairTuning(Tuning):
    """When frames in which both streams hang are told from a camera at rest."""

    min_noise = 0.0003
    """Second difference of neighbouring inverse depths from which depth shows noise, as a share of the depth."""
    min_noise_steps = 2.0
    """The same in steps of the stored numbers, to which exact depth is rounded."""
    min_triples = 500
    """Fewest triples of neighbours with depth."""
    jump = 2.0
    """Change where images go on, in the largest change of usual neighbours."""
    min_jump = 2.0
    """The same in grey levels."""
    around = 3
    """Neighbours before and after that tell the usual change."""


def judge_hung_pairs(sequence: Sequence, spans: Spans | None = None) -> list[Verdict]:
    """Whether colour and depth hang at once in a part of the recording; `spans`: see `spans_of`."""
    found = find_hung_pairs(sequence, spans)
    if not found:
        return []
    where = numbers_of(sequence, found)
    where += (
        f" and those of {len(found) - HungTuning.max_named} more places" if len(found) > HungTuning.max_named else ""
    )
    text = f"colour and depth hang: frames {where} hold the images of the first of them"
    return [Verdict("both_repeat", "doubtful", f"{text}; {remedy_for(sequence, found)}")]


def find_hung_pairs(sequence: Sequence, spans: Spans | None = None) -> list[Stretch]:
    """Stretches in which both files of all frames hold the same bytes though the camera does not rest, in order; none
    if the whole recording is one."""
    known = spans_of(sequence) if spans is None else spans
    both = [(max(a, c), min(b, d)) for a, b in known["color"] for c, d in known["depth"]]
    long = sorted(span for span in both if span[1] - span[0] + 1 >= HungTuning.min_frames)
    if not long or long == [(0, len(sequence) - 1)]:
        return []
    noisy = _shows_noise(sequence, long[0][0])
    return [Stretch(first, last) for first, last in long if noisy or _jumps(sequence, first, last)]


def _shows_noise(sequence: Sequence, index: int) -> bool:
    """Whether depth of a frame has the noise of a sensor."""
    try:
        depth = sequence.frame(index, masks=False).depth
    except SequenceError:
        return False
    left, middle, right = (depth[:, k::3][:, : depth.shape[1] // 3] for k in range(3))
    known = (left > 0) & (middle > 0) & (right > 0)
    if known.sum() < HungPairTuning.min_triples or sequence.depth_kind.measure == "inverse":
        return False
    left, middle, right = (values[known].astype(np.float64) for values in (left, middle, right))
    bend = np.abs(middle / left - 2 + middle / right)
    step = HungPairTuning.min_noise_steps / sequence.depth_scale / middle
    return bool(np.median(bend / np.maximum(step, HungPairTuning.min_noise)) > 1)


def _jumps(sequence: Sequence, first: int, last: int) -> bool:
    """Whether images go on after a stretch as if the camera had moved on meanwhile."""
    before = [glance_of(sequence, k) for k in range(max(first - HungPairTuning.around, 0), first + 1)]
    after = [glance_of(sequence, k) for k in range(last + 1, min(last + 2 + HungPairTuning.around, len(sequence)))]
    usual = [c for views in (before, after) for a, b in zip(views, views[1:], strict=False) if (c := _change(a, b))]
    jump = _change(before[-1], after[0]) if after else None
    return (
        bool(usual)
        and jump is not None
        and jump > max(HungPairTuning.jump * float(np.max(usual)), HungPairTuning.min_jump)
    )


def _change(a: Glance | None, b: Glance | None) -> float | None:
    return None if a is None or b is None else float(np.abs(a.grey - b.grey).mean())
