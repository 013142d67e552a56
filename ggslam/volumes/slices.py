# SPDX-License-Identifier: Apache-2.0
"""Plane slices through the distance field: arrays and pictures.

A slice is a grid of square cells on an oriented plane. Arrays are [H, W] with row 0 at the top, where y is largest, as
in pictures; column 0 is where x is smallest.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np

from ggslam.errors import InputError
from ggslam.volumes.cell_grid import CellGrid, SlicePlane
from ggslam.volumes.esdf import DistanceField
from ggslam.volumes.floor_frame import level_axes
from ggslam.volumes.seen_surface import SeenSurface, unseen_surface
from ggslam.volumes.tsdf import SIDE


@dataclass(frozen=True)
class FieldSlice:
    """What the field has on a plane.

    Attributes:
        plane: where; its rectangle is that of the cells.
        resolution: edge of a cell, metres.
        distance: float32 [H, W], metres, at the cells' centres; of a band, the least over the heights. NaN: not known.
        known: bool [H, W].
        occupied: bool [H, W], whether a cell has a surface in it.
        behind: bool [H, W], whether a cell is behind a surface (at one of the heights), at one that no point was
            measured near, or may have a measured point in it: not free, whatever is known.
    """

    plane: SlicePlane
    resolution: float
    distance: np.ndarray
    known: np.ndarray
    occupied: np.ndarray
    behind: np.ndarray

    @property
    def free(self) -> np.ndarray:
        """Cells that were seen, with no surface in them and not behind one, bool [H, W]."""
        return self.known & ~self.occupied & ~self.behind


def plane_at_height(field: DistanceField, up: np.ndarray, height: float) -> SlicePlane:
    """The plane at a height, as large as the field's blocks.

    Args:
        field: with blocks.
        up: [3], direction of which heights are measured from the field's origin.
        height: metres along `up`.

    Returns:
        Seen from above, with the axes of `level_axes`.
    """
    x, y, z = level_axes(up)
    edge = SIDE * field.voxel
    corners = np.concatenate([field.coordinates() + shift for shift in np.ndindex(2, 2, 2)]) * edge
    if not len(corners):
        corners = np.zeros((1, 3))
    on_plane = corners @ np.stack([x, y], 1)
    low, high = on_plane.min(axis=0), on_plane.max(axis=0)
    return SlicePlane(field.origin + height * z, x, y, (float(low[0]), float(low[1])), (float(high[0]), float(high[1])))


def slice_field(
    field: DistanceField, plane: SlicePlane, resolution: float, band: tuple[float, float] | None = None
) -> FieldSlice:
    """Slices the field.

    A cell is occupied if its centre is from half a cell before a surface (or half a voxel, if that is more) to a cell
    behind it, or if a point was measured in it: the middle of an eighth of a voxel that has points lies in it, or any
    part of one that is a thin thing. No cell that overlaps an eighth with points is free. With a band, heights from
    `low` to `high` are looked at, a voxel apart: a cell is occupied if it is at any of them, and free if it is known at
    one at least, and occupied or behind a surface at none. A robot as high as the band may therefore drive over a cell
    that was seen at some of its heights only.

    Args:
        field: to slice.
        plane: where.
        resolution: edge of a cell, metres.
        band: lowest and highest offset along the plane's normal, metres; None: the plane alone.

    Raises:
        InputError: a resolution or band that is not positive, or more than 50 million cells.
    """
    if band is not None and not band[0] <= band[1]:
        raise InputError(f"expected an ascending band, found {band} (resolution {resolution})")
    grid, (low, high) = CellGrid.over(plane, resolution), band or (0.0, 0.0)
    centres = grid.places().reshape(-1, 3)
    offsets = np.linspace(low, high, int(np.ceil((high - low) / field.voxel - 1e-6)) + 1)
    least = np.full(len(centres), np.nan, np.float32)
    hit, cell = np.zeros(len(centres), bool), max(resolution, field.voxel)
    for offset in offsets:
        found = field.query(centres + offset * plane.normal).distance
        least = np.fmin(least, found)
        hit |= (found <= cell / 2) & (found >= -cell)
    distance, occupied, surface = least.reshape(grid.shape), hit.reshape(grid.shape), SeenSurface.of(field, plane)
    near, points = surface.near_points(grid, low, high), surface.with_points(grid, low, high)
    unseen = unseen_surface(occupied, near)
    occupied, behind = (occupied & ~unseen) | points, (distance < 0) | unseen | near
    return FieldSlice(grid.plane, resolution, distance, ~np.isnan(distance), occupied, behind)


def slice_picture(cut: FieldSlice, full_scale: float, smallest_side: int = 480) -> np.ndarray:
    """A slice as colours with a scale below, uint8 [H, W, 3].

    Distances go from red (0) to blue (`full_scale` metres and more), what is behind surfaces is dark red, outlines of
    occupied cells are black, unknown cells grey. Cells are magnified by a whole number until the shorter side has
    `smallest_side` pixels, if that takes more than one.
    """
    level = np.clip(1 - np.nan_to_num(cut.distance) / full_scale, 0, 1)
    picture = cv2.applyColorMap((255 * level).astype(np.uint8), cv2.COLORMAP_TURBO)[..., ::-1].copy()
    picture[cut.known & (cut.distance < 0)] = (90, 0, 0)
    inner = cv2.erode(cut.occupied.astype(np.uint8), np.ones((3, 3), np.uint8)) > 0
    picture[cut.occupied & ~inner] = 0
    picture[~cut.known] = 128
    times = magnification(cut.known.shape, smallest_side)
    picture = picture.repeat(times, 0).repeat(times, 1)
    return np.concatenate([picture, _scale(picture.shape[1], full_scale)])


def magnification(shape: tuple[int, ...], smallest_side: int) -> int:
    """By how much cells [H, W] are magnified so that the shorter side has `smallest_side` pixels, if the longer one
    has not more than 4000 then."""
    return max(1, min(-(-smallest_side // min(shape)), 4000 // max(shape)))


def _scale(width: int, full_scale: float) -> np.ndarray:
    """The colours of distances with marks in metres."""
    bar = np.full((46, width, 3), 255, np.uint8)
    ramp = cv2.applyColorMap(np.linspace(255, 0, width).astype(np.uint8)[None], cv2.COLORMAP_TURBO)[..., ::-1]
    bar[4:20] = ramp
    marks = max(2, min(6, width // 90))
    for i in range(marks):
        text = f"{full_scale * i / (marks - 1):.2f}" + (" m" if i == marks - 1 else "")
        size = cv2.getTextSize(text, cv2.FONT_HERSHEY_SIMPLEX, 0.42, 1)[0][0]
        x = int(np.clip(i * (width - 1) / (marks - 1) - size / 2, 2, max(2, width - size - 2)))
        cv2.putText(bar, text, (x, 38), cv2.FONT_HERSHEY_SIMPLEX, 0.42, (0, 0, 0), 1, cv2.LINE_AA)
    return bar
