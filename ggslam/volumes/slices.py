# SPDX-License-Identifier: Apache-2.0
"""Plane slices through the distance field: arrays and pictures.

A slice is a grid of square cells on an oriented plane. Arrays are [H, W] with row 0 at the top, where y is largest, as
in pictures; column 0 is where x is smallest.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np

from ggslam.volumes.cell_field import AnyField, CellField
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
        distance: float32 [H, W], metres, at the cells' centres. NaN: not known.
        known: bool [H, W].
        occupied: bool [H, W], whether a cell has a surface in it.
        behind: bool [H, W], whether a cell is behind a surface, at one that no point was measured near, or may have a
            measured point in it: not free, whatever is known.
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


def plane_at_height(field: AnyField, up: np.ndarray, height: float) -> SlicePlane:
    """The plane at a height, as large as the field's blocks.

    Args:
        field: with blocks.
        up: [3], direction of which heights are measured from the field's origin.
        height: metres along `up`.

    Returns:
        Seen from above, with the axes of `level_axes`.
    """
    x, y, z = level_axes(up)
    edge, blocks = SIDE * field.voxel, field.coordinates()
    if not len(blocks):
        return SlicePlane(field.origin + height * z, x, y, (0.0, 0.0), (0.0, 0.0))
    ends = []
    for axis in (x, y):
        along = blocks[:, 0] * axis[0] + blocks[:, 1] * axis[1] + blocks[:, 2] * axis[2]
        beyond = [float(np.dot(corner, axis)) for corner in np.ndindex(2, 2, 2)]
        ends.append((edge * (float(along.min()) + min(beyond)), edge * (float(along.max()) + max(beyond))))
    (x0, x1), (y0, y1) = ends
    return SlicePlane(field.origin + height * z, x, y, (x0, y0), (x1, y1))


def slice_field(field: AnyField, plane: SlicePlane, resolution: float) -> FieldSlice:
    """Slices the field.

    A cell is occupied if its centre is from half a cell before a surface (or half a voxel, if that is more) to a cell
    behind it, or if a point was measured in it: the middle of an eighth of a voxel that has points lies in it, or any
    part of one that is a thin thing. No cell that overlaps an eighth with points is free. What there is between two
    heights, `driving.bands` tells.

    Args:
        field: to slice; cells on disk are read a few at a time.
        plane: where.
        resolution: edge of a cell, metres.

    Raises:
        InputError: a resolution that is not positive, or more than 50 million cells.
    """
    grid, cell = CellGrid.over(plane, resolution), max(resolution, field.voxel)
    distance, near, points = _of_cells(field, grid) if isinstance(field, CellField) else _of_all(field, grid)
    occupied = (distance <= cell / 2) & (distance >= -cell)
    unseen = unseen_surface(occupied, near)
    occupied, behind = (occupied & ~unseen) | points, (distance < 0) | unseen | near
    return FieldSlice(grid.plane, resolution, distance, ~np.isnan(distance), occupied, behind)


def _of_all(field: DistanceField, grid: CellGrid) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Distances [H, W]; which cells may have measured points, and which have, bool [H, W]."""
    surface = SeenSurface(field, grid.plane)
    distance = field.query(grid.places().reshape(-1, 3)).distance.reshape(grid.shape)
    return distance, surface.near_points(grid, 0.0, 0.0), surface.with_points(grid, 0.0, 0.0)


def _of_cells(field: CellField, grid: CellGrid) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """The same of cells on disk."""
    distance = np.full(grid.shape, np.nan, np.float32)
    near, points = np.zeros(grid.shape, bool), np.zeros(grid.shape, bool)
    for part in field.parts(grid.plane, 0.0, 0.0, field.settings.max_distance):
        window, surface = part.window(grid), SeenSurface(part.field, grid.plane, part.owns)
        places = grid.places(window).reshape(-1, 3)
        own = part.owns(places - field.origin)
        distance[window.slices][own.reshape(window.shape)] = part.field.query(places[own]).distance
        near[window.slices] |= surface.near_points(grid, 0.0, 0.0, window=window)
        points[window.slices] |= surface.with_points(grid, 0.0, 0.0, window=window)
    return distance, near, points


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
