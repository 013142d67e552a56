# SPDX-License-Identifier: Apache-2.0
"""Scores how well a motion aligns a candidate with its counterpart in the other visit."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.spatial import cKDTree

from ggslam.changes.candidates import color_apart
from ggslam.changes.settings import ChangeSettings
from ggslam.changes.shape import Shape
from ggslam.changes.sightings import Evidence, Sightings
from ggslam.scene.poses import inverse, transform_points
from ggslam.sight.margin import Margin
from ggslam.system.tuning import Tuning


class AlignmentScoreTuning(Tuning):
    """How the alignment of two surfaces is scored."""

    apart_m = 0.05
    """Distance between surfaces that costs as much as a full share of fit, in metres."""
    min_seen = 0.5
    """Share of the surfaces that both visits must see to know a rotation: sides look alike."""
    overlap = 0.6
    """Share of the points, the nearest, that measure the distance between surfaces."""
    points = 3000
    """Points that a motion is scored by."""
    quick_points = 300
    """Points that many motions are checked by."""


@dataclass(frozen=True)
class Fit:
    """A candidate of the older visit, moved onto one of the newer.

    Attributes:
        T_new_old: float64 [4, 4], world.
        share: of the surfaces that fits, of what both visits saw of it; the worse of the two ways.
        seen: share of the surfaces that both visits saw; the worse of the two ways.
        color_apart: how much the colours differ.
        apart_m: how far the surfaces lie apart, in places and colours, where they fit best; metres.
        as_good_deg: turned by so many degrees more it fits about as well: round things and plain ones tell no turn;
            None: it does not.
        sides_may_differ: whether the visits may have seen different sides of it, which look alike.
        repainted: whether its colours differ too much for them to tell a turn.
    """

    T_new_old: np.ndarray
    share: float
    seen: float
    color_apart: float
    apart_m: float = 0.0
    as_good_deg: float | None = None
    sides_may_differ: bool = False
    repainted: bool = False

    def quality(self) -> float:
        """For choosing among fits: more is better."""
        return self.share - self.color_apart - self.apart_m / AlignmentScoreTuning.apart_m

    @property
    def turn_known(self) -> bool:
        """Whether the thing's turn can be told."""
        return self.turn_reason is None

    @property
    def turn_reason(self) -> str | None:
        """Why the thing's turn cannot be told; None: it can."""
        if self.as_good_deg is not None:
            return f"turned by {self.as_good_deg:g} degrees more it fits about as well"
        if self.seen < AlignmentScoreTuning.min_seen:
            return f"both visits saw only {100 * self.seen:.0f} % of it"
        if self.sides_may_differ:
            return "the visits may have seen different sides of it"
        if self.repainted:
            return "its colours differ"
        return None


class Judge:
    """Scores motions of a candidate onto its counterpart in the other visit."""

    def __init__(
        self, old: Shape, new: Shape, sights_old: Sightings, sights_new: Sightings, settings: ChangeSettings
    ) -> None:
        self.settings = settings
        self._within = Margin(settings.fit_m, settings.tolerance_relative)
        rng = np.random.default_rng(0)
        old, new = old.sample(AlignmentScoreTuning.points, rng), new.sample(AlignmentScoreTuning.points, rng)
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
            apart.append(float(off[: max(1, round(AlignmentScoreTuning.overlap * len(off)))].mean()))
        known = [value for value in colors if np.isfinite(value)]
        return Fit(T, min(shares), min(seen), max(known) if known else 1.0, max(apart))

    def clashes(self, motions: list[np.ndarray]) -> np.ndarray:
        """Of each motion T_new_old, float64 [m], how much of either surface lies where the other visit saw through; the
        worse of the two ways. What is hidden there clashes with nothing."""
        worst = np.zeros(len(motions))
        for k, (shape, sights, _, _) in enumerate(self._sides):
            few = shape.points[:AlignmentScoreTuning.quick_points]
            moved = [transform_points(few, inverse(T) if k else T) for T in motions]
            found = sights.look_up(np.concatenate(moved), self._within)
            worst = np.maximum(worst, _is_gone(found).reshape(len(motions), -1).mean(1))
        return worst


def _is_gone(found: Evidence) -> np.ndarray:
    """Where a visit saw through, bool [n]."""
    return (found.through > 0) & (found.through >= found.present)


def _share_there(found: Evidence, near: np.ndarray) -> tuple[float, float]:
    """Share of moved points that are seen where the other thing is, of those that the visit could see, and share of
    these."""
    gone = _is_gone(found)
    there = (found.present > 0) & ~gone
    judged = int(there.sum() + gone.sum())
    return int((there & near).sum()) / max(1, judged), judged / max(1, len(there))
