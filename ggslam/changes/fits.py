# SPDX-License-Identifier: Apache-2.0
"""How well motions bring a thing upon what it may be in the other visit."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.spatial import cKDTree

from ggslam.changes.settings import ChangeSettings
from ggslam.changes.shape import Shape
from ggslam.changes.sightings import Evidence, Sightings, Tolerance
from ggslam.changes.things import color_apart
from ggslam.scene.poses import inverse

_APART_M = 0.05
"""Metres that surfaces lie apart which count as much as all that fits."""
_TURN_SEEN = 0.5
"""Share of the surfaces that both visits saw, from which they tell a turn: sides of a thing look alike."""
_OVERLAP, _JUDGED = 0.6, 3000
"""Share of the points, the nearest, that tell how far surfaces lie apart, and points that motions are judged by."""


@dataclass(frozen=True)
class Fit:
    """A thing before, moved onto a thing after.

    Attributes:
        T_new_old: float64 [4, 4], world.
        share: of the surfaces that fits, of what both visits saw of it; the worse of the two ways.
        seen: share of the surfaces that both visits saw; the worse of the two ways.
        color_apart: how much the colours differ.
        apart_m: how far the surfaces lie apart, in places and colours, where they fit best; metres.
        as_good_deg: turned by so many degrees more about the vertical it fits as well: round things and plain ones tell
            no turn; None: it does not.
    """

    T_new_old: np.ndarray
    share: float
    seen: float
    color_apart: float
    apart_m: float = 0.0
    as_good_deg: float | None = None

    def quality(self) -> float:
        """For choosing among fits: more is better."""
        return self.share - self.color_apart - self.apart_m / _APART_M

    @property
    def turn_known(self) -> bool:
        """Whether the thing's turn can be told."""
        return self.turn_reason is None

    @property
    def turn_reason(self) -> str | None:
        """Why the thing's turn cannot be told; None: it can."""
        if self.as_good_deg is not None:
            return f"turned by {self.as_good_deg:g} degrees more it fits as well"
        if self.seen < _TURN_SEEN:
            return f"both visits saw only {100 * self.seen:.0f} % of it"
        return None


class Judge:
    """Tells how well motions bring a thing upon what it may be in the other visit."""

    def __init__(
        self, old: Shape, new: Shape, sights_old: Sightings, sights_new: Sightings, settings: ChangeSettings
    ) -> None:
        self.settings = settings
        self._within = Tolerance(settings.fit_m, settings.tolerance_relative)
        rng = np.random.default_rng(0)
        old, new = old.sample(_JUDGED, rng), new.sample(_JUDGED, rng)
        self._sides = [
            (shape, sights, cKDTree(other.points), cKDTree(other.joint()))
            for shape, other, sights in ((old, new, sights_new), (new, old, sights_old))
        ]

    def fit(self, T: np.ndarray) -> Fit:
        """A motion T_new_old, judged."""
        shares, seen, colors, apart = [], [], [], []
        for (shape, sights, tree, joint), motion in zip(self._sides, (T, inverse(T)), strict=True):
            moved = shape.move(motion)
            found = sights.look_up(moved.points, self._within)
            share, judged = _share_there(found, tree.query(moved.points)[0] < 2 * self.settings.fit_m)
            shares.append(share)
            seen.append(judged)
            colors.append(color_apart(shape.colors, found.color))
            off = np.sort(joint.query(moved.joint(), workers=-1)[0])
            apart.append(float(off[: max(1, round(_OVERLAP * len(off)))].mean()))
        known = [value for value in colors if np.isfinite(value)]
        return Fit(T, min(shares), min(seen), max(known) if known else 1.0, max(apart))


def _share_there(found: Evidence, near: np.ndarray) -> tuple[float, float]:
    """Share of moved points that are seen where the other thing is, of those that the visit could see, and share of
    these."""
    gone = (found.through > 0) & (found.through >= found.present)
    there = (found.present > 0) & ~gone
    judged = int(there.sum() + gone.sum())
    return int((there & near).sum()) / max(1, judged), judged / max(1, len(there))
