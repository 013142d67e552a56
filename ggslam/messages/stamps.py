# SPDX-License-Identifier: Apache-2.0
"""Time stamps of messages: whole seconds and nanoseconds."""

from __future__ import annotations

import math
from typing import Final

LAST_SECOND: Final = 2**31 - 1
"""Latest second that ROS 2 can write."""


def seconds_and_nanoseconds(stamp: float) -> tuple[int, int]:
    """A stamp in seconds as (seconds, nanoseconds below 1e9).

    The fraction is taken before it is scaled: the product with 1e9 would round a stamp of today to 256 ns. Stamps
    that cannot be written (not finite, before 1970, after 2038) become the nearest that can, NaN 0.
    """
    if math.isnan(stamp) or stamp <= 0:
        return 0, 0
    if stamp >= LAST_SECOND:
        return LAST_SECOND, 0
    whole = math.floor(stamp)
    nanoseconds = round((stamp - whole) * 1e9)
    return (whole + 1, 0) if nanoseconds == 1_000_000_000 else (whole, nanoseconds)


def whole_nanoseconds(stamp: float) -> int:
    """A stamp in seconds as nanoseconds since 1970."""
    seconds, nanoseconds = seconds_and_nanoseconds(stamp)
    return seconds * 1_000_000_000 + nanoseconds
