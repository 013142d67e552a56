# SPDX-License-Identifier: Apache-2.0
"""Finds scans in maps that no scan was recorded in, clouds or runs: the map as a picture from above.

Its pixels tell where something stands upright. A scan makes such a picture, too, and one of where it looked through.
Both are correlated with the map's by FFT at every turn: the score of a pose is the share of what stands in the scan
that stands in the map, less what stands in the map where the scan saw through (correlative scan matching; Konolige and
Chou, IJCAI 1999; Olson, ICRA 2009). Time and memory go with the area of the map; `Near` limits it.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np
from scipy import fft, ndimage

from ggslam.errors import FormatError
from ggslam.localization.level import about_z, between, level_axes
from ggslam.localization.near import Near
from ggslam.submaps.grid import GridStore
from ggslam.submaps.recorder import load_points
from ggslam.submaps.settings import GridAxes

_THINNED = 0.25
"""Edge in metres of the cubes of which one point each is held."""
_SLICES = 3
"""Cubes above one another, of a column, that make something that stands upright."""
_FINEST, _COARSEST = 0.25, 1.0
_ACROSS = 60
"""Pixels that the scan's reach has."""
_REACH_PERCENTILE = 90
"""Of what stands in the scan, seen from above, so much is used, the nearest."""
_LARGEST = 3000
"""Pixels along a side of the map's picture at most; of larger maps they are coarser."""
_TURNS = 120
_THROUGH = 0.3
"""What a pixel counts that the scan looks through, to one that fits."""
_SECTORS = 360
_HEADROOM, _LEVEL = 0.3, 1.0
"""Metres of free space above a sensor; floors nearer to each other in height are one."""
_FLOORS = 3
_COLUMN = 0.5
_BESIDE = 10.0
"""Metres beside all that a map holds within which a sensor may stand."""
_AROUND = (0.75, 3.0, 8.0)
"""Metres within which floors are looked for: a scanner sees none below itself."""


@dataclass(frozen=True)
class _Picture:
    """Pixels [h, w] with x along the rows, edge `pixel` metres, the first one's corner at `corner`; spectrum: of it
    with its border, `padded` pixels along each side."""

    spectrum: np.ndarray
    corner: np.ndarray
    pixel: float
    size: tuple[int, int]
    padded: tuple[int, int]


class MapPicture:
    """Places in a map by what stands in it.

    Args:
        points: of the map, [n, 3], in a level frame, one in a cube of 0.25 m.
        axes: of the map's grid.
        damage: what is wrong with cells that were left out.
        near: only places near a position.
    """

    def __init__(
        self, points: np.ndarray, axes: GridAxes, damage: Sequence[str] = (), near: Near | None = None
    ) -> None:
        self.damage = list(damage)
        self._axes, self._near = axes, near
        self._points, self._R_world_level = points, level_axes(axes)
        self._picture: _Picture | None = None

    def __len__(self) -> int:
        return len(self._points)

    def guesses(self, points: np.ndarray, floor: float, count: int, apart: float) -> Iterator[np.ndarray]:
        """Poses T_world_sensor, the likeliest first.

        Args:
            points: [n, 3] of the scan, in the sensor's frame, z up, metres.
            floor: its height there.
            count: of positions.
            apart: metres between those of about the same azimuth.
        """
        standing = points[between(points, floor)][:, :2]
        if not len(standing) or not len(self):
            return
        places = np.unique(np.floor(standing / _THINNED).astype(np.int64), axis=0) * _THINNED
        reach = float(np.percentile(np.linalg.norm(places, axis=1), _REACH_PERCENTILE))
        picture = self._of(float(np.clip(reach / _ACROSS, _FINEST, _COARSEST)))
        best, turn = _scores(picture, standing, reach)
        if self._near is not None:
            best[~_pixels_near(picture, self._near, self._axes)] = -np.inf
        for position, angle in _peaks(best, turn, picture, count, apart):
            for z in self._floors(position, -floor):
                T = np.eye(4)
                T[:3, :3] = self._R_world_level @ about_z(angle)
                T[:3, 3] = self._R_world_level @ [*position, z - floor]
                if self._near is None or self._near.allows(T[None, :3, 3], self._axes)[0]:
                    yield T

    def _of(self, pixel: float) -> _Picture:
        extent = np.ptp(self._points[:, :2], axis=0).max()
        pixel = max(pixel, float(extent) / _LARGEST)
        if self._picture is None or not 0.7 < self._picture.pixel / pixel < 1.4:
            self._picture = _picture_of(self._points, pixel)
        return self._picture

    def _floors(self, position: np.ndarray, height: float) -> list[float]:
        """Heights of what has room for a sensor above it, around a position [2], the lowest first."""
        away = np.abs(self._points[:, :2] - position).max(1)
        for radius in _AROUND:
            around = self._points[away < radius]
            covered, bare = _floors_of(around, height + _HEADROOM)
            # What has nothing above it is a roof if there is a floor below it.
            floors = np.sort(np.append(covered, bare[bare < covered.min(initial=np.inf) + _LEVEL]))
            if len(floors):
                new = np.append(True, np.diff(floors) > _LEVEL)
                return [float(np.median(level)) for level in np.split(floors, np.nonzero(new)[0][1:])][:_FLOORS]
        return []


def _floors_of(points: np.ndarray, room: float) -> tuple[np.ndarray, np.ndarray]:
    """Heights of points [n, 3] with so much room below the next one in their column, and of those with none above."""
    columns = np.floor(points[:, :2] / _COLUMN).astype(np.int64)
    order = np.lexsort((points[:, 2], columns[:, 1], columns[:, 0]))
    columns, z = columns[order], points[order, 2]
    last = np.append((columns[1:] != columns[:-1]).any(1), True)[: len(z)]
    return z[:-1][~last[:-1] & (np.diff(z) >= room)], z[last]


def picture_of_store(store: GridStore, near: Near | None = None, reach: float = 60.0) -> MapPicture:
    """The picture of a map's points; `near`: only of what is seen from there, up to `reach` metres away."""
    axes, damaged = store.settings.axes, []
    chunks = [np.zeros((0, 3))]
    for key in store.cells():
        try:
            points = load_points(store, key)["points"].astype(np.float64)
        except FormatError as error:
            damaged.append(str(error))
            continue
        except KeyError:  # a cell without points
            continue
        if near is not None:
            points = points[near.allows(points, axes, reach)]
        chunks.append(_thin(points))
    if near is not None and not any(near.allows(points, axes, _BESIDE).any() for points in chunks):
        chunks = chunks[:1]
    return MapPicture(_thin(np.concatenate(chunks) @ level_axes(axes)), axes, damaged, near)


def _thin(points: np.ndarray) -> np.ndarray:
    points = points[np.isfinite(points).all(1)]
    if not len(points):
        return points
    cubes = np.floor(points / _THINNED).astype(np.int64)
    cubes -= cubes.min(0)
    span = cubes.max(0) + 1
    _, first = np.unique((cubes[:, 0] * span[1] + cubes[:, 1]) * span[2] + cubes[:, 2], return_index=True)
    return points[np.sort(first)]


def _picture_of(points: np.ndarray, pixel: float) -> _Picture:
    corner = points[:, :2].min(0)
    at = np.floor((points[:, :2] - corner) / pixel).astype(np.int64)
    size = (int(at[:, 0].max()) + 1, int(at[:, 1].max()) + 1)
    heights = np.floor((points[:, 2] - points[:, 2].min()) / _THINNED).astype(np.int64)
    place = at[:, 0] * size[1] + at[:, 1]
    held = np.unique(place * (heights.max() + 1) + heights) // (heights.max() + 1)
    image = (np.bincount(held, minlength=size[0] * size[1]) >= _SLICES).reshape(size).astype(np.float32)
    soft = np.maximum(image, 0.5 * ndimage.maximum_filter(image, 3))
    # What is correlated reaches over the border; it may wrap around into the empty part.
    padded = tuple(fft.next_fast_len(side + int(_COARSEST * 120 / pixel), real=True) for side in size)
    return _Picture(fft.rfft2(soft, padded, workers=-1), corner, pixel, size, (padded[0], padded[1]))


def _scores(picture: _Picture, standing: np.ndarray, reach: float) -> tuple[np.ndarray, np.ndarray]:
    """The best score of a sensor in each pixel of the map, and the turn it has it at, [h, w]."""
    distance = np.linalg.norm(standing, axis=1)
    standing, distance = standing[distance < reach], distance[distance < reach]
    half = int(np.ceil(reach / picture.pixel)) + 1
    nearest = np.full(_SECTORS, np.inf)
    azimuth = np.arctan2(standing[:, 1], standing[:, 0])
    np.minimum.at(nearest, np.floor(azimuth / (2 * np.pi) % 1.0 * _SECTORS).astype(np.int64) % _SECTORS, distance)
    # Where nothing was measured nobody knows whether something stands.
    nearest = np.where(np.isfinite(nearest), nearest, 0.0)
    x, y = np.mgrid[-half : half + 1, -half : half + 1] * picture.pixel
    away, direction = np.hypot(x, y), np.arctan2(y, x)
    best = np.full(picture.size, -np.inf, np.float32)
    turn = np.zeros(picture.size, np.float32)
    for angle in np.arange(_TURNS) * (2 * np.pi / _TURNS):
        at = np.rint(standing @ about_z(angle)[:2, :2].T / picture.pixel).astype(np.int64) + half
        kernel = np.zeros((2 * half + 1, 2 * half + 1), np.float32)
        kernel[at[:, 0], at[:, 1]] = 1.0
        seen = nearest[np.floor((direction - angle) / (2 * np.pi) % 1.0 * _SECTORS).astype(np.int64) % _SECTORS]
        kernel[(kernel == 0) & (away < seen - 1.5 * picture.pixel)] = -_THROUGH
        kernel /= max(1, (kernel > 0).sum())
        spectrum = fft.rfft2(kernel, picture.padded, workers=-1)
        score = fft.irfft2(picture.spectrum * spectrum.conj(), picture.padded, workers=-1)
        score = np.roll(score, (half, half), (0, 1))[: picture.size[0], : picture.size[1]]
        better = score > best
        best[better], turn[better] = score[better], angle
    return best, turn


def _pixels_near(picture: _Picture, near: Near, axes: GridAxes) -> np.ndarray:
    """Which pixels are near a position, whatever its height, bool [h, w]."""
    R_world_level = level_axes(axes)
    level = np.zeros((*picture.size, 3))
    level[..., :2] = (np.moveaxis(np.indices(picture.size), 0, -1) + 0.5) * picture.pixel + picture.corner
    if len(near.position) == 3:
        level[..., 2] = (R_world_level.T @ np.array(near.position))[2]
    return near.allows(level.reshape(-1, 3) @ R_world_level.T, axes).reshape(picture.size)


def _peaks(
    best: np.ndarray, turn: np.ndarray, picture: _Picture, count: int, apart: float
) -> Iterator[tuple[np.ndarray, float]]:
    """Positions [2] and turns of the greatest scores that are `apart` metres from one another."""
    size = 2 * max(1, int(apart / picture.pixel)) + 1
    peaks = np.nonzero(((best == ndimage.maximum_filter(best, size)) & np.isfinite(best)).reshape(-1))[0]
    for index in peaks[np.argsort(-best.reshape(-1)[peaks], kind="stable")][:count].tolist():
        row, column = divmod(index, best.shape[1])
        yield picture.corner + (np.array([row, column]) + 0.5) * picture.pixel, float(turn[row, column])
