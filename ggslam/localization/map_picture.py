# SPDX-License-Identifier: Apache-2.0
"""Finds scans in maps without recorded scans, clouds or runs, by a picture of the map from above.

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
from ggslam.system.tuning import Tuning


class MapPictureTuning(Tuning):
    """Search for a scan in the map seen from above."""

    cube_m = 0.25
    """Edge, in metres, of the cubes that keep one point each."""
    min_cubes = 3
    """Fewest cubes of a column that count as something upright."""
    min_pixel_m = 0.25
    """Smallest pixel of the picture in metres."""
    max_pixel_m = 1.0
    """Largest pixel of the picture in metres, except in maps above `max_side`."""
    reach_pixels = 60
    """Pixels that the reach of the scan covers."""
    reach_percentile = 90
    """Percentage of the scan's upright points, the closest ones, that are used."""
    max_side = 3000
    """Most pixels along a side of the picture. Larger maps get coarser pixels."""
    turns = 120
    """Headings that are tried."""
    through_penalty = 0.3
    """Penalty of a pixel that the scan looks through, where a matching pixel scores 1."""
    sectors = 360
    """Sectors around the scan in which free space is measured."""
    headroom_m = 0.3
    """Free height above a sensor in metres."""
    same_floor_m = 1.0
    """Difference in height, in metres, below which two floors are the same."""
    max_floors = 3
    """Most floors that are tried at a place."""
    column_m = 0.5
    """Side, in metres, of the columns in which floors are searched."""
    beside_m = 10.0
    """Distance from the map, in metres, within which a sensor may stand."""
    around_m = (0.75, 3.0, 8.0)
    """Radii, in metres, in which floors are searched, one after the other: a scanner does not see the floor below
    it."""


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
    """Finds places in a map by the upright things in it.

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
        cube = MapPictureTuning.cube_m
        places = np.unique(np.floor(standing / cube).astype(np.int64), axis=0) * cube
        reach = float(np.percentile(np.linalg.norm(places, axis=1), MapPictureTuning.reach_percentile))
        pixel = reach / MapPictureTuning.reach_pixels
        picture = self._of(float(np.clip(pixel, MapPictureTuning.min_pixel_m, MapPictureTuning.max_pixel_m)))
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
        pixel = max(pixel, float(extent) / MapPictureTuning.max_side)
        if self._picture is None or not 0.7 < self._picture.pixel / pixel < 1.4:
            self._picture = _picture_of(self._points, pixel)
        return self._picture

    def _floors(self, position: np.ndarray, height: float) -> list[float]:
        """Heights of what has room for a sensor above it, around a position [2], the lowest first."""
        away = np.abs(self._points[:, :2] - position).max(1)
        for radius in MapPictureTuning.around_m:
            around = self._points[away < radius]
            covered, bare = _floors_of(around, height + MapPictureTuning.headroom_m)
            # What has nothing above it is a roof if there is a floor below it.
            highest = covered.min(initial=np.inf) + MapPictureTuning.same_floor_m
            floors = np.sort(np.append(covered, bare[bare < highest]))
            if len(floors):
                new = np.append(True, np.diff(floors) > MapPictureTuning.same_floor_m)
                levels = np.split(floors, np.nonzero(new)[0][1:])[: MapPictureTuning.max_floors]
                return [float(np.median(level)) for level in levels]
        return []


def _floors_of(points: np.ndarray, room: float) -> tuple[np.ndarray, np.ndarray]:
    """Heights of points [n, 3] with so much room below the next one in their column, and of those with none above."""
    columns = np.floor(points[:, :2] / MapPictureTuning.column_m).astype(np.int64)
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
    if near is not None and not any(near.allows(points, axes, MapPictureTuning.beside_m).any() for points in chunks):
        chunks = chunks[:1]
    return MapPicture(_thin(np.concatenate(chunks) @ level_axes(axes)), axes, damaged, near)


def _thin(points: np.ndarray) -> np.ndarray:
    points = points[np.isfinite(points).all(1)]
    if not len(points):
        return points
    cubes = np.floor(points / MapPictureTuning.cube_m).astype(np.int64)
    cubes -= cubes.min(0)
    span = cubes.max(0) + 1
    _, first = np.unique((cubes[:, 0] * span[1] + cubes[:, 1]) * span[2] + cubes[:, 2], return_index=True)
    return points[np.sort(first)]


def _picture_of(points: np.ndarray, pixel: float) -> _Picture:
    corner = points[:, :2].min(0)
    at = np.floor((points[:, :2] - corner) / pixel).astype(np.int64)
    size = (int(at[:, 0].max()) + 1, int(at[:, 1].max()) + 1)
    heights = np.floor((points[:, 2] - points[:, 2].min()) / MapPictureTuning.cube_m).astype(np.int64)
    place = at[:, 0] * size[1] + at[:, 1]
    held = np.unique(place * (heights.max() + 1) + heights) // (heights.max() + 1)
    upright = np.bincount(held, minlength=size[0] * size[1]) >= MapPictureTuning.min_cubes
    image = upright.reshape(size).astype(np.float32)
    soft = np.maximum(image, 0.5 * ndimage.maximum_filter(image, 3))
    # What is correlated reaches over the border; it may wrap around into the empty part.
    reach = int(MapPictureTuning.max_pixel_m * 120 / pixel)
    padded = tuple(fft.next_fast_len(side + reach, real=True) for side in size)
    return _Picture(fft.rfft2(soft, padded, workers=-1), corner, pixel, size, (padded[0], padded[1]))


def _sectors(azimuth: np.ndarray) -> np.ndarray:
    """The sector, int64, of each azimuth in radians."""
    count = MapPictureTuning.sectors
    return np.floor(azimuth / (2 * np.pi) % 1.0 * count).astype(np.int64) % count


def _scores(picture: _Picture, standing: np.ndarray, reach: float) -> tuple[np.ndarray, np.ndarray]:
    """The best score of a sensor in each pixel of the map, and the turn it has it at, [h, w]."""
    distance = np.linalg.norm(standing, axis=1)
    standing, distance = standing[distance < reach], distance[distance < reach]
    half = int(np.ceil(reach / picture.pixel)) + 1
    nearest = np.full(MapPictureTuning.sectors, np.inf)
    azimuth = np.arctan2(standing[:, 1], standing[:, 0])
    np.minimum.at(nearest, _sectors(azimuth), distance)
    # Where nothing was measured nobody knows whether something stands.
    nearest = np.where(np.isfinite(nearest), nearest, 0.0)
    x, y = np.mgrid[-half : half + 1, -half : half + 1] * picture.pixel
    away, direction = np.hypot(x, y), np.arctan2(y, x)
    best = np.full(picture.size, -np.inf, np.float32)
    turn = np.zeros(picture.size, np.float32)
    for angle in np.arange(MapPictureTuning.turns) * (2 * np.pi / MapPictureTuning.turns):
        at = np.rint(standing @ about_z(angle)[:2, :2].T / picture.pixel).astype(np.int64) + half
        kernel = np.zeros((2 * half + 1, 2 * half + 1), np.float32)
        kernel[at[:, 0], at[:, 1]] = 1.0
        seen = nearest[_sectors(direction - angle)]
        kernel[(kernel == 0) & (away < seen - 1.5 * picture.pixel)] = -MapPictureTuning.through_penalty
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
