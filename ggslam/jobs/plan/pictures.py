# SPDX-License-Identifier: Apache-2.0
"""Pictures of paths: from above, and for those that fly the heights along them."""

from __future__ import annotations

import cv2
import numpy as np

from ggslam.driving.plan_maps import InMemory
from ggslam.driving.planner import PlannedPath, Planner
from ggslam.scene.poses import inverse, transform_points
from ggslam.system.tuning import Tuning
from ggslam.volumes.slices import FieldSlice, SlicePlane, slice_picture


class PathPictureTuning(Tuning):
    """How paths are drawn."""

    around_m = 1.0
    """Space that is shown around a path, in metres."""
    most_cells = 2000
    """Most cells of a picture along a side; more are drawn coarser."""
    heights_m = 1.0
    """Space above and below that is shown along a path, in metres."""
    scale = 1.25
    """Clearance at the far end of the colours, in clearances that a path keeps where it can."""
    gap = 12
    """Pixels between two pictures."""


_WHITE, _BLACK, _GREEN, _RED = (255, 255, 255), (0, 0, 0), (40, 180, 60), (220, 40, 40)


def path_picture(planner: Planner, path: PlannedPath, start: np.ndarray, goal: np.ndarray) -> np.ndarray:
    """A path, or start and goal, over the clearances around; uint8 [H, W, 3].

    Clearances go from red (0) to blue (what a path keeps where it can, and more), unknown cells are grey. For a path
    that flies the plane is that of its middle height, and below is the section along it, unrolled.
    """
    T_floor_map = planner.map.T_floor_map
    shown = np.array([start, goal]) if not path.is_found else path.points
    on_floor, ends = (transform_points(p, T_floor_map) for p in (shown, np.array([start, goal])))
    everything = np.concatenate([on_floor, ends])
    height = float(np.median(on_floor[:, 2])) if planner.map.dimensions == 3 else 0.0
    low = everything[:, :2].min(0) - PathPictureTuning.around_m
    high = everything[:, :2].max(0) + PathPictureTuning.around_m
    step = max(planner.map.cell, float((high - low).max()) / PathPictureTuning.most_cells)
    across, up = (np.arange(low[a] + step / 2, high[a], step) for a in (0, 1))
    places = np.stack(np.broadcast_arrays(across[None], up[::-1, None], height), -1)
    top = _picture(planner, transform_points(places.reshape(-1, 3), inverse(T_floor_map)).reshape(places.shape), step)
    picture, scale = top
    line = on_floor[:, :2] if path.is_found else on_floor[:0, :2]
    _draw(picture, (line - low) / step * scale, (ends[:, :2] - low) / step * scale, len(up) * scale)
    if planner.map.dimensions == 2 or not path.is_found:
        return picture
    return _join(picture, _section(planner, on_floor, step))


def _picture(planner: Planner, places: np.ndarray, step: float) -> tuple[np.ndarray, float]:
    """Clearances at places [H, W, 3] of the map as colours, and pixels in a cell."""
    grid = planner.map.to_grid(places.reshape(-1, 3))
    if isinstance(planner.map.pages, InMemory):  # of others what the search read is shown
        planner.read_box(grid.min(axis=0), grid.max(axis=0))
    clearance = planner.grid.clearance(grid).reshape(places.shape[:2])
    known = ~np.isnan(clearance)
    size = (places.shape[1] * step, places.shape[0] * step)
    plane = SlicePlane(np.zeros(3), np.eye(3)[0], np.eye(3)[1], (0.0, 0.0), size)
    occupied = known & (clearance <= step / 2)
    cut = FieldSlice(plane, step, clearance, known, occupied, np.zeros_like(known))
    full = PathPictureTuning.scale * (planner.costs.radius + planner.costs.margin)
    picture = slice_picture(cut, full)
    return picture, picture.shape[1] / places.shape[1]


def _section(planner: Planner, on_floor: np.ndarray, step: float) -> np.ndarray:
    """Clearances above and below a path [N, 3] (of the floor's frame), along it."""
    along = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(on_floor[:, :2], axis=0), axis=1))])
    low = float(on_floor[:, 2].min()) - PathPictureTuning.heights_m
    high = float(on_floor[:, 2].max()) + PathPictureTuning.heights_m
    distances = np.arange(step / 2, max(along[-1], 2 * step), step)
    heights = np.arange(low + step / 2, high, step)
    x, y = (np.interp(distances, along, on_floor[:, a]) for a in (0, 1))
    places = np.stack(np.broadcast_arrays(x[None], y[None], heights[::-1, None]), -1)
    T_map_floor = inverse(planner.map.T_floor_map)
    picture, scale = _picture(planner, transform_points(places.reshape(-1, 3), T_map_floor).reshape(places.shape), step)
    line = np.stack([along, on_floor[:, 2] - low], 1) / step * scale
    _draw(picture, line, line[[0, -1]], len(heights) * scale)
    return picture


def _draw(picture: np.ndarray, line: np.ndarray, ends: np.ndarray, height: float) -> None:
    """Draws a path [N, 2] and its ends [2, 2], pixels from the lower left corner of the part `height` pixels high."""

    def pixels(points: np.ndarray) -> np.ndarray:
        return np.rint(np.stack([points[:, 0], height - points[:, 1]], 1) * 16).astype(np.int32)

    width = max(1, round(min(picture.shape[:2]) / 300))
    for colour, thickness in ((_BLACK, 3 * width), (_WHITE, width)):
        if len(line):
            cv2.polylines(picture, [pixels(line)], False, colour, thickness, cv2.LINE_AA, 4)
    for at, colour in zip(pixels(ends), (_GREEN, _RED), strict=True):
        centre = (int(at[0]), int(at[1]))
        cv2.circle(picture, centre, 16 * 5 * width, _BLACK, -1, cv2.LINE_AA, 4)
        cv2.circle(picture, centre, 16 * 4 * width, colour, -1, cv2.LINE_AA, 4)


def _join(top: np.ndarray, section: np.ndarray) -> np.ndarray:
    """Both pictures on white: beside one another if the first is upright, else one below the other."""
    beside = top.shape[0] > top.shape[1]
    side = 0 if beside else 1
    size = max(top.shape[side], section.shape[side])
    gap = np.full((size, PathPictureTuning.gap, 3), 255, np.uint8)
    parts = []
    for picture in (top, section):
        missing = [(0, 0), (0, 0), (0, 0)]
        missing[side] = (0, size - picture.shape[side])
        parts.append(np.pad(picture, missing, constant_values=255))
    return np.concatenate([parts[0], gap if beside else gap.transpose(1, 0, 2), parts[1]], axis=1 - side)
