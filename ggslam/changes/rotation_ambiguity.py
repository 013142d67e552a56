# SPDX-License-Identifier: Apache-2.0
"""Whether the rotation of a moved object is known: round and plain objects look alike from many sides."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace

import numpy as np

from ggslam.changes.alignment_score import Fit, Judge
from ggslam.changes.motions import CandidateMotionTuning
from ggslam.changes.shape import Shape, Target
from ggslam.changes.upright import UprightTuning, tilt, turned_about, upright
from ggslam.scene.poses import transform_points, translation, turning_angle
from ggslam.system.tuning import Tuning


class RotationTuning(Tuning):
    """When the rotation of a moved object is known."""

    probed_deg = (15, -15, 30, -30, *range(45, 181, 15), *range(-165, -44, 15))
    """Rotations that are tried as rivals, in degrees."""
    rival_gap = (0.05, 0.25)
    """Quality by which rivals must be worse: an amount, and a share of what the best lacks of a perfect fit. If an
    object fits badly, every rotation is about as bad."""
    sector_deg = 30
    """Width of the sectors that an object is seen from, in degrees."""
    min_sector_share = 0.01
    """Share of the points seen from a sector, above which it counts as seen."""
    min_horizontal = 0.2
    """Smallest horizontal part of a direction that has a sector."""
    min_shared_sides = 0.5
    """Share of the sides seen by the visit that saw fewer which both visits must have seen."""
    min_rival_deg = 45
    """Smallest rotation that would show sides which only one visit saw, in degrees."""
    rival_shifts = (0.25, 0.5, 0.75, 1.0)
    """Shifts of such rivals, as shares of the object's size."""
    max_clashes = 0.04
    """Share of its points by which a rival may lie more in space that was seen to be free."""
    finer_shifts = (0.12, 0.06, 0.03)
    """Shifts that let the best rivals clash less, as shares of the object's size."""
    refined_rivals = 8
    """Rivals that are shifted so."""
    min_color_spread = 0.04
    """Spread of an object's colours that tells its rotation, in [0, 1]."""
    max_color_gap = 0.5
    """Largest difference of colours then, as a share of their spread."""
    min_fit = 0.9
    """Smallest share of the surface that fits then."""


_SHIFTS = np.eye(6)[:, :3]
"""Twists that turn nothing."""


def hidden_sector(toward: np.ndarray, up: np.ndarray) -> float:
    """The widest sector about the vertical that a thing was not seen from, degrees.

    Args:
        toward: [n, 3], from its points to the cameras that saw them, unit vectors.
        up: [3], unit vector.
    """
    across = np.linalg.svd(up[None])[2][1:]
    flat = toward @ across.T
    flat = flat[np.linalg.norm(flat, axis=1) > RotationTuning.min_horizontal]
    sector = (np.degrees(np.arctan2(flat[:, 1], flat[:, 0])) % 360 // RotationTuning.sector_deg).astype(int)
    counts = np.bincount(sector, minlength=360 // RotationTuning.sector_deg)
    seen = np.flatnonzero(counts > RotationTuning.min_sector_share * len(toward))
    if not len(seen):
        return 360.0
    return float(RotationTuning.sector_deg * (np.diff(np.append(seen, seen[0] + len(counts))) - 1).max())


def with_rotation_ambiguity(
    fit: Fit, old: Shape, new: Shape, judge: Judge, hidden: tuple[float, float], up: np.ndarray
) -> Fit:
    """The fit, with what makes its turn doubtful.

    Args:
        fit: how the thing lies.
        old, new: its surfaces.
        judge: of them.
        hidden: the sectors that either visit did not see it from, degrees; see `hidden_sector`.
        up: [3], unit vector.
    """
    least, share = RotationTuning.rival_gap
    starts = _other_starts(fit, old, up)
    for target in (Target(new, faces=True), Target(new)):
        rival = max(_others(fit, old, starts, target, judge, up), key=Fit.quality, default=None)
        if rival is not None and rival.quality() >= fit.quality() - max(least, share * (1 - fit.quality())):
            return replace(fit, as_good_deg=round(float(np.degrees(turning_angle(rival.T_new_old, fit.T_new_old)))))
    # If either visit may have seen another side, surfaces are brought upon each other that are not the same.
    stands = tilt(fit.T_new_old, up) < UprightTuning.max_tilt_rad  # few things fall over
    if _share_sides(hidden) or (stands and _is_told_by_colors(fit, old, new)):
        return fit
    return replace(fit, sides_may_differ=_is_another_possible(fit, old, judge, up))


def _other_starts(fit: Fit, old: Shape, up: np.ndarray) -> list[np.ndarray]:
    """The thing turned otherwise: about the vertical, and if it fell over about what was its vertical, and upright."""
    middle = transform_points(old.points, fit.T_new_old).mean(0)
    own = fit.T_new_old[:3, :3] @ up
    starts = [turned_about(up, angle, middle) @ fit.T_new_old for angle in RotationTuning.probed_deg]
    if tilt(fit.T_new_old, up) >= UprightTuning.max_tilt_rad:
        starts += [turned_about(own, angle, middle) @ fit.T_new_old for angle in RotationTuning.probed_deg]
        starts += upright_starts(old, fit.T_new_old, up)
    return starts


def upright_starts(old: Shape, T: np.ndarray, up: np.ndarray) -> list[np.ndarray]:
    """Motions [4, 4] that take a thing where one takes it, upright and turned in all ways that are probed."""
    middle = transform_points(old.points, T).mean(0)
    stands = translation(middle - old.points.mean(0))
    return [turned_about(up, angle, middle) @ stands for angle in (0, *RotationTuning.probed_deg)]


def _others(
    fit: Fit, old: Shape, starts: list[np.ndarray], target: Target, judge: Judge, up: np.ndarray
) -> Iterator[Fit]:
    """What motions settle at that turn the thing otherwise than a fit: shifted, and turned about the vertical."""
    for start in starts:
        shifted = target.refine(old, start, judge.settings.fit_m, _SHIFTS)
        for T in (shifted, target.refine(old, shifted, judge.settings.fit_m, upright(up))):
            if turning_angle(T, fit.T_new_old) > CandidateMotionTuning.same_rotation_rad:
                yield judge.fit(T)


def _is_another_possible(fit: Fit, old: Shape, judge: Judge, up: np.ndarray) -> bool:
    """Whether the thing may stand there turned otherwise, so that each visit saw sides that the other one did not."""
    middle = transform_points(old.points, fit.T_new_old).mean(0)
    reach = 2 * float(np.percentile(np.linalg.norm(old.points - old.points.mean(0), axis=1), 90))
    across = np.linalg.svd(up[None])[2][1:]
    around = [np.cos(a) * across[0] + np.sin(a) * across[1] for a in np.radians(range(0, 360, 45))]
    others = []
    for angle in (a for a in RotationTuning.probed_deg if abs(a) >= RotationTuning.min_rival_deg):
        turned = turned_about(up, angle, middle) @ fit.T_new_old
        for shift in (np.zeros(3), *(share * reach * way for share in RotationTuning.rival_shifts for way in around)):
            others.append(translation(shift) @ turned)
    clashes = judge.clashes([fit.T_new_old, *others])
    allowed, clashes = clashes[0] + RotationTuning.max_clashes, clashes[1:]
    for step in RotationTuning.finer_shifts:  # the best of a coarse grid may clash for lying beside where there is room
        if clashes.min() <= allowed:
            break
        best = [others[k] for k in np.argsort(clashes)[:RotationTuning.refined_rivals]]
        others = best + [translation(step * reach * way) @ T for T in best for way in around]
        clashes = judge.clashes(others)
    return bool(clashes.min() <= allowed)


def _share_sides(hidden: tuple[float, float]) -> bool:
    """Whether both visits saw much of the same, however the thing turned."""
    least = 360 - max(hidden)
    return least > 0 and 360 - sum(hidden) >= RotationTuning.min_shared_sides * least


def _is_told_by_colors(fit: Fit, old: Shape, new: Shape) -> bool:
    """Whether the colours of either surface vary, and agree far better than by chance."""
    # As `color_apart`, medians: a patch on a plain thing makes the mean large, and misplaced it leaves no median.
    varies = min(float(np.median(np.abs(s.colors - np.median(s.colors, axis=0)), axis=0).mean()) for s in (old, new))
    return (
        fit.share >= RotationTuning.min_fit
        and varies >= RotationTuning.min_color_spread
        and fit.color_apart <= RotationTuning.max_color_gap * varies
    )
