# SPDX-License-Identifier: Apache-2.0
"""Numbers of things in words."""

from __future__ import annotations


def counted(number: int, thing: str) -> str:
    """A number with its noun, such as "1 frame" and "2 frames". The noun's plural ends in s."""
    return f"{number} {thing}" if number == 1 else f"{number} {thing}s"
