# SPDX-License-Identifier: Apache-2.0
"""How a thing lay before and after: its surface brought upon itself, by shape and colour."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cache
from itertools import permutations, product

import numpy as np
from scipy.spatial import cKDTree

from ggslam.changes.settings import ChangeSettings
from ggslam.changes.sightings import Evidence, Sightings, Tolerance
from ggslam.changes.things import color_apart
from ggslam.geometry.normals import estimate_normals
from ggslam.geometry.plane_steps import plane_step
from ggslam.scene.poses import fit_similarity, inverse, orthonormalize, se3_exp, transform_points, turning_angle

COLOR_SCALE_M = 0.08
"""Metres that the distance from black to full in one channel counts as where partners are looked for."""
_COARSE, _COARSE_STEPS, _GOOD = 150, 10, 16
_FINE, _FINE_STEPS, _BEST = 400, 15, 8
"""Points, steps of each stage, and motions that are kept after it."""
_REFINED = 1500
"""Points that a motion is refined by."""
_AS_GOOD = 0.02
"""Difference in quality that says nothing."""
_TANGENT = 0.1
"""Weight of the distance along the surface, which colours tell, against that off the surface."""
_FEWEST, _SMALL_STEP = 12, 2e-5
_ALIKE = np.radians(12)
"""Motions whose turns differ by less are one."""
_TRIMMED = 0.8
"""Share of the pairs of points, the nearest, that steer a motion: the visits saw different sides."""


@dataclass(frozen=True)
class Shape:
    """The surface of a thing.

    Attributes:
        points: float64 [n, 3], world.
        colors: float32 [n, 3] in [0, 1].
    """

    points: np.ndarray
    colors: np.ndarray

    def sample(self, count: int, rng: np.random.Generator) -> Shape:
        """Some of its points."""
        rows = rng.permutation(len(self.points))[:count]
        return Shape(self.points[rows], self.colors[rows])

    def joint(self) -> np.ndarray:
        """Places and colours, [n, 6] metres."""
        return np.concatenate([self.points, COLOR_SCALE_M * self.colors], 1)

    def extent(self) -> float:
        """Its size: the diagonal of the box that holds the middle nine tenths of it, metres."""
        low, high = np.percentile(self.points, [5, 95], axis=0)
        return float(np.linalg.norm(high - low))


@dataclass(frozen=True)
class Fit:
    """A thing before, moved onto a thing after.

    Attributes:
        T_new_old: float64 [4, 4], world.
        share: of the surfaces that fits, of what both visits saw of it; the worse of the two ways.
        seen: share of the surfaces that both visits saw; the worse of the two ways.
        color_apart: how much the colours differ.
    """

    T_new_old: np.ndarray
    share: float
    seen: float
    color_apart: float

    def quality(self) -> float:
        """For choosing among fits: more is better."""
        return self.share - self.color_apart


def fit_shapes(
    old: Shape, new: Shape, sights_old: Sightings, sights_new: Sightings, up: np.ndarray, settings: ChangeSettings
) -> Fit | None:
    """The motion that brings a thing upon what it may be in the other visit, judged by what either visit saw at the
    places where the other one's surface would then be; None: too few points.

    Args:
        old, new: surfaces in the common world.
        sights_old, sights_new: what the visits saw.
        up: [3], unit vector: most things turn about it.
    """
    if min(len(old.points), len(new.points)) < settings.min_points:
        return None
    target, sample = _Target(new), old.sample(_REFINED, np.random.default_rng(0))
    motions = [target.refine(sample, T, settings.fit_m) for T in _motions(old, new, up)]
    fits = [_judge(T, old, new, sights_old, sights_new, settings) for T in _unlike(motions, len(motions))]
    best = max(fits, key=Fit.quality)
    # Of motions as good as the best the one that turns least: round things tell no turn.
    alike = [fit for fit in fits if fit.quality() >= best.quality() - _AS_GOOD]
    return min(alike, key=lambda fit: turning_angle(fit.T_new_old, np.eye(4)))


def _judge(
    T: np.ndarray, old: Shape, new: Shape, sights_old: Sightings, sights_new: Sightings, settings: ChangeSettings
) -> Fit:
    within = Tolerance(settings.fit_m, settings.tolerance_relative)
    shares, seen, apart = [], [], []
    for shape, other, motion, sights in ((old, new, T, sights_new), (new, old, inverse(T), sights_old)):
        moved = transform_points(shape.points, motion)
        found = sights.look_up(moved, within)
        share, judged = _share_there(found, cKDTree(other.points).query(moved)[0] < 2 * settings.fit_m)
        shares.append(share)
        seen.append(judged)
        apart.append(color_apart(shape.colors, found.color))
    known = [value for value in apart if np.isfinite(value)]
    return Fit(T, min(shares), min(seen), max(known) if known else 1.0)


def _share_there(found: Evidence, near: np.ndarray) -> tuple[float, float]:
    """Share of moved points that are seen where the other thing is, of those that the visit could see, and share of
    these."""
    gone = (found.through > 0) & (found.through >= found.present)
    there = (found.present > 0) & ~gone
    judged = int(there.sum() + gone.sum())
    return int((there & near).sum()) / max(1, judged), judged / max(1, len(there))


def _motions(old: Shape, new: Shape, up: np.ndarray) -> list[np.ndarray]:
    """The likeliest motions by points and colours together, from starts all around."""
    rng = np.random.default_rng(0)
    upright = np.array([_about(up, angle) for angle in range(0, 360, 15)])
    rotations = np.concatenate([upright, _rotations()])
    motions = np.tile(np.eye(4), (len(rotations), 1, 1))
    motions[:, :3, :3] = rotations
    motions[:, :3, 3] = new.points.mean(0) - motions[:, :3, :3] @ old.points.mean(0)
    for count, kept, steps in ((_COARSE, _GOOD, _COARSE_STEPS), (_FINE, _BEST, _FINE_STEPS)):
        one, other = (shape.sample(count, rng) for shape in (old, new))
        tree = cKDTree(other.joint())
        for _ in range(steps):
            motions, apart = _step(one, other, tree, motions)
        motions = np.array(_unlike([motions[k] for k in np.argsort(apart)], kept))
    return list(motions)


def _unlike(motions: list[np.ndarray], most: int) -> list[np.ndarray]:
    """The first ones that turn otherwise than those before them."""
    chosen: list[np.ndarray] = []
    for T in motions:
        if len(chosen) < most and all(turning_angle(T, other) > _ALIKE for other in chosen):
            chosen.append(T)
    return chosen


def _step(a: Shape, b: Shape, tree: cKDTree, motions: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """One step of point-to-point ICP in places and colours from each motion [m, 4, 4]; the new motions, and the mean
    distances [m] before."""
    moved = a.points @ np.swapaxes(motions[:, :3, :3], 1, 2) + motions[:, None, :3, 3]
    shades = np.broadcast_to(COLOR_SCALE_M * a.colors, moved.shape)
    apart, nearest = tree.query(np.concatenate([moved, shades], 2), workers=-1)
    kept = np.argsort(apart, 1)[:, : max(3, round(_TRIMMED * len(a.points)))]
    partners = np.take_along_axis(nearest, kept, 1)
    found, _ = fit_similarity(a.points[kept], b.points[partners])
    return found, np.take_along_axis(apart, kept, 1).mean(1)


class _Target:
    """A surface that others are brought upon: point-to-plane, and along the surface by colours."""

    def __init__(self, shape: Shape) -> None:
        self.shape = shape
        self._tree = cKDTree(shape.joint())
        self._normals = estimate_normals(shape.points, neighbours=min(16, len(shape.points)))

    def refine(self, other: Shape, T: np.ndarray, reach: float, steps: int = 25) -> np.ndarray:
        """Gauss-Newton from a motion [4, 4] that is about right."""
        points, joint = other.points, other.joint()
        for _ in range(steps):
            moved = transform_points(points, T)
            apart, nearest = self._tree.query(
                np.concatenate([moved, joint[:, 3:]], 1), distance_upper_bound=3 * reach, workers=-1
            )
            pairs = np.isfinite(apart)
            if pairs.sum() < _FEWEST:
                return T
            partners = nearest[pairs]
            step = plane_step(moved[pairs], self.shape.points[partners], self._normals[partners], reach, _TANGENT)
            T = orthonormalize(step @ T)
            if np.abs(step - np.eye(4)).max() < _SMALL_STEP:
                break
        return T


@cache
def _rotations() -> np.ndarray:
    """The identity, the other 23 rotations of a cube, and those halfway to its corners' turns."""
    cube = []
    for order in permutations(range(3)):
        for signs in product((-1, 1), repeat=3):
            R = np.zeros((3, 3))
            R[np.arange(3), order] = signs
            if np.linalg.det(R) > 0:
                cube.append(R)
    cube.sort(key=lambda R: -np.trace(R))
    half = [_about(axis, angle) for axis in np.eye(3) for angle in (45, -45)]
    half += [_about(np.array(axis) / np.sqrt(3), 60) for axis in product((-1, 1), repeat=3)]
    return np.array([*cube, *(R @ H for H in half for R in cube[::2])])


def _about(axis: np.ndarray, degrees: float) -> np.ndarray:
    return se3_exp(np.concatenate([np.zeros(3), np.radians(degrees) * axis]))[:3, :3]
