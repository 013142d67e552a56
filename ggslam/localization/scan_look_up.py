# SPDX-License-Identifier: Apache-2.0
"""Finds the place of a laser scan of which nothing is known, in three steps:

1. The likeliest places, by what the scanner would see from points around its own (`scan_views`).
2. For each, position and azimuth from the map around it: pictures of both from above, of what stands between floor and
   head height, are correlated by FFT at a few turns.
3. G-ICP. Then the scan has to agree with the map both ways: what stands in the scan lies on surfaces of the map, and
   the scan looks through none of them. Where two different poses agree about equally well, neither is believed.

A sensor whose floor is tilted (`level_turn`) is tried both ways: it may be the sensor that is tilted, or the ground.

How much a match tells depends on what the scan sees: one that sees little, near or in a narrow view, finds it at many
places; and where a map has few places nothing shows how much other ones would match. Both then want more.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import Protocol

import numpy as np
from scipy.spatial import cKDTree

from ggslam.localization.level import about_z, between, floor_height, level_axes, level_turn
from ggslam.localization.near import Near
from ggslam.localization.surface import Surface
from ggslam.scene.poses import inverse, separation, transform_points
from ggslam.submaps.settings import GridAxes
from ggslam.system.settings import setting, settings_class, tuning_class
from ggslam.tracking.gicp import AlignmentResult, AlignmentStatus

_NO_FLOOR = "the scan shows no floor (the sensor's z axis has to point up)"


@tuning_class(frozen=True)
class ScanLookUpTuning:
    """Numbers of looking a scan up in a whole map."""

    candidates: int = setting(10, 1, 1000)
    """Places tried, the likeliest first."""
    more: int = setting(4, 0, 1000)
    """Places tried after one that matches well."""
    apart: float = setting(1.5, 0, 1e4, "m")
    """Of places closer than this with about the same heading the likeliest is tried."""
    max_through: float = setting(0.15, 0, 1)
    """Largest share of the map's surfaces in view that the scan may look through."""
    margin: float = setting(0.05, 0, 1)
    """Least lead of the best pose's score over every other."""
    margin_missing: float = setting(0.4, 0, 10)
    """Factor on what the score lacks to 1, added to `margin`."""
    min_structure: int = setting(40, 0, 10**6)
    """Least number of half-metre squares, from above, with upright structure."""
    few: int = setting(8, 0, 1000)
    """With fewer places `few_fit` applies."""
    few_fit: float = setting(0.75, 0, 1)
    """Least share of upright structure on surfaces of the map if there are few places."""
    picture = 160
    """Side, in pixels, of a picture from above."""
    padded = 256
    """Side, in pixels, of the padded picture."""
    good_score = 0.9
    """Score from which a place is confirmed without trying the rest."""
    max_floors = 4
    """Most floors of a candidate place."""
    max_upright_sine = 0.7
    """Largest vertical component of the unit normal of an upright surface."""
    on_surface_voxels = 0.4
    """Largest distance of a point from a surface, in voxels."""
    min_points = 30
    """Fewest points that tell whether a scan matches."""
    directions = 180
    """Columns of the image of directions around a sensor."""
    elevations = 90
    """Rows of that image."""
    sufficient_inside = 0.5
    """Share of the scan's upright points inside the map from which all of the score counts."""
    square_m = 0.5
    """Side, in metres, of the squares in which upright points are counted."""
    strange_fit = 0.2
    """Best fit below which the scan probably has other axes."""
    turns_deg = np.arange(-9.0, 10.0, 3.0)
    """Headings, in degrees from a guess, at which pictures are compared."""
    max_ring_rad = np.radians(0.5)
    """Largest range of elevations, in radians, of a scan that consists of one ring."""


@settings_class(frozen=True)
class ScanLookUpSettings(ScanLookUpTuning):
    """How a scan is looked up in the whole map and when the result is accepted."""

    min_fit: float = setting(0.55, 0, 1)
    """Least share of the upright structure of a scan that lies on surfaces of the map."""


@dataclass(frozen=True)
class FoundPose:
    """A pose that was tried.

    Attributes:
        alignment: of the scan.
        fit, through: see `ScanLookUpSettings`.
        inside: share of what stands upright in the scan that lies where the map can contain it.
    """

    alignment: AlignmentResult
    fit: float
    through: float
    inside: float = 1.0

    @property
    def score(self) -> float:
        """Agreement, 0 to 1."""
        return self.fit * (1 - self.through)


class Guesser(Protocol):
    """Guesses where a scan was made; see `ScanPlaces`, `MapPicture`."""

    @property
    def damage(self) -> list[str]:
        """What is wrong with parts of the map that were left out."""

    def __len__(self) -> int: ...

    def guesses(self, points: np.ndarray, floor: float, count: int, apart: float) -> Iterator[np.ndarray]:
        """See `MapPicture.guesses`."""


@dataclass(frozen=True)
class _Scan:
    """A levelled scan.

    Attributes:
        points: [n, 3], about the sensor.
        floor: its height.
        T_scan_sensor: what levelled it.
    """

    points: np.ndarray
    floor: float
    T_scan_sensor: np.ndarray

    @staticmethod
    def of(points: np.ndarray) -> list[_Scan]:
        """Of points [n, 3] in the sensor's frame: as they are, and with a tilted floor levelled; none where they show
        no floor."""
        points = np.asarray(points, np.float64)[np.isfinite(points).all(1)]
        turn = level_turn(points)
        found = []
        for R in (np.eye(3), turn) if (turn != np.eye(3)).any() else (turn,):
            T, level = np.eye(4), points @ R.T
            T[:3, :3], floor = R, floor_height(level)
            if floor is not None:
                found.append(_Scan(level, floor, T))
        return found

    def standing_points(self, voxel: float) -> np.ndarray:
        """What stands upright, one point in a voxel, [m, 3]."""
        standing = self.points[between(self.points, self.floor)]
        _, first = np.unique(np.floor(standing / voxel).astype(np.int64), axis=0, return_index=True)
        return standing[first]

    @property
    def structure(self) -> int:
        """Squares of half a metre that something stands in."""
        standing = self.points[between(self.points, self.floor)][:, :2]
        return len(np.unique(np.floor(standing / ScanLookUpTuning.square_m).astype(np.int64), axis=0))

    @property
    def is_ring(self) -> bool:
        """Whether all points lie on one cone about the sensor's axis."""
        elevation = np.arctan2(self.points[:, 2], np.hypot(self.points[:, 0], self.points[:, 1]))
        return bool(np.ptp(np.percentile(elevation, [2, 98])) < ScanLookUpTuning.max_ring_rad)


Align = Callable[[np.ndarray], AlignmentResult]
"""Aligns the scan to the surface's target from a guess T_world_sensor."""


class ScanLookUp:
    """Looks scans up among places.

    Args:
        make_places: gives the map's places; asked when the first scan is looked up.
        axes: of the map's grid.
        settings: see `ScanLookUpSettings`.
        min_overlap: share of the points that must match.
        near: poses elsewhere are not believed; None: anywhere.
    """

    def __init__(
        self, make_places: Callable[[], Guesser], axes: GridAxes, settings: ScanLookUpSettings | None = None,
        min_overlap: float = 0.5, near: Near | None = None,
    ) -> None:  # fmt: skip
        self.settings, self._min_overlap = settings or ScanLookUpSettings(), min_overlap
        self._axes, self._near = axes, near
        self._make_places = make_places
        self._places: Guesser | None = None
        self._R_world_level = level_axes(axes)
        self._map: tuple[object, np.ndarray, np.ndarray] | None = None

    @property
    def damage(self) -> list[str]:
        """What is wrong with parts of the map that were left out, as far as they were read."""
        return [] if self._places is None else self._places.damage

    def find(self, points: np.ndarray, surface: Surface, align: Align) -> tuple[FoundPose | None, str]:
        """The pose of a scan, and why it is believed or not. Moves the surface.

        Args:
            points: float [n, 3] in the sensor's frame, z up, metres.
            surface: of the map.
            align: see `Align`.
        """
        if self._places is None:
            self._places = self._make_places()
        scans = _Scan.of(points)
        reason = self._why_not(scans)
        if reason:
            return None, reason
        found: list[FoundPose] = []
        tried = 0
        for scan in scans:
            poses, count = self._try_all(scan, surface, align)
            found, tried = found + poses, tried + count
            if poses:
                best = max(poses, key=lambda pose: pose.score).alignment.T_world_camera
                turned = best @ inverse(scan.T_scan_sensor)
                turned[:3, :3] = turned[:3, :3] @ about_z(np.pi)
                if (pose := self._try(scan, turned, surface, align)) is not None:
                    found.append(pose)
        ranked = sorted(found, key=lambda pose: -pose.score)
        believed, reason = self._judge([pose for pose in ranked if self._allows(pose)], tried)
        if believed is None and ranked and not self._allows(ranked[0]):
            there = _position_text(ranked[0].alignment.T_world_camera)
            reason = f"the scan matches the map best at {there}, which is not {self._near}; near it, {reason}"
        return believed, reason

    def _allows(self, pose: FoundPose) -> bool:
        position = pose.alignment.T_world_camera[None, :3, 3]
        return self._near is None or bool(self._near.allows(position, self._axes)[0])

    def _why_not(self, scans: list[_Scan]) -> str:
        if not scans:
            return _NO_FLOOR
        if scans[0].is_ring:
            return "a scan of a single ring cannot be looked up: it shows no heights"
        if max(scan.structure for scan in scans) < self.settings.min_structure:
            return "the scan sees too little to tell one place from another"
        return "" if self._places else "there are no places to look it up among"

    def _try_all(self, scan: _Scan, surface: Surface, align: Align) -> tuple[list[FoundPose], int]:
        """Poses that were found, and how many places were tried."""
        assert self._places is not None
        found: list[FoundPose] = []
        tried, left = 0, self.settings.candidates * ScanLookUpTuning.max_floors
        for guess in self._places.guesses(scan.points, scan.floor, self.settings.candidates, self.settings.apart):
            tried += 1
            if (pose := self._try(scan, guess, surface, align)) is not None:
                found.append(pose)
                if pose.score > ScanLookUpTuning.good_score:  # others as good look as likely, and come soon
                    left = min(left, self.settings.more + 1)
            left -= 1
            if not left:
                return found, max(tried, self.settings.few)
        return found, tried

    def _judge(self, ranked: list[FoundPose], tried: int) -> tuple[FoundPose | None, str]:
        limits = self.settings
        if not ranked or ranked[0].fit < limits.min_fit or ranked[0].through > limits.max_through:
            what = f"; at best {ranked[0].fit:.0%} match, {ranked[0].through:.0%} looked through" if ranked else ""
            fits = ranked and ranked[0].fit > ScanLookUpTuning.strange_fit
            axes = "" if fits else " (the sensor's z axis has to point up)"
            return None, f"no place of the map looks like the scan{what}{axes}"
        best = ranked[0]
        here = _position_text(best.alignment.T_world_camera)
        if best.alignment.overlap < self._min_overlap:
            overlap = f"{best.alignment.overlap:.0%} of the points match"
            return None, f"the scan looks like {here}, but only {overlap}, {self._min_overlap:.0%} needed"
        if tried < limits.few and best.fit < limits.few_fit:
            fit = f"{best.fit:.0%} match, {limits.few_fit:.0%} needed"
            return None, f"the map has few places to compare {here} with: {fit}"
        inside = min(1.0, best.inside / ScanLookUpTuning.sufficient_inside)
        margin = limits.margin + limits.margin_missing * (1 - best.score * inside)
        for other in ranked[1:]:
            moved, turned = separation(best.alignment.T_world_camera, other.alignment.T_world_camera)
            if (moved > 0.5 or turned > 5) and other.score > best.score - margin:
                there = _position_text(other.alignment.T_world_camera)
                return None, f"the scan matches {here} little better than {there}, so neither is believed"
        return best, f"looks like the map at {here}"

    def _try(self, scan: _Scan, guess: np.ndarray, surface: Surface, align: Align) -> FoundPose | None:
        surface.move_to(guess[:3, 3])
        if surface.target is None:
            return None
        voxels, normals = self._level_map(surface)
        guess = self._from_above(scan.points, scan.floor, guess, voxels, normals)
        alignment = align(guess @ scan.T_scan_sensor)
        if alignment.status is AlignmentStatus.LOST:
            return None
        T_level_scan = alignment.T_world_camera @ inverse(scan.T_scan_sensor)
        T_level_scan[:3] = self._R_world_level.T @ T_level_scan[:3]
        upright = np.abs(normals[:, 2]) < ScanLookUpTuning.max_upright_sine
        standing = transform_points(scan.standing_points(surface.target.voxel), T_level_scan)
        covered = standing[surface.covers(standing @ self._R_world_level.T)]
        fit = _fit(covered, voxels[upright], normals[upright], surface.target.voxel)
        through = _through(scan.points, transform_points(voxels, inverse(T_level_scan)))
        return FoundPose(alignment, fit, through, len(covered) / max(1, len(standing)))

    def _level_map(self, surface: Surface) -> tuple[np.ndarray, np.ndarray]:
        """Voxels of the target and their normals, [n, 3], in the level frame."""
        target = surface.target
        assert target is not None
        if self._map is None or self._map[0] is not target:
            voxels = target.voxels()
            means, normals = (voxels[name].astype(np.float64) for name in ("means", "normals"))
            self._map = (target, (means + target.origin) @ self._R_world_level, normals @ self._R_world_level)
        return self._map[1], self._map[2]

    def _from_above(
        self, points: np.ndarray, floor: float, guess: np.ndarray, voxels: np.ndarray, normals: np.ndarray
    ) -> np.ndarray:
        """A better guess, by pictures from above."""
        R, position = self._R_world_level.T @ guess[:3, :3], self._R_world_level.T @ guess[:3, 3]
        standing = points[between(points, floor)][:, :2]
        around = voxels - position
        around = around[(np.abs(normals[:, 2]) < ScanLookUpTuning.max_upright_sine) & between(around, floor)][:, :2]
        if not len(standing) or not len(around):
            return guess
        far = float(np.percentile(np.linalg.norm(standing, axis=1), 90))
        reach = float(np.clip(min(far, np.linalg.norm(around, axis=1).max()), 5.0, 60.0))
        pixel = 2 * reach / ScanLookUpTuning.picture
        map_spectrum = np.fft.rfft2(_widen(_picture(around, reach, pixel)))
        best = (-1.0, 0.0, np.zeros(2))
        most = int(np.clip(4.0 / pixel, 4, ScanLookUpTuning.picture // 4))
        for turn in np.radians(ScanLookUpTuning.turns_deg):
            turned = standing @ (about_z(turn)[:2, :2] @ R[:2, :2]).T
            picture = _picture(turned, reach, pixel)
            padded = ScanLookUpTuning.padded
            overlap = np.fft.irfft2(map_spectrum * np.fft.rfft2(picture).conj(), s=(padded, padded))
            overlap = np.roll(overlap, (most, most), (0, 1))[: 2 * most + 1, : 2 * most + 1]
            peak = np.unravel_index(int(overlap.argmax()), overlap.shape)
            if overlap[peak] > best[0] + 1e-6:
                best = (float(overlap[peak]), float(turn), (np.array(peak) - most) * pixel)
        T = guess.copy()
        T[:3, :3] = self._R_world_level @ about_z(best[1]) @ R
        T[:3, 3] = self._R_world_level @ (position + [*best[2], 0.0])
        return T


def _position_text(T: np.ndarray) -> str:
    return f"({T[0, 3]:.2f}, {T[1, 3]:.2f}, {T[2, 3]:.2f})"


def _picture(points: np.ndarray, reach: float, pixel: float) -> np.ndarray:
    """Which pixels hold points [n, 2], float32 [_PADDED, _PADDED] with x along the rows."""
    at = np.floor((points + reach) / pixel).astype(np.int64)
    at = at[((at >= 0) & (at < ScanLookUpTuning.picture)).all(1)]
    picture = np.zeros((ScanLookUpTuning.padded, ScanLookUpTuning.padded), np.float32)
    picture[at[:, 0], at[:, 1]] = 1.0
    return picture


def _widen(picture: np.ndarray) -> np.ndarray:
    """Each pixel takes half of its brightest neighbour's value at least; the picture has an empty border."""
    across = np.maximum(np.roll(picture, 1, 0), np.roll(picture, -1, 0))
    wide = np.maximum(picture, across)
    return np.maximum(picture, 0.5 * np.maximum(wide, np.maximum(np.roll(wide, 1, 1), np.roll(wide, -1, 1))))


def _fit(standing: np.ndarray, voxels: np.ndarray, normals: np.ndarray, voxel: float) -> float:
    """Share of what stands upright in the scan that lies on surfaces of the map, given by means and normals of voxels;
    all [n, 3] in the level frame."""
    if not len(voxels) or len(standing) < ScanLookUpTuning.min_points:
        return 0.0
    _, nearest = cKDTree(voxels).query(standing, distance_upper_bound=voxel)
    there = nearest < len(voxels)
    off = np.abs(((standing[there] - voxels[nearest[there]]) * normals[nearest[there]]).sum(1))
    return float((off <= ScanLookUpTuning.on_surface_voxels * voxel).sum() / len(standing))


def _through(points: np.ndarray, voxels: np.ndarray) -> float:
    """Share of a map's voxels that a scan looks through, of those in its view; both [n, 3] in the sensor's frame."""
    seen = np.full((ScanLookUpTuning.elevations, ScanLookUpTuning.directions), np.inf)
    distance = np.linalg.norm(points, axis=1)
    row, column = _direction(points)
    np.minimum.at(seen, (row, column), distance)
    about = np.pad(seen, ((1, 1), (0, 0)), constant_values=np.inf)
    about = np.minimum(np.minimum(about[:-2], about[2:]), seen)
    about = np.minimum(np.minimum(np.roll(about, 1, 1), np.roll(about, -1, 1)), about)
    row, column = _direction(voxels)
    there = np.isfinite(seen[row, column])
    away, nearest = np.linalg.norm(voxels[there], axis=1), about[row[there], column[there]]
    slack = 0.3 + 0.05 * away
    before, same = away < nearest - slack, np.abs(away - nearest) <= slack
    total = int(before.sum() + same.sum())
    return float(before.sum() / total) if total else 1.0


def _direction(points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    azimuth = np.arctan2(points[:, 1], points[:, 0])
    elevation = np.arctan2(points[:, 2], np.hypot(points[:, 0], points[:, 1]))
    column = (
        np.floor((azimuth / (2 * np.pi)) % 1.0 * ScanLookUpTuning.directions).astype(np.int64)
        % ScanLookUpTuning.directions
    )
    row = np.clip(
        np.floor((elevation / np.pi + 0.5) * ScanLookUpTuning.elevations), 0, ScanLookUpTuning.elevations - 1
    ).astype(np.int64)
    return row, column
