# SPDX-License-Identifier: Apache-2.0
"""Whether the turn of a thing that moved is known: round things and plain ones look alike from many sides."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace

import numpy as np

from ggslam.changes.alignment_score import Fit, Judge
from ggslam.changes.motions import ALIKE
from ggslam.changes.shape import Shape, Target
from ggslam.changes.upright import LEVEL, tilt, turned_about, upright
from ggslam.scene.poses import transform_points, translation, turning_angle

PROBED = (15, -15, 30, -30, *range(45, 181, 15), *range(-165, -44, 15))
"""Degrees that a thing is turned by to see whether it would fit as well."""
_TURN_TELLS = (0.05, 0.25)
"""Worse quality of other turns by which a turn is known: so much at least, and this share of what the turn itself lacks
of a perfect fit. Of things that fit badly any turn is about as bad."""
_SHIFTS = np.eye(6)[:, :3]
"""Twists that turn nothing."""
_SIDE, _SIDE_SHARE, _HORIZONTAL = 30, 0.01, 0.2
"""Degrees of the sectors that a thing may be seen from, share of its points that one has if it was, and horizontal part
of a direction that tells a sector."""
_SHARED = 0.5
"""Share of the sides seen by the visit that saw fewer that the visits have to share, however the thing turned."""
_CLEARLY_DEG, _ASIDE, _CLASHES = 45, (0.25, 0.5, 0.75, 1.0), 0.04
"""Least turn that sides which the visits did not share would show, shares of a thing's size that it may stand aside by
then, and how much more of it may lie where a visit saw through."""
_CLOSER, _BEST = (0.12, 0.06, 0.03), 8
"""Shares of a thing's size that the best so far, so many of them, are shifted by to clash less."""
_COLORFUL, _ALIKE_COLORS, _FITS = 0.04, 0.5, 0.9
"""How much the colours of a thing vary which tell a turn, by how much less they have to differ then, and share of its
surface that has to fit."""


def hidden_sector(toward: np.ndarray, up: np.ndarray) -> float:
    """The widest sector about the vertical that a thing was not seen from, degrees.

    Args:
        toward: [n, 3], from its points to the cameras that saw them, unit vectors.
        up: [3], unit vector.
    """
    across = np.linalg.svd(up[None])[2][1:]
    flat = toward @ across.T
    flat = flat[np.linalg.norm(flat, axis=1) > _HORIZONTAL]
    sector = (np.degrees(np.arctan2(flat[:, 1], flat[:, 0])) % 360 // _SIDE).astype(int)
    counts = np.bincount(sector, minlength=360 // _SIDE)
    seen = np.flatnonzero(counts > _SIDE_SHARE * len(toward))
    if not len(seen):
        return 360.0
    return float(_SIDE * (np.diff(np.append(seen, seen[0] + len(counts))) - 1).max())


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
    least, share = _TURN_TELLS
    starts = _other_starts(fit, old, up)
    for target in (Target(new, faces=True), Target(new)):
        rival = max(_others(fit, old, starts, target, judge, up), key=Fit.quality, default=None)
        if rival is not None and rival.quality() >= fit.quality() - max(least, share * (1 - fit.quality())):
            return replace(fit, as_good_deg=round(float(np.degrees(turning_angle(rival.T_new_old, fit.T_new_old)))))
    # If either visit may have seen another side, surfaces are brought upon each other that are not the same.
    stands = tilt(fit.T_new_old, up) < LEVEL  # few things fall over
    if _share_sides(hidden) or (stands and _is_told_by_colors(fit, old, new)):
        return fit
    return replace(fit, sides_may_differ=_is_another_possible(fit, old, judge, up))


def _other_starts(fit: Fit, old: Shape, up: np.ndarray) -> list[np.ndarray]:
    """The thing turned otherwise: about the vertical, and if it fell over about what was its vertical, and upright."""
    middle = transform_points(old.points, fit.T_new_old).mean(0)
    own = fit.T_new_old[:3, :3] @ up
    starts = [turned_about(up, angle, middle) @ fit.T_new_old for angle in PROBED]
    if tilt(fit.T_new_old, up) >= LEVEL:
        starts += [turned_about(own, angle, middle) @ fit.T_new_old for angle in PROBED]
        starts += upright_starts(old, fit.T_new_old, up)
    return starts


def upright_starts(old: Shape, T: np.ndarray, up: np.ndarray) -> list[np.ndarray]:
    """Motions [4, 4] that take a thing where one takes it, upright and turned in all ways that are probed."""
    middle = transform_points(old.points, T).mean(0)
    stands = translation(middle - old.points.mean(0))
    return [turned_about(up, angle, middle) @ stands for angle in (0, *PROBED)]


def _others(
    fit: Fit, old: Shape, starts: list[np.ndarray], target: Target, judge: Judge, up: np.ndarray
) -> Iterator[Fit]:
    """What motions settle at that turn the thing otherwise than a fit: shifted, and turned about the vertical."""
    for start in starts:
        shifted = target.refine(old, start, judge.settings.fit_m, _SHIFTS)
        for T in (shifted, target.refine(old, shifted, judge.settings.fit_m, upright(up))):
            if turning_angle(T, fit.T_new_old) > ALIKE:
                yield judge.fit(T)


def _is_another_possible(fit: Fit, old: Shape, judge: Judge, up: np.ndarray) -> bool:
    """Whether the thing may stand there turned otherwise, so that each visit saw sides that the other one did not."""
    middle = transform_points(old.points, fit.T_new_old).mean(0)
    reach = 2 * float(np.percentile(np.linalg.norm(old.points - old.points.mean(0), axis=1), 90))
    across = np.linalg.svd(up[None])[2][1:]
    around = [np.cos(a) * across[0] + np.sin(a) * across[1] for a in np.radians(range(0, 360, 45))]
    others = []
    for angle in (a for a in PROBED if abs(a) >= _CLEARLY_DEG):
        turned = turned_about(up, angle, middle) @ fit.T_new_old
        for shift in (np.zeros(3), *(share * reach * way for share in _ASIDE for way in around)):
            others.append(translation(shift) @ turned)
    clashes = judge.clashes([fit.T_new_old, *others])
    allowed, clashes = clashes[0] + _CLASHES, clashes[1:]
    for step in _CLOSER:  # the best of a coarse grid may clash for lying beside where there is room
        if clashes.min() <= allowed:
            break
        best = [others[k] for k in np.argsort(clashes)[:_BEST]]
        others = best + [translation(step * reach * way) @ T for T in best for way in around]
        clashes = judge.clashes(others)
    return bool(clashes.min() <= allowed)


def _share_sides(hidden: tuple[float, float]) -> bool:
    """Whether both visits saw much of the same, however the thing turned."""
    least = 360 - max(hidden)
    return least > 0 and 360 - sum(hidden) >= _SHARED * least


def _is_told_by_colors(fit: Fit, old: Shape, new: Shape) -> bool:
    """Whether the colours of either surface vary, and agree far better than by chance."""
    # As `color_apart`, medians: a patch on a plain thing makes the mean large, and misplaced it leaves no median.
    varies = min(float(np.median(np.abs(s.colors - np.median(s.colors, axis=0)), axis=0).mean()) for s in (old, new))
    return fit.share >= _FITS and varies >= _COLORFUL and fit.color_apart <= _ALIKE_COLORS * varies
