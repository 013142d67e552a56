# SPDX-License-Identifier: Apache-2.0
"""Numbers of markers: ROS 2 gives them 32 bits, and things and parts of meshes have names or longer numbers."""

from __future__ import annotations

from typing import Final

LARGEST: Final = 2**31 - 1


class MarkerIds:
    """A number for every key, always the same: a number that fits is its own, all others count down from -1."""

    def __init__(self) -> None:
        self._given: dict[int | str, int] = {}

    def of(self, key: int | str) -> int:
        """The number of a key."""
        if isinstance(key, int) and 0 <= key <= LARGEST:
            return key
        return self._given.setdefault(key, -1 - len(self._given))
