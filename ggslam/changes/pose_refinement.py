# SPDX-License-Identifier: Apache-2.0
"""Where exactly a thing lies that moved: each visit's surface is brought to agree with the pictures of the other visit.

Surfaces laid upon each other do not tell: of a board one visit saw the front and the other the back, and they are not
one. Faces, backs and outlines in pictures tell it of every thing, also where visits saw no face in common.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ggslam.changes.candidate_views import CandidateViews
from ggslam.changes.upright import LEVEL, tilt, upright, without_tilt
from ggslam.geometry.colored_surface import ColoredSurface
from ggslam.scene.poses import inverse, se3_exp, transform_points, translation

_SAMPLE = 400
"""Points of either surface that are looked up in pictures."""
_BESIDE_M = 0.035
"""Metres beside a motion that others start at, on its eight sides: by a board's or a post's thickness it may be off."""
_FALLEN, _STANDING_COSTS = np.radians(30), 0.01
"""What tilts a thing less may be noise, and so much more cost of a motion that keeps it upright."""
_FARTHEST_M, _AWAY_COSTS = 0.08, 0.1
"""Metres from a motion that the thing is placed within, and cost of each: of places about as good the nearest
is told."""
_TURNED = np.radians(12)
"""What others are turned by."""
_COARSE_M, _FINE_M = 0.02, 0.01
"""Residuals that count half."""
_COARSE_STEPS, _FINE_STEPS, _KEPT = 8, 15, 3
"""Steps of the two stages, and motions that are kept after the first."""
_DAMPING = (1e-3, 1e-5, 1e3)
"""Of Levenberg and Marquardt: at the start, the least, and the most."""
_ENOUGH = 1e-5
"""Less of the cost gained ends the steps."""


@dataclass(frozen=True)
class _Terms:
    """How little pictures agree, 0 to 1, and the normal equations of a better twist."""

    cost: float
    H: np.ndarray
    g: np.ndarray


class PoseRefinement:
    """A thing in two visits.

    Args:
        old, new: its surfaces.
        views: of it in the older and the newer visit.
    """

    def __init__(self, old: ColoredSurface, new: ColoredSurface, views: tuple[CandidateViews, CandidateViews]) -> None:
        rng = np.random.default_rng(0)
        self._old, self._new = (s.at(rng.permutation(len(s))[:_SAMPLE]) for s in (old, new))
        self._views = views

    def place(self, T: np.ndarray, up: np.ndarray) -> np.ndarray:
        """The motion T_new_old [4, 4] near by on which the pictures agree most, one that keeps the thing upright if
        they agree about as well on it. `up`: [3], unit vector."""
        if not len(self._views[0]) or not len(self._views[1]):
            return T
        tilted = tilt(T, up)
        if tilted >= _FALLEN:
            return self._search(T, np.eye(6), up)[0]
        level = self._search(without_tilt(T, up, self._old.points.mean(0)), upright(up), up)
        if tilted < LEVEL:
            return level[0]
        free = self._search(T, np.eye(6), up)
        return level[0] if level[1] <= free[1] + _STANDING_COSTS else free[0]

    def _search(self, T: np.ndarray, free: np.ndarray, up: np.ndarray) -> tuple[np.ndarray, float]:
        """The best motion near one, by twists [6, k] about the thing's middle, and its cost."""
        beside = np.linalg.svd(up[None])[2][1:] * _BESIDE_M
        starts = [translation(a * beside[0] + b * beside[1]) @ T for a in (-1, 0, 1) for b in (-1, 0, 1)]
        found = [self._refine(start, free, _COARSE_M, _COARSE_STEPS) for start in starts]
        best = min(found, key=_cost)[0]
        middle = self._middle(best)
        for angle in (-_TURNED, _TURNED):
            turn = se3_exp(angle * np.append(np.zeros(3), up))
            start = translation(middle) @ turn @ translation(-middle) @ best
            found.append(self._refine(start, free, _COARSE_M, _COARSE_STEPS))
        kept = sorted(found, key=_cost)[:_KEPT]
        ends = [self._refine(start, free, _FINE_M, _FINE_STEPS) for start, _ in kept]
        near = [end for end in ends if self._away(end[0], T) < _FARTHEST_M]
        return min(near, key=lambda end: end[1] + _AWAY_COSTS * self._away(end[0], T), default=(T, self.cost(T)))

    def _away(self, T: np.ndarray, other: np.ndarray) -> float:
        """Metres between the thing's middles after two motions."""
        return float(np.linalg.norm(self._middle(T) - self._middle(other)))

    def cost(self, T: np.ndarray, scale: float = _FINE_M) -> float:
        """How little the pictures agree, 0 to 1."""
        return self._terms(T, scale, np.zeros(3)).cost

    def _refine(self, T: np.ndarray, free: np.ndarray, scale: float, steps: int) -> tuple[np.ndarray, float]:
        """A motion after so many steps, and its cost."""
        middle = self._middle(T)
        terms, (damping, least, most) = self._terms(T, scale, middle), _DAMPING
        for _ in range(steps):
            H = free.T @ terms.H @ free
            H[np.diag_indices(len(H))] += damping * np.diag(H) + 1e-9
            twist = -free @ np.linalg.solve(H, free.T @ terms.g)
            tried = translation(middle) @ se3_exp(twist) @ translation(-middle) @ T
            after = self._terms(tried, scale, middle)
            if after.cost < terms.cost:
                gained = terms.cost - after.cost
                T, terms, damping = tried, after, max(damping / 4, least)
                if gained < _ENOUGH:
                    break
            else:
                damping *= 8
                if damping > most:
                    break
        return T, terms.cost

    def _middle(self, T: np.ndarray) -> np.ndarray:
        """Of the thing in the newer visit, [3]."""
        return np.asarray(transform_points(self._old.points, T).mean(0))

    def _terms(self, T: np.ndarray, scale: float, middle: np.ndarray) -> _Terms:
        """The cost of a motion, and its normal equations for twists about `middle`, in the newer visit. What is far off
        counts 1 and steers nothing: a part of the thing hides it, or it is noise."""
        cost, H, g = 0.0, np.zeros((6, 6)), np.zeros(6)
        for number, surface in enumerate((self._old, self._new)):
            found = self._views[1 - number].residuals(surface.move(inverse(T) if number else T))
            along, points = found.along, found.points
            if number:  # the newer surface stands still, and the older visit's pictures move
                along, points = -along @ T[:3, :3].T, transform_points(points, T)
            J = np.concatenate([along, np.cross(points - middle, along)], 1)
            squares, count = found.off**2, max(1, len(found.off))
            weight = scale**2 / (squares + scale**2) ** 2 / count
            H += J.T @ (weight[:, None] * J)
            g += J.T @ (weight * found.off)
            cost += float((squares / (squares + scale**2)).sum() / count) / 2
        return _Terms(cost, H, g)


def _cost(found: tuple[np.ndarray, float]) -> float:
    return found[1]
