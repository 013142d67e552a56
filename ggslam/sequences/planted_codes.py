# SPDX-License-Identifier: Apache-2.0
"""Numbers in depth images that are no distance: one that many pixels of all images hold, beyond all that is
measured."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ggslam.errors import SequenceError
from ggslam.sequences.images import LARGEST_CODE, read_stored_depth
from ggslam.sequences.sequence import Sequence

LOOKS = 6
LEAST_SHARE, NEAR, LARGEST_NEAR = 0.005, 0.9, 0.1
"""Share of the known pixels that hold the largest number; what is at least so large a part of it counts as near; so
many times as many pixels may be near."""
FRAMES, LEAST_REST = 0.6, 0.3
"""Share of the images that hold it, and of the known pixels that hold a number much smaller."""


@dataclass(frozen=True)
class PlantedCode:
    """A stored number that looks like "nothing measured", and the share of the pixels with depth that hold it."""

    code: float
    share: float


def find_planted_code(sequence: Sequence) -> PlantedCode | None:
    """Looks at some depth images as stored; None: nothing of the kind, or it is left out already."""
    images = []
    for number in np.unique(np.linspace(0, len(sequence) - 1, LOOKS).round().astype(int)):
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
    held, near = float((values == top).mean()), float(((values >= NEAR * top) & (values < top)).mean())
    rest = 1 - held - near
    often = float(np.mean([(known == top).mean() > LEAST_SHARE / 5 for known in images]))
    planted = held > LEAST_SHARE and near < LARGEST_NEAR * held and often >= FRAMES and rest > LEAST_REST
    return PlantedCode(top, held) if planted else None
