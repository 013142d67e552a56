# SPDX-License-Identifier: Apache-2.0
"""Finds the place of a laser scan of which nothing is known, in three steps:

1. The likeliest places, by what the scanner would see from points around its own (`scan_views`).
2. For each, position and azimuth from the map around it: pictures of both from above, of what stands between floor and
   head height, are correlated by FFT at a few turns.
3. G-ICP. Then the scan has to agree with the map both ways: what stands in the scan lies on surfaces of the map, and
   the scan looks through none of them. Where two different poses agree about equally well, neither is believed.

The sensor is taken to stand upright, with its z axis up, within some degrees.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import Protocol

import numpy as np
from scipy.spatial import cKDTree

from ggslam.localization.level import about_z, between, floor_height, level_axes
from ggslam.localization.surface import Surface
from ggslam.scene.poses import inverse, separation, transform_points
from ggslam.submaps.settings import GridAxes
from ggslam.system.settings import setting, settings_class
from ggslam.tracking.gicp import AlignmentResult, AlignmentStatus

_TURNS_DEG = np.arange(-9.0, 10.0, 3.0)
_PICTURE = 160
"""Pixels along a side of a picture from above, which is padded to `_PADDED`."""
_PADDED = 256
_GOOD = 0.9
_FLOORS = 4
"""A candidate may stand on several floors."""
_STEEP = 0.7
"""Surfaces are upright whose normals are less steep than this sine."""
_ON_SURFACE = 0.4
"""Edges of a voxel that a point may be off the plane through the nearest one's mean."""
_LEAST = 30
"""Points that tell whether a scan fits at least."""
_DIRECTIONS, _ELEVATIONS = 180, 90


@settings_class(frozen=True)
class ScanLookUpSettings:
    """How a scan is looked up, and when what was found is believed."""

    candidates: int = setting(10, 1, 1000)
    """Places that are tried, the likeliest first."""
    more: int = setting(4, 0, 1000)
    """After one that matches well so many are tried, to see whether another does, too."""
    apart: float = setting(1.5, 0, 1e4, "m")
    """Of places nearer to each other with about the same azimuth the likeliest is tried."""
    min_fit: float = setting(0.55, 0, 1)
    """Share of what stands upright in the scan that lies on surfaces of the map."""
    max_through: float = setting(0.15, 0, 1)
    """Share of the map's surfaces in view that the scan may look through."""
    margin: float = setting(0.05, 0, 1)
    """The score of a pose, its fit times what is not looked through, is this much above every other one's."""
    margin_missing: float = setting(0.4, 0, 10)
    """And this much times what the score is short of 1: what does not match here may be as it is elsewhere."""


@dataclass(frozen=True)
class FoundPose:
    """A pose that was tried.

    Attributes:
        alignment: of the scan.
        fit, through: see `ScanLookUpSettings`.
    """

    alignment: AlignmentResult
    fit: float
    through: float

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


Align = Callable[[np.ndarray], AlignmentResult]
"""Aligns the scan to the surface's target from a guess T_world_sensor."""


class ScanLookUp:
    """Looks scans up among places.

    Args:
        make_places: gives the map's places; asked when the first scan is looked up.
        axes: of the map's grid.
        settings: see `ScanLookUpSettings`.
    """

    def __init__(
        self, make_places: Callable[[], Guesser], axes: GridAxes, settings: ScanLookUpSettings | None = None
    ) -> None:
        self.settings = settings or ScanLookUpSettings()
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
        points = np.asarray(points, np.float64)[np.isfinite(points).all(1)]
        floor = floor_height(points)
        if floor is None or not len(self._places):
            return None, "the scan shows no floor" if floor is None else "there are no places to look it up among"
        guesses = self._places.guesses(points, floor, self.settings.candidates, self.settings.apart)
        found: list[FoundPose] = []
        left = self.settings.candidates * _FLOORS
        for guess in guesses:
            if (pose := self._try(points, floor, guess, surface, align)) is not None:
                found.append(pose)
                if pose.score > _GOOD:  # others as good look as likely, and come soon
                    left = min(left, self.settings.more + 1)
            left -= 1
            if not left:
                break
        return self._judge(sorted(found, key=lambda pose: -pose.score))

    def _judge(self, ranked: list[FoundPose]) -> tuple[FoundPose | None, str]:
        limits = self.settings
        if not ranked or ranked[0].fit < limits.min_fit or ranked[0].through > limits.max_through:
            what = f"; at best {ranked[0].fit:.0%} match, {ranked[0].through:.0%} looked through" if ranked else ""
            return None, f"no place of the map looks like the scan{what}"
        best = ranked[0]
        margin = limits.margin + limits.margin_missing * (1 - best.score)
        for other in ranked[1:]:
            moved, turned = separation(best.alignment.T_world_camera, other.alignment.T_world_camera)
            if (moved > 0.5 or turned > 5) and other.score > best.score - margin:
                here, there = (_position_text(pose.alignment.T_world_camera) for pose in (best, other))
                return None, f"the scan matches {here} little better than {there}, so neither is believed"
        return best, f"looks like the map at {_position_text(best.alignment.T_world_camera)}"

    def _try(
        self, points: np.ndarray, floor: float, guess: np.ndarray, surface: Surface, align: Align
    ) -> FoundPose | None:
        surface.move_to(guess[:3, 3])
        if surface.target is None:
            return None
        voxels, normals = self._level_map(surface)
        guess = self._from_above(points, floor, guess, voxels, normals)
        alignment = align(guess)
        if alignment.status is AlignmentStatus.LOST:
            return None
        T_level_sensor = np.eye(4)
        T_level_sensor[:3] = self._R_world_level.T @ alignment.T_world_camera[:3]
        upright = np.abs(normals[:, 2]) < _STEEP
        standing = self._upright_points(points, floor, T_level_sensor, surface)
        fit = _fit(standing, voxels[upright], normals[upright], surface.target.voxel)
        through = _through(points, transform_points(voxels, inverse(T_level_sensor)))
        return FoundPose(alignment, fit, through)

    def _upright_points(
        self, points: np.ndarray, floor: float, T_level_sensor: np.ndarray, surface: Surface
    ) -> np.ndarray:
        """What stands upright in the scan where the map can contain it, one point in a voxel, [n, 3] in the level
        frame."""
        assert surface.target is not None
        standing = points[between(points, floor)]
        _, first = np.unique(np.floor(standing / surface.target.voxel).astype(np.int64), axis=0, return_index=True)
        standing = transform_points(standing[first], T_level_sensor)
        return standing[surface.covers(standing @ self._R_world_level.T)]

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
        around = around[(np.abs(normals[:, 2]) < _STEEP) & between(around, floor)][:, :2]
        if not len(standing) or not len(around):
            return guess
        far = float(np.percentile(np.linalg.norm(standing, axis=1), 90))
        reach = float(np.clip(min(far, np.linalg.norm(around, axis=1).max()), 5.0, 60.0))
        pixel = 2 * reach / _PICTURE
        map_spectrum = np.fft.rfft2(_widen(_picture(around, reach, pixel)))
        best = (-1.0, 0.0, np.zeros(2))
        most = int(np.clip(4.0 / pixel, 4, _PICTURE // 4))
        for turn in np.radians(_TURNS_DEG):
            turned = standing @ (about_z(turn)[:2, :2] @ R[:2, :2]).T
            picture = _picture(turned, reach, pixel)
            overlap = np.fft.irfft2(map_spectrum * np.fft.rfft2(picture).conj(), s=(_PADDED, _PADDED))
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
    at = at[((at >= 0) & (at < _PICTURE)).all(1)]
    picture = np.zeros((_PADDED, _PADDED), np.float32)
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
    if not len(voxels) or len(standing) < _LEAST:
        return 0.0
    _, nearest = cKDTree(voxels).query(standing, distance_upper_bound=voxel)
    there = nearest < len(voxels)
    off = np.abs(((standing[there] - voxels[nearest[there]]) * normals[nearest[there]]).sum(1))
    return float((off <= _ON_SURFACE * voxel).sum() / len(standing))


def _through(points: np.ndarray, voxels: np.ndarray) -> float:
    """Share of a map's voxels that a scan looks through, of those in its view; both [n, 3] in the sensor's frame."""
    seen = np.full((_ELEVATIONS, _DIRECTIONS), np.inf)
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
    column = np.floor((azimuth / (2 * np.pi)) % 1.0 * _DIRECTIONS).astype(np.int64) % _DIRECTIONS
    row = np.clip(np.floor((elevation / np.pi + 0.5) * _ELEVATIONS), 0, _ELEVATIONS - 1).astype(np.int64)
    return row, column
