# SPDX-License-Identifier: Apache-2.0
"""What walls, floors and tables say of depth: over the image of a plane 1/z changes linearly. So does what is stored if
depth is inverse, and 1/d times the length of the ray if d was measured along it."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ggslam.scene.frame import Frame
from ggslam.sequences.depth_kind import Measure
from ggslam.system.tuning import Tuning

MEASURES: tuple[Measure, ...] = ("z", "ray", "inverse")


class PlaneTuning(Tuning):
    """When planes tell how depth was measured."""

    columns = 96
    """Columns of the images that are looked at, about."""
    window_share = 3
    """An image is so many times as wide as a window; windows overlap by half."""
    min_side = 4
    """Fewest rows and columns of a window."""
    full = 0.7
    """Smallest share of a window's pixels with depth."""
    flat = 0.01
    """Largest median relative residual of a window that shows a plane, in one reading at least."""
    min_windows = 12
    """Fewest windows that show a plane."""
    min_frames = 4
    """Fewest frames that they are in."""
    min_places = 6
    """Fewest places in the image that they are at."""
    min_wins = 0.67
    """Smallest share of the windows in which a reading is the flattest."""
    max_ratio = 0.75
    """Its largest median residual, as a share of that of the others."""


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
        if (
            self.windows < PlaneTuning.min_windows
            or self.frames < PlaneTuning.min_frames
            or self.places < PlaneTuning.min_places
        ):
            return None
        best = int(np.argmax(self.wins))
        others = [ratio for k, ratio in enumerate(self.ratios) if k != best]
        clear = self.wins[best] >= PlaneTuning.min_wins and self.ratios[best] <= PlaneTuning.max_ratio * min(others)
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
        if min(row) < PlaneTuning.flat:
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
    step = max(1, frame.depth.shape[1] // PlaneTuning.columns)
    depth = frame.depth[::step, ::step].astype(np.float64)
    rays = frame.camera.rays()[::step, ::step].astype(np.float64)
    height, width = depth.shape[0] // PlaneTuning.window_share, depth.shape[1] // PlaneTuning.window_share
    found: list[Window] = []
    if min(height, width) < PlaneTuning.min_side:
        return found
    for top in range(0, depth.shape[0] - height + 1, max(1, height // 2)):
        for left in range(0, depth.shape[1] - width + 1, max(1, width // 2)):
            part = np.s_[top : top + height, left : left + width]
            known = depth[part] > 0
            if known.mean() >= PlaneTuning.full:
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
