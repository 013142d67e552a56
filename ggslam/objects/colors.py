# SPDX-License-Identifier: Apache-2.0
"""Colours of object ids: the same id always has the same colour, and successive ids have unlike ones."""

from __future__ import annotations

from functools import lru_cache

import cv2
import numpy as np

UNLABELLED = (128, 128, 128)
"""Grey, which no object has."""
_GOLDEN = (5**0.5 - 1) / 2
_TONES = (
    (0.9, 0.6), (0.5, 0.52), (1.0, 0.5), (0.6, 0.62), (0.7, 0.42), (0.8, 0.7), (0.3, 0.92),
    (0.75, 0.8), (0.45, 1.0), (0.35, 0.75), (1.0, 0.78), (0.5, 0.84), (0.9, 0.95), (0.6, 0.95),
)  # fmt: skip
"""Saturation and brightness."""


@lru_cache(maxsize=1)
def id_palette() -> np.ndarray:
    """Colour of every id, uint8 [65536, 3] RGB, read-only; row 0 is `UNLABELLED`.

    Hues step by the golden ratio, so that any few successive ids are spread around the circle. Hues come near again
    after a Fibonacci number of steps (5, 8, 13, 21, 34): none below 46,368 is a multiple of 14, the number of tones.
    """
    ids = np.arange(1 << 16, dtype=np.float64)
    hsv = np.empty((1, len(ids), 3), np.float32)
    hsv[0, :, 0] = 360 * ((ids * _GOLDEN) % 1)
    hsv[0, :, 1:] = np.array(_TONES)[ids.astype(int) % len(_TONES)]
    colors = (255 * cv2.cvtColor(hsv, cv2.COLOR_HSV2RGB)[0] + 0.5).astype(np.uint8)
    colors[0] = UNLABELLED
    colors.setflags(write=False)
    return colors
