# SPDX-License-Identifier: Apache-2.0
"""What walls, floors and tables say of depth: over the image of a plane 1/z changes linearly. So does what is stored if
depth is inverse, and 1/d times the length of the ray if d was measured along it."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ggslam.scene.frame import Frame
from ggslam.sequences.depth_kind import Measure

MEASURES: tuple[Measure, ...] = ("z", "ray", "inverse")
COLUMNS = 96
"""Of the images that are looked at, about."""
WINDOW = 3
"""Windows are so many times smaller than the image, and overlap by half."""
SMALLEST = 4
"""Rows or columns of a window."""
FULL = 0.7
"""Share of a window's pixels that must have depth."""
FLAT = 0.01
"""Median relative residual up to which a window shows a plane, read in one way at least."""
FEWEST_WINDOWS, FEWEST_FRAMES, FEWEST_PLACES = 12, 4, 6
MOST, LEAST_RATIO = 0.67, 0.75
"""Share of the windows in which a reading has to be the flattest, and by which factor in their median."""


@dataclass(frozen=True)
class PlaneEvidence:
    """How flat planes are with depth read in each way of `MEASURES`.

    Attributes:
        windows: places that show a plane; frames: how many they are in.
        residuals: medians over the windows of the median relative residuals.
        ratios: medians of the residuals against those as z.
        wins: shares of the windows that each reading makes the flattest.
        places: in the image where planes are seen: neighbouring frames show the same ones.
    """

    windows: int
    frames: int
    residuals: tuple[float, ...]
    ratios: tuple[float, ...]
    wins: tuple[float, ...]
    places: int = 0

    @property
    def measure(self) -> Measure | None:
        """The reading that fits clearly better than all others; None: none does."""
        if self.windows < FEWEST_WINDOWS or self.frames < FEWEST_FRAMES or self.places < FEWEST_PLACES:
            return None
        best = int(np.argmax(self.wins))
        others = [ratio for k, ratio in enumerate(self.ratios) if k != best]
        clear = self.wins[best] >= MOST and self.ratios[best] <= LEAST_RATIO * min(others)
        return MEASURES[best] if clear else None


def look_at_planes(frames: list[Frame]) -> PlaneEvidence:
    """Fits planes to windows of depth images, read in each way."""
    found, frames_used, places = [], 0, set()
    for frame in frames:
        rows = _residuals(frame)
        found += list(rows.values())
        places |= set(rows)
        frames_used += bool(rows)
    if not found:
        return PlaneEvidence(0, 0, (np.nan,) * 3, (np.nan,) * 3, (0.0,) * 3)
    residuals = np.array(found)
    ratios = np.exp(np.median(np.log(residuals / residuals[:, :1]), axis=0))
    wins = np.bincount(residuals.argmin(1), minlength=len(MEASURES)) / len(residuals)
    return PlaneEvidence(
        len(residuals), frames_used, tuple(map(float, np.median(residuals, axis=0))), tuple(map(float, ratios)),
        tuple(map(float, wins)), len(places),
    )  # fmt: skip


def _residuals(frame: Frame) -> dict[tuple[int, int], list[float]]:
    """Of the windows of a frame that show a plane, by place, the median relative residual of each reading."""
    found: dict[tuple[int, int], list[float]] = {}
    for window in windows_of(frame):
        d, rays = window.depth, window.rays
        row = [residual_of(values, rays) for values in (1 / d, np.linalg.norm(rays, axis=1) / d, d)]
        if min(row) < FLAT:
            found[window.place] = row
    return found


@dataclass(frozen=True)
class Window:
    """Pixels with depth of a part of an image: its place (row, column), depth [n], rays [n, 3] with z = 1."""

    place: tuple[int, int]
    depth: np.ndarray
    rays: np.ndarray


def windows_of(frame: Frame) -> list[Window]:
    """Parts of a frame, overlapping by half, that are full of depth."""
    step = max(1, frame.depth.shape[1] // COLUMNS)
    depth = frame.depth[::step, ::step].astype(np.float64)
    rays = frame.camera.rays()[::step, ::step].astype(np.float64)
    height, width = depth.shape[0] // WINDOW, depth.shape[1] // WINDOW
    found: list[Window] = []
    if min(height, width) < SMALLEST:
        return found
    for top in range(0, depth.shape[0] - height + 1, max(1, height // 2)):
        for left in range(0, depth.shape[1] - width + 1, max(1, width // 2)):
            part = np.s_[top : top + height, left : left + width]
            known = depth[part] > 0
            if known.mean() >= FULL:
                found.append(Window((top, left), depth[part][known], rays[part][known]))
    return found


def residual_of(values: np.ndarray, rays: np.ndarray) -> float:
    """Median relative residual of values [n] that should change linearly over the image; rays [n, 3] with z = 1."""
    weights = np.ones(len(values))
    relative = np.zeros(len(values))
    for _ in range(5):
        scaled = rays / values[:, None]
        weighted = scaled.T * weights
        solution = np.linalg.lstsq(weighted @ scaled, weighted.sum(1), rcond=None)[0]
        relative = rays @ solution / values - 1
        spread = 1.48 * float(np.median(np.abs(relative))) + 1e-6
        weights = 1 / (1 + (relative / (2 * spread)) ** 2) ** 2
    return float(np.median(np.abs(relative))) + 1e-6
