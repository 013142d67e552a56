# SPDX-License-Identifier: Apache-2.0
"""Tells which cubes of space are finished while a map is processed section by section."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np


class PendingCubes:
    """Tells which cubes no later section reaches.

    Args:
        of_section: the cubes that each reaches into: keys int64, each once; None: into any.
    """

    def __init__(self, of_section: Sequence[np.ndarray | None]) -> None:
        self._of_section = of_section
        known = [cubes for cubes in of_section if cubes is not None]
        self._keys, self._to_come = np.unique(np.concatenate([np.empty(0, np.int64), *known]), return_counts=True)
        self._left, self._boundless = len(of_section), len(of_section) - len(known)

    @property
    def all_done(self) -> bool:
        """Whether no section is to come."""
        return self._left == 0

    def is_done(self, section: int) -> None:
        """A section is not to come any more."""
        cubes = self._of_section[section]
        if cubes is None:
            self._boundless -= 1
        else:
            self._to_come[np.searchsorted(self._keys, cubes)] -= 1
        self._left -= 1

    def are_done(self, cubes: np.ndarray) -> np.ndarray:
        """Whether no section to come reaches into cubes (keys [N]), bool [N]."""
        if not len(cubes) or self.all_done:
            return np.ones(len(cubes), bool)
        if self._boundless:
            return np.zeros(len(cubes), bool)
        if not len(self._keys):
            return np.ones(len(cubes), bool)
        place = np.searchsorted(self._keys, cubes).clip(max=len(self._keys) - 1)
        return (self._keys[place] != cubes) | (self._to_come[place] == 0)
