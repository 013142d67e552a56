# SPDX-License-Identifier: Apache-2.0
"""How a thing lay before and after: its surface brought upon itself, by shape and colour."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cache
from itertools import permutations, product

import numpy as np
from scipy.spatial import cKDTree

from ggslam.changes.settings import ChangeSettings
from ggslam.changes.sightings import Evidence, Sightings, Tolerance
from ggslam.changes.things import color_apart
from ggslam.geometry.colored_surface import ColoredSurface
from ggslam.geometry.normals import estimate_normals, turn_toward
from ggslam.geometry.plane_steps import plane_step
from ggslam.scene.poses import fit_similarity, inverse, orthonormalize, se3_exp, transform_points, turning_angle

COLOR_SCALE_M = 0.08
"""Metres that the distance from black to full in one channel counts as where partners are looked for."""
NORMAL_SCALE_M = 0.06
"""Metres that a radian between normals counts as there."""
_SIDE_M = 0.02
"""Metres that a radian between the directions that points were seen from counts as where neighbours are looked for."""
_COARSE, _COARSE_STEPS, _GOOD = 150, 10, 16
_FINE, _FINE_STEPS, _BEST = 400, 15, 8
"""Points, steps of each stage, and motions that are kept after it."""
_REFINED = 1500
"""Points that a motion is refined by."""
_AS_GOOD = 0.02
"""Difference in quality that says nothing."""
_APART_M = 0.05
"""Metres that surfaces lie apart which count as much as all that fits."""
_OVERLAP, _JUDGED = 0.6, 3000
"""Share of the points, the nearest, that tell how far surfaces lie apart, and points that motions are judged by."""
_STANDS, LEVEL = np.radians(20), np.radians(0.5)
"""What tilts a thing less may be noise; what tilts it less than the other keeps it upright."""
_STANDING_COSTS = 0.05
"""Worse quality that a motion may have which keeps the thing upright."""
_RISES_M, _RISING_COSTS = (0.01, 0.12), 0.12
"""Metres that a thing may seem to rise or sink by that stays at its height, and worse quality of the motion that keeps
it there: of two waste baskets on the floor, of which visits share half, it was by 0.05 and 0.12."""
_FACES_COST = 0.05
"""Worse quality that a motion may have which lays faces upon faces."""
_PROBED = (15, -15, 30, -30, *range(45, 181, 15), *range(-165, -44, 15))
"""Degrees that a thing is turned by to see whether it would fit as well."""
_TURN_TELLS = 0.05
"""Worse quality of further turns by which a turn is known."""
_BESIDE_M, _LAST_STEPS = (0.04, 0.015), 100
"""How far beside a motion others start, metres, and steps of the last refinement."""
_SHIFTS = np.eye(6)[:, :3]
"""Twists that turn nothing."""
_TANGENT = 0.1
"""Weight of the distance along the surface, which colours tell, against that off the surface."""
_FEWEST, _SMALL_STEP = 12, 2e-5
_ALIKE = np.radians(12)
"""Motions whose turns differ by less are one."""
_TRIMMED = 0.8
"""Share of the pairs of points, the nearest, that steer a motion: the visits saw different sides."""


@dataclass(frozen=True)
class Shape(ColoredSurface):
    """The surface of a thing, in the world."""

    @staticmethod
    def from_views(points: np.ndarray, colors: np.ndarray, toward: np.ndarray) -> Shape:
        """A surface, with directions [n, 3] to the cameras that saw it: both faces of a thin thing are told apart."""
        return Shape(points, colors, turn_toward(estimate_normals(points, beside=_SIDE_M * toward), toward))

    def sample(self, count: int, rng: np.random.Generator) -> Shape:
        """Some of its points."""
        return self.at(rng.permutation(len(self))[:count])

    def joint(self) -> np.ndarray:
        """Places and colours, [n, 6] metres."""
        return np.concatenate([self.points, COLOR_SCALE_M * self.colors], 1)

    def joint_with_sides(self) -> np.ndarray:
        """Places, colours and normals, [n, 9] metres."""
        return np.concatenate([self.joint(), NORMAL_SCALE_M * self.normals], 1)


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
            no turn; None: the turn is known.
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
        return self.as_good_deg is None


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
    judge = _Judge(old, new, sights_old, sights_new, settings)
    target, sample = _Target(new), old.sample(_REFINED, np.random.default_rng(0))
    fits = list[Fit]()
    for T in _motions(old, new, up):
        ways = [target.refine(sample, T, settings.fit_m)]
        if tilt(T, up) < _STANDS:
            ways.append(target.refine(sample, without_tilt(T, up, old.points.mean(0)), settings.fit_m, upright(up)))
        fits += [judge.fit(T) for T in ways]
    best = max(fits, key=Fit.quality)
    # Of motions as good as the best the one that turns least: round things tell no turn.
    alike = [fit for fit in _unlike_fits(fits) if fit.quality() >= best.quality() - _AS_GOOD]
    chosen = min(alike, key=lambda fit: turning_angle(fit.T_new_old, np.eye(4)))
    # The space that a thing fills tells which way round it is, whichever faces were seen; its faces, where exactly.
    faces = _Target(new, faces=True)
    settled = _settle(_stand_up(chosen, fits, up), judge, faces, sample, up)
    settled = _stay_level(settled, judge, (faces, target), sample, up)
    return _find_turn(settled, judge, (faces, target), sample, up)


def _unlike_fits(fits: list[Fit]) -> list[Fit]:
    """The best fit of each turn."""
    chosen: list[Fit] = []
    for fit in sorted(fits, key=lambda fit: -fit.quality()):
        if all(turning_angle(fit.T_new_old, other.T_new_old) > _ALIKE for other in chosen):
            chosen.append(fit)
    return chosen


def _stand_up(chosen: Fit, fits: list[Fit], up: np.ndarray) -> Fit:
    """The fit about as good that keeps the thing upright, if there is one: what tilts it is mostly noise."""
    upright_ones = [
        fit for fit in fits
        if tilt(fit.T_new_old, up) < LEVEL and turning_angle(fit.T_new_old, chosen.T_new_old) < _ALIKE
        and fit.quality() >= chosen.quality() - _STANDING_COSTS
    ]  # fmt: skip
    return max(upright_ones, key=Fit.quality, default=chosen)


def _settle(fit: Fit, judge: _Judge, target: _Target, sample: Shape, up: np.ndarray) -> Fit:
    """The motion, refined to the end, also from beside: plain surfaces slide upon each other slowly, as only their
    edges pull."""
    free = upright(up) if tilt(fit.T_new_old, up) < LEVEL else None

    def refine(T: np.ndarray) -> Fit:
        return judge.fit(target.refine(sample, T, judge.settings.fit_m, free, _LAST_STEPS))

    on_faces = refine(fit.T_new_old)
    if on_faces.quality() >= fit.quality() - _FACES_COST:
        fit = on_faces
    across = np.linalg.svd(up[None])[2][1:]
    for beside in _BESIDE_M:
        for step in (np.zeros(3), *(beside * sign * axis for axis in across for sign in (1, -1))):
            start = fit.T_new_old.copy()
            start[:3, 3] += step
            fit = max(fit, refine(start), key=Fit.quality)
    return fit


def _stay_level(fit: Fit, judge: _Judge, targets: tuple[_Target, ...], sample: Shape, up: np.ndarray) -> Fit:
    """A motion along the level that fits about as well, if the thing rose or sank a little: what stands on a floor or a
    table stands on it after it was moved, and walls of which the visits saw upper and lower parts slide upon each
    other."""
    middle = sample.points.mean(0)
    rise = float(up @ (transform_points(middle[None], fit.T_new_old)[0] - middle))
    low, high = _RISES_M
    if not low < abs(rise) < high or tilt(fit.T_new_old, up) >= LEVEL:
        return fit
    start = fit.T_new_old.copy()
    start[:3, 3] -= rise * up
    ways = [target.refine(sample, start, judge.settings.fit_m, _along_level(up), _LAST_STEPS) for target in targets]
    level = max(map(judge.fit, ways), key=Fit.quality)
    s = judge.settings  # it must be the same thing as surely as before
    same = level.share >= min(s.min_fit, fit.share) and level.color_apart <= max(s.max_color, fit.color_apart)
    return level if same and level.quality() >= fit.quality() - _RISING_COSTS else fit


def _find_turn(fit: Fit, judge: _Judge, targets: tuple[_Target, ...], sample: Shape, up: np.ndarray) -> Fit:
    """Whether the thing turned further about the vertical fits as well."""
    middle = transform_points(sample.points, fit.T_new_old).mean(0)
    for angle in _PROBED:
        further = np.eye(4)
        further[:3, :3] = _about(up, angle)
        further[:3, 3] = middle - further[:3, :3] @ middle
        for target in targets:
            T = target.refine(sample, further @ fit.T_new_old, judge.settings.fit_m, _SHIFTS)
            if judge.fit(T).quality() >= fit.quality() - _TURN_TELLS:
                return replace(fit, as_good_deg=float(angle))
    return fit


def upright(up: np.ndarray) -> np.ndarray:
    """Twists [6, 4] that keep a thing upright."""
    basis = np.zeros((6, 4))
    basis[:3, :3], basis[3:, 3] = np.eye(3), up
    return basis


def _along_level(up: np.ndarray) -> np.ndarray:
    """Twists [6, 3] that keep a thing upright and at its height."""
    basis = np.zeros((6, 3))
    basis[:3, :2], basis[3:, 2] = np.linalg.svd(up[None])[2][1:].T, up
    return basis


def tilt(T: np.ndarray, up: np.ndarray) -> float:
    """Angle by which a motion tilts what stood upright, radians."""
    return float(np.arccos(np.clip(up @ T[:3, :3] @ up, -1, 1)))


def without_tilt(T: np.ndarray, up: np.ndarray, about: np.ndarray) -> np.ndarray:
    """The motion [4, 4] that does the same to a point and turns about the vertical alone."""
    tilted = T[:3, :3] @ up
    axis = np.cross(tilted, up)
    length = float(np.linalg.norm(axis))
    R = T[:3, :3]
    if length > 1e-9:
        R = _about(axis / length, float(np.degrees(tilt(T, up)))) @ R
    level = np.eye(4)
    level[:3, :3] = R
    level[:3, 3] = transform_points(about[None], T)[0] - R @ about
    return level


class _Judge:
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


def _motions(old: Shape, new: Shape, up: np.ndarray) -> list[np.ndarray]:
    """The likeliest motions by points and colours together, from starts all around."""
    rng = np.random.default_rng(0)
    upright = np.array([_about(up, angle) for angle in range(0, 360, 15)])
    rotations = np.concatenate([upright, _rotations()])
    motions = np.tile(np.eye(4), (len(rotations), 1, 1))
    motions[:, :3, :3] = rotations
    motions[:, :3, 3] = new.points.mean(0) - motions[:, :3, :3] @ old.points.mean(0)
    # Most things stay at their height, where the middle of what a visit saw of them may be anywhere.
    level = motions[: len(upright)].copy()
    level[:, :3, 3] -= float(up @ (new.points.mean(0) - old.points.mean(0))) * up
    motions = np.concatenate([motions, level])
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
    """A surface that others are brought upon: point-to-plane, and along the surface by colours.

    Args:
        shape: the surface.
        faces: only what faces the same way may be the same: the other face of something thin is not.
    """

    def __init__(self, shape: Shape, faces: bool = False) -> None:
        self.shape = shape
        self._places = Shape.joint_with_sides if faces else Shape.joint
        self._tree = cKDTree(self._places(shape))

    def refine(
        self, other: Shape, T: np.ndarray, reach: float, free: np.ndarray | None = None, steps: int = 25
    ) -> np.ndarray:
        """Gauss-Newton from a motion [4, 4] that is about right; `free` [6, k]: twists that it may take, about the
        middle; None: all."""
        free = np.eye(6) if free is None else free
        for _ in range(steps):
            placed = other.move(T)
            moved = placed.points
            apart, nearest = self._tree.query(self._places(placed), distance_upper_bound=3 * reach, workers=-1)
            pairs = np.isfinite(apart)
            if pairs.sum() < _FEWEST:
                return T
            partners = nearest[pairs]
            partner, normal = self.shape.points[partners], self.shape.normals[partners]
            step = plane_step(moved[pairs], partner, normal, reach, _TANGENT, free=free)
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
