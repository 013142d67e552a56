# SPDX-License-Identifier: Apache-2.0
"""Aligns an object's surface before and after its motion, by shape and colour."""

from __future__ import annotations

import numpy as np

from ggslam.changes.alignment_score import Fit, Judge
from ggslam.changes.motions import CandidateMotionTuning, likeliest_motions
from ggslam.changes.rotation_ambiguity import upright_starts
from ggslam.changes.settings import ChangeSettings
from ggslam.changes.shape import Shape, Target
from ggslam.changes.sightings import Sightings
from ggslam.changes.upright import UprightTuning, along_level, tilt, upright, without_tilt
from ggslam.scene.poses import transform_points, turning_angle
from ggslam.system.tuning import Tuning


class ShapeAlignmentTuning(Tuning):
    """How an object's motion is chosen."""

    points = 1500
    """Points that a motion is refined by."""
    same_quality = 0.02
    """Difference in quality that means nothing."""
    upright_rad = np.radians(20)
    """A smaller tilt may be noise, in radians."""
    upright_gain = 0.05
    """Quality that a motion may lack if it keeps the object upright."""
    rise_m = (0.01, 0.12)
    """Heights by which an object that stays level may seem to rise or sink, in metres: the least and the most."""
    level_gain = 0.12
    """Quality that a motion may lack if it keeps the object at its height."""
    faces_gain = 0.05
    """Quality that a motion may lack if it lays faces upon faces."""
    start_shifts_m = (0.04, 0.015)
    """Shifts of further starts, in metres."""
    last_steps = 100
    """Steps of the last refinement."""


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
    if min(len(old), len(new)) < settings.min_points:
        return None
    judge = Judge(old, new, sights_old, sights_new, settings)
    target, sample = Target(new), old.sample(ShapeAlignmentTuning.points, np.random.default_rng(0))
    fits = list[Fit]()
    for T in likeliest_motions(old, new, up):
        ways = [target.refine(sample, T, settings.fit_m)]
        if tilt(T, up) < ShapeAlignmentTuning.upright_rad:
            ways.append(target.refine(sample, without_tilt(T, up, old.points.mean(0)), settings.fit_m, upright(up)))
        fits += [judge.fit(T) for T in ways]
    best = max(fits, key=Fit.quality)
    # Of motions as good as the best the one that turns least: round things tell no turn.
    alike = [fit for fit in _unlike_fits(fits) if fit.quality() >= best.quality() - ShapeAlignmentTuning.same_quality]
    chosen = min(alike, key=lambda fit: turning_angle(fit.T_new_old, np.eye(4)))
    # The space that a thing fills tells which way round it is, whichever faces were seen; its faces, where exactly.
    faces = Target(new, faces=True)
    standing = _stand_otherwise(_stand_up(chosen, fits, up), judge, target, sample, up)
    settled = _settle(standing, judge, faces, sample, up)
    return _stay_level(settled, judge, (faces, target), sample, up)


def _unlike_fits(fits: list[Fit]) -> list[Fit]:
    """The best fit of each turn."""
    chosen: list[Fit] = []
    for fit in sorted(fits, key=lambda fit: -fit.quality()):
        if all(
            turning_angle(fit.T_new_old, other.T_new_old) > CandidateMotionTuning.same_rotation_rad for other in chosen
        ):
            chosen.append(fit)
    return chosen


def _stand_up(chosen: Fit, fits: list[Fit], up: np.ndarray) -> Fit:
    """The fit about as good that keeps the thing upright, if there is one: what tilts it is mostly noise."""
    upright_ones = [
        fit for fit in fits
        if tilt(fit.T_new_old, up) < UprightTuning.max_tilt_rad
        and turning_angle(fit.T_new_old, chosen.T_new_old) < CandidateMotionTuning.same_rotation_rad
        and fit.quality() >= chosen.quality() - ShapeAlignmentTuning.upright_gain
    ]  # fmt: skip
    return max(upright_ones, key=Fit.quality, default=chosen)


def _stand_otherwise(chosen: Fit, judge: Judge, target: Target, sample: Shape, up: np.ndarray) -> Fit:
    """Of a thing that seems to have fallen over, the fit about as good of all that keep it upright, if there is one."""
    if tilt(chosen.T_new_old, up) < ShapeAlignmentTuning.upright_rad:
        return chosen
    starts = upright_starts(sample, chosen.T_new_old, up)
    ways = [target.refine(sample, T, judge.settings.fit_m, upright(up)) for T in starts]
    best = max(map(judge.fit, ways), key=Fit.quality)
    return best if best.quality() >= chosen.quality() - ShapeAlignmentTuning.upright_gain else chosen


def _settle(fit: Fit, judge: Judge, target: Target, sample: Shape, up: np.ndarray) -> Fit:
    """The motion, refined to the end, also from beside: plain surfaces slide upon each other slowly, as only their
    edges pull."""
    free = upright(up) if tilt(fit.T_new_old, up) < UprightTuning.max_tilt_rad else None

    def refine(T: np.ndarray) -> Fit:
        return judge.fit(target.refine(sample, T, judge.settings.fit_m, free, ShapeAlignmentTuning.last_steps))

    on_faces = refine(fit.T_new_old)
    if on_faces.quality() >= fit.quality() - ShapeAlignmentTuning.faces_gain:
        fit = on_faces
    across = np.linalg.svd(up[None])[2][1:]
    for beside in ShapeAlignmentTuning.start_shifts_m:
        for step in (np.zeros(3), *(beside * sign * axis for axis in across for sign in (1, -1))):
            start = fit.T_new_old.copy()
            start[:3, 3] += step
            fit = max(fit, refine(start), key=Fit.quality)
    return fit


def _stay_level(fit: Fit, judge: Judge, targets: tuple[Target, ...], sample: Shape, up: np.ndarray) -> Fit:
    """A motion along the level that fits about as well, if the thing rose or sank a little: what stands on a floor or a
    table stands on it after it was moved, and walls of which the visits saw upper and lower parts slide upon each
    other."""
    middle = sample.points.mean(0)
    rise = float(up @ (transform_points(middle[None], fit.T_new_old)[0] - middle))
    low, high = ShapeAlignmentTuning.rise_m
    if not low < abs(rise) < high or tilt(fit.T_new_old, up) >= UprightTuning.max_tilt_rad:
        return fit
    start = fit.T_new_old.copy()
    start[:3, 3] -= rise * up
    ways = [
        target.refine(sample, start, judge.settings.fit_m, along_level(up), ShapeAlignmentTuning.last_steps)
        for target in targets
    ]
    level = max(map(judge.fit, ways), key=Fit.quality)
    s = judge.settings  # it must be the same thing as surely as before
    same = level.share >= min(s.min_fit, fit.share) and level.color_apart <= max(s.max_color, fit.color_apart)
    return level if same and level.quality() >= fit.quality() - ShapeAlignmentTuning.level_gain else fit
