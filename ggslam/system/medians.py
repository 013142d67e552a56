# SPDX-License-Identifier: Apache-2.0
"""The median of an array, in a tenth of the calls of `np.median`: a frame asks for several."""

from __future__ import annotations

import numpy as np


def median(values: np.ndarray) -> float:
    """Of an array of any shape that has numbers in it and nothing else: what `np.median` gives."""
    ordered, half = values.flatten(), values.size // 2
    if values.size % 2:
        ordered.partition(half)
        return float(ordered[half])
    ordered.partition((half - 1, half))
    return float((ordered[half - 1] + ordered[half]) / 2)
