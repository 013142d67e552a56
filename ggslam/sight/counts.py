# SPDX-License-Identifier: Apache-2.0
"""Counts what many views say about the same places.

One view errs by its pose, at outlines, and where depth was guessed; several have to agree. While a map is made, views
come, are moved by closed loops, and are forgotten: `SightCounts` takes each view's answers, and takes them back.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ggslam.sight.view import Answers


@dataclass(frozen=True)
class SightCounts:
    """How many views give each answer for each of n places, int32 [n] each.

    Attributes:
        through: surely look through it.
        same: show a surface there.
        behind: show something before it.
        inside: have it in their image.
    """

    through: np.ndarray
    same: np.ndarray
    behind: np.ndarray
    inside: np.ndarray

    @staticmethod
    def none(count: int) -> SightCounts:
        """Of `count` places that no view was asked about."""
        return SightCounts(*np.zeros((4, count), np.int32))

    def add(self, answers: Answers) -> None:
        """A view's answers count."""
        self._count(answers, 1)

    def remove(self, answers: Answers) -> None:
        """Answers that were added count no more: the view was forgotten, or has moved and is asked again."""
        self._count(answers, -1)

    def is_looked_through(self, least: int, ratio: float) -> np.ndarray:
        """bool [n]: at least `least` views look through it, and `ratio` times as many as show a surface there."""
        return (self.through >= least) & (self.through >= ratio * self.same)

    def _count(self, answers: Answers, by: int) -> None:
        for name in ("through", "same", "behind", "inside"):
            getattr(self, name)[getattr(answers, name)] += by
