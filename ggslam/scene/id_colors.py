# SPDX-License-Identifier: Apache-2.0
"""Colours of object ids: the same id always has the same colour, and successive ids have unlike ones."""

from __future__ import annotations

from functools import lru_cache
from typing import Final

import cv2
import numpy as np

from ggslam.system.tuning import Tuning


class PaletteTuning(Tuning):
    """The colours of object ids."""

    unlabelled = (128, 128, 128)
    """RGB of what has no object; no object has this grey."""
    tones = (
    (0.9, 0.6), (0.5, 0.52), (1.0, 0.5), (0.6, 0.62), (0.7, 0.42), (0.8, 0.7), (0.3, 0.92),
    (0.75, 0.8), (0.45, 1.0), (0.35, 0.75), (1.0, 0.78), (0.5, 0.84), (0.9, 0.95), (0.6, 0.95),
)
    """Saturation and brightness, cycled through by id."""


_GOLDEN: Final = (5**0.5 - 1) / 2
"""The golden ratio: its multiples spread hues evenly."""


@lru_cache(maxsize=1)
def id_palette() -> np.ndarray:
    """Colour of every id, uint8 [65536, 3] RGB, read-only; row 0 is `PaletteTuning.unlabelled`.

    Hues step by the golden ratio, so that any few successive ids are spread around the circle. Hues come near again
    after a Fibonacci number of steps (5, 8, 13, 21, 34): none below 46,368 is a multiple of 14, the number of tones.
    """
    ids = np.arange(1 << 16, dtype=np.float64)
    hsv = np.empty((1, len(ids), 3), np.float32)
    hsv[0, :, 0] = 360 * ((ids * _GOLDEN) % 1)
    hsv[0, :, 1:] = np.array(PaletteTuning.tones)[ids.astype(int) % len(PaletteTuning.tones)]
    colors = (255 * cv2.cvtColor(hsv, cv2.COLOR_HSV2RGB)[0] + 0.5).astype(np.uint8)
    colors[0] = PaletteTuning.unlabelled
    colors.setflags(write=False)
    return colors
