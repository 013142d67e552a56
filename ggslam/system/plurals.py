# SPDX-License-Identifier: Apache-2.0
"""Words that agree with a number: "1 frame has", "2 frames have"."""

from __future__ import annotations


def plural(count: int, one: str, many: str = "") -> str:
    """The form of a word that goes with a number: `one` with 1, otherwise `many` ("": `one` with an s)."""
    return one if count == 1 else many or f"{one}s"


def quantity(count: int, one: str, many: str = "") -> str:
    """A number with its noun: "1 frame", "2 frames"; forms as in `plural`."""
    return f"{count} {plural(count, one, many)}"
