# SPDX-License-Identifier: Apache-2.0
"""How settings differ from a baseline: run by run of one recording and one seed, so that what recordings and seeds do
to both falls out."""

from __future__ import annotations

import math
import statistics
from collections.abc import Mapping, Sequence

Scores = Mapping[int, Sequence[float]]
"""By seed, one number a column; NaN where there is none."""
Spread = tuple[tuple[float, ...], tuple[float, ...]]
"""Means and standard deviations, by column; NaN where there is none."""


def differences(own: Scores, baseline: Scores) -> Spread:
    """Mean and standard deviation over seeds of the difference to the baseline, by column.

    Args:
        own, baseline: scores of two choices of settings on one recording; only seeds that both have count.
    """
    shared = [seed for seed in own if seed in baseline]
    columns = len(next(iter(own.values()))) if own else 0
    found = [
        [d for seed in shared if not math.isnan(d := own[seed][k] - baseline[seed][k])] for k in range(columns)
    ]
    means = tuple(statistics.fmean(values) if values else math.nan for values in found)
    return means, tuple(statistics.stdev(values) if len(values) > 1 else math.nan for values in found)
