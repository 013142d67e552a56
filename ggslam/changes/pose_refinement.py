# SPDX-License-Identifier: Apache-2.0
"""Refines the pose of a moved object: the surface of each visit is aligned with the pictures of the other visit.

Surfaces laid upon each other do not tell: of a board one visit saw the front and the other the back, and they are not
one. Faces, backs and outlines in pictures tell it of every thing, also where visits saw no face in common.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ggslam.changes.candidate_views import CandidateViews
from ggslam.changes.upright import UprightTuning, tilt, upright, without_tilt
from ggslam.geometry.colored_surface import ColoredSurface
from ggslam.scene.poses import inverse, se3_exp, transform_points, translation
from ggslam.system.tuning import Tuning


class PlacementTuning(Tuning):
    """How the exact pose of a moved object is found."""

    points = 400
    """Points of each surface that are looked up in pictures."""
    start_shift_m = 0.035
    """Shift of further starts to eight sides, in metres: a first pose may be off by a board's thickness."""
    fallen_rad = np.radians(30)
    """An object tilted less may still stand upright, in radians."""
    upright_gain = 0.01
    """Cost that an upright pose may have more."""
    max_shift_m = 0.08
    """Largest shift of the refined pose, in metres."""
    cost_per_m = 0.1
    """Cost of a metre of shift: of poses about as good the nearest is taken."""
    start_rotation_rad = np.radians(12)
    """Rotation of further starts, in radians."""
    coarse_m = 0.02
    """Residual that counts half in the first stage, in metres."""
    fine_m = 0.01
    """Residual that counts half in the second stage, in metres."""
    coarse_steps = 8
    """Steps of the first stage."""
    fine_steps = 15
    """Steps of the second stage."""
    kept = 3
    """Poses kept after the first stage."""
    damping = (1e-3, 1e-5, 1e3)
    """Levenberg-Marquardt damping: first, smallest, largest."""
    min_gain = 1e-5
    """A step that lowers the cost by less is the last."""


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
        self._old, self._new = (s.at(rng.permutation(len(s))[:PlacementTuning.points]) for s in (old, new))
        self._views = views

    def place(self, T: np.ndarray, up: np.ndarray) -> np.ndarray:
        """The motion T_new_old [4, 4] near by on which the pictures agree most, one that keeps the thing upright if
        they agree about as well on it. `up`: [3], unit vector."""
        if not len(self._views[0]) or not len(self._views[1]):
            return T
        tilted = tilt(T, up)
        if tilted >= PlacementTuning.fallen_rad:
            return self._search(T, np.eye(6), up)[0]
        level = self._search(without_tilt(T, up, self._old.points.mean(0)), upright(up), up)
        if tilted < UprightTuning.max_tilt_rad:
            return level[0]
        free = self._search(T, np.eye(6), up)
        return level[0] if level[1] <= free[1] + PlacementTuning.upright_gain else free[0]

    def _search(self, T: np.ndarray, free: np.ndarray, up: np.ndarray) -> tuple[np.ndarray, float]:
        """The best motion near one, by twists [6, k] about the thing's middle, and its cost."""
        beside = np.linalg.svd(up[None])[2][1:] * PlacementTuning.start_shift_m
        starts = [translation(a * beside[0] + b * beside[1]) @ T for a in (-1, 0, 1) for b in (-1, 0, 1)]
        found = [self._refine(start, free, PlacementTuning.coarse_m, PlacementTuning.coarse_steps) for start in starts]
        best = min(found, key=_cost)[0]
        middle = self._middle(best)
        for angle in (-PlacementTuning.start_rotation_rad, PlacementTuning.start_rotation_rad):
            turn = se3_exp(angle * np.append(np.zeros(3), up))
            start = translation(middle) @ turn @ translation(-middle) @ best
            found.append(self._refine(start, free, PlacementTuning.coarse_m, PlacementTuning.coarse_steps))
        kept = sorted(found, key=_cost)[:PlacementTuning.kept]
        ends = [self._refine(start, free, PlacementTuning.fine_m, PlacementTuning.fine_steps) for start, _ in kept]
        near = [end for end in ends if self._away(end[0], T) < PlacementTuning.max_shift_m]
        return min(
            near, key=lambda end: end[1] + PlacementTuning.cost_per_m * self._away(end[0], T), default=(T, self.cost(T))
        )

    def _away(self, T: np.ndarray, other: np.ndarray) -> float:
        """Metres between the thing's middles after two motions."""
        return float(np.linalg.norm(self._middle(T) - self._middle(other)))

    def cost(self, T: np.ndarray, scale: float = PlacementTuning.fine_m) -> float:
        """How little the pictures agree, 0 to 1."""
        return self._terms(T, scale, np.zeros(3)).cost

    def _refine(self, T: np.ndarray, free: np.ndarray, scale: float, steps: int) -> tuple[np.ndarray, float]:
        """A motion after so many steps, and its cost."""
        middle = self._middle(T)
        terms, (damping, least, most) = self._terms(T, scale, middle), PlacementTuning.damping
        for _ in range(steps):
            H = free.T @ terms.H @ free
            H[np.diag_indices(len(H))] += damping * np.diag(H) + 1e-9
            twist = -free @ np.linalg.solve(H, free.T @ terms.g)
            tried = translation(middle) @ se3_exp(twist) @ translation(-middle) @ T
            after = self._terms(tried, scale, middle)
            if after.cost < terms.cost:
                gained = terms.cost - after.cost
                T, terms, damping = tried, after, max(damping / 4, least)
                if gained < PlacementTuning.min_gain:
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
