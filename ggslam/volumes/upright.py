# SPDX-License-Identifier: Apache-2.0
"""Which way is up, from how the cameras were held and from the large horizontal surfaces; and where the floor is."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ggslam.system.tuning import Tuning


class UprightSearchTuning(Tuning):
    """How the direction up and the floor are found."""

    max_start_deg = 30.0
    """Largest angle between up and the first guess from the cameras, in degrees."""
    max_normal_deg = 5.0
    """Largest angle between the normal of a horizontal surface and up, in degrees."""
    bin_m = 0.02
    """Width of the bins that heights are counted in, in metres."""
    floor_share = 0.2
    """The floor is the lowest plane with at least this share of the points of the largest plane that faces up."""


@dataclass(frozen=True)
class Upright:
    """Attributes:
    up: [3], unit vector in the world's frame.
    support: share of the surfaces, in [0, 1], with normals within 5 degrees of `up` or its opposite. 0 if `up` rests
        on the cameras alone; in a furnished room 0.2 and more.
    from_cameras_degrees: between `up` and the mean of the cameras' own up directions.
    floor: height along `up` of the lowest large surface that faces up, metres from the world's origin; None: there is
        none.
    """

    up: np.ndarray
    support: float
    from_cameras_degrees: float
    floor: float | None


def estimate_up(
    T_world_from_camera: np.ndarray, points: np.ndarray, normals: np.ndarray, min_support: float = 0.02
) -> Upright:
    """Finds the up direction.

    The mean of the cameras' -y axes is within a few degrees to some tens of it. Of the surface normals within 30
    degrees of that mean (either way: ceilings and undersides face down), the direction that most agree with within 5
    degrees is taken and refined to their mean.

    Args:
        T_world_from_camera: float64 [N, 4, 4], poses.
        points: [S, 3], surface points, metres, evenly spread over the surfaces (`DistanceField.surface`).
        normals: [S, 3], unit vectors to the front; zero: unknown.
        min_support: least share of the normals that must agree; with less, the cameras' mean is returned.
    """
    mean = -np.asarray(T_world_from_camera, np.float64).reshape(-1, 4, 4)[:, :3, 1].mean(axis=0)
    length = np.linalg.norm(mean)
    start = mean / length if length > 1e-6 else np.array([0.0, -1.0, 0.0])
    valid = np.linalg.norm(normals, axis=1) > 0.5
    points, normals = np.asarray(points, np.float64)[valid], np.asarray(normals, np.float64)[valid]
    up, support = _dominant_direction(normals, start)
    if support < min_support:
        up, support = start, 0.0
    angle = float(np.degrees(np.arccos(np.clip(up @ start, -1, 1))))
    return Upright(up, support, angle, _floor_height(points, normals, up))


def _dominant_direction(normals: np.ndarray, start: np.ndarray) -> tuple[np.ndarray, float]:
    """The direction near `start` that most normals agree with, and their share."""
    side = normals @ start
    near = np.abs(side) > np.cos(np.radians(UprightSearchTuning.max_start_deg))
    if not near.any():
        return start, 0.0
    candidates = normals[near] * np.sign(side[near])[:, None]
    # A grid of directions around the start, as coarse as the agreement; then means of those that agree.
    across = np.linalg.svd(start[None])[2][1:]
    reach = np.tan(np.radians(UprightSearchTuning.max_start_deg))
    flat = np.stack(np.meshgrid(*2 * [np.linspace(-reach, reach, 27)]), -1).reshape(-1, 2)
    grid = start + flat @ across
    grid /= np.linalg.norm(grid, axis=1, keepdims=True)
    agree = np.cos(np.radians(UprightSearchTuning.max_normal_deg))
    sample = candidates[:: max(1, len(candidates) // 20_000)]
    up = grid[np.argmax((sample @ grid.T > agree).sum(axis=0))]
    for _ in range(5):
        mean = candidates[candidates @ up > agree].sum(axis=0)
        if not np.linalg.norm(mean) > 0:
            break
        up = mean / np.linalg.norm(mean)
    if up @ start < np.cos(np.radians(UprightSearchTuning.max_start_deg + UprightSearchTuning.max_normal_deg)):
        return start, 0.0
    return up, float((np.abs(normals @ up) > agree).mean())


def _floor_height(points: np.ndarray, normals: np.ndarray, up: np.ndarray) -> float | None:
    """Height of the lowest large surface that faces up."""
    facing = normals @ up > np.cos(np.radians(2 * UprightSearchTuning.max_normal_deg))
    if facing.sum() < 50:
        return None
    heights = points[facing] @ up
    first = np.floor(heights.min() / UprightSearchTuning.bin_m)
    counts = np.bincount((np.floor(heights / UprightSearchTuning.bin_m) - first).astype(np.int64))
    # A plane that is not exactly level or noisy spreads over neighbouring bins.
    spread = np.convolve(counts, np.ones(5), "same")
    lowest = int(np.argmax(spread >= UprightSearchTuning.floor_share * spread.max()))
    while lowest + 1 < len(spread) and spread[lowest + 1] > spread[lowest]:
        lowest += 1
    middle = (first + lowest + 0.5) * UprightSearchTuning.bin_m
    return float(np.median(heights[np.abs(heights - middle) <= 2.5 * UprightSearchTuning.bin_m]))
