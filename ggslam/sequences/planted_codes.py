# SPDX-License-Identifier: Apache-2.0
"""Numbers in depth images that are no distance: one that many pixels of all images hold, beyond all that is
measured."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ggslam.errors import SequenceError
from ggslam.sequences.images import LARGEST_CODE, read_stored_depth
from ggslam.sequences.sequence import Sequence
from ggslam.system.tuning import Tuning


class PlantedCodeTuning(Tuning):
    """When a number in depth images is said to mean "not measured"."""

    frames = 6
    """Frames spread over the recording."""
    min_share = 0.005
    """Smallest share of the known pixels that hold the largest number."""
    near = 0.9
    """Share of the largest number from which another one is near it."""
    max_near = 0.1
    """Most pixels near it, as a share of those that hold it."""
    min_frames = 0.6
    """Smallest share of the images that hold it."""
    min_rest = 0.3
    """Smallest share of the known pixels with a much smaller number."""


@dataclass(frozen=True)
class PlantedCode:
    """A stored number that looks like "nothing measured", and the share of the pixels with depth that hold it."""

    code: float
    share: float


def find_planted_code(sequence: Sequence) -> PlantedCode | None:
    """Looks at some depth images as stored; None: nothing of the kind, or it is left out already."""
    images = []
    for number in np.unique(np.linspace(0, len(sequence) - 1, PlantedCodeTuning.frames).round().astype(int)):
        try:
            raw = read_stored_depth(sequence.files(int(number)).depth).astype(np.float64)
        except SequenceError:
            continue
        known = raw[np.isfinite(raw) & (raw > 0) & (raw != LARGEST_CODE) & ~np.isin(raw, sequence.depth_kind.none)]
        if len(known):
            images.append(known)
    if len(images) < 2:
        return None
    values = np.concatenate(images)
    top = float(values.max())
    held, near = (
        float((values == top).mean()),
        float(((values >= PlantedCodeTuning.near * top) & (values < top)).mean()),
    )
    rest = 1 - held - near
    often = float(np.mean([(known == top).mean() > PlantedCodeTuning.min_share / 5 for known in images]))
    planted = (
        held > PlantedCodeTuning.min_share
        and near < PlantedCodeTuning.max_near * held
        and often >= PlantedCodeTuning.min_frames
        and rest > PlantedCodeTuning.min_rest
    )
    return PlantedCode(top, held) if planted else None
