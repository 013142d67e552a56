# SPDX-License-Identifier: Apache-2.0
"""Depth that was subtracted from a constant, as pictures of depth show near things bright: at first sight it is inverse
depth, and inverse depth is what it comes to with a large constant. Walls and floors tell a small one."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ggslam.scene.frame import Frame
from ggslam.sequences.plane_evidence import PlaneTuning, residual_of, windows_of
from ggslam.system.tuning import Tuning


class InversionTuning(Tuning):
    """When depth is taken for a constant minus the distance."""

    percentile = 99.9
    """Percentile of depth that counts as the largest."""
    min_windows = 12
    """Fewest windows that show a plane."""
    max_ratio = 0.88
    """Largest median residual, as a share of that of inverse depth. Depth subtracted from 1.3 times the largest has
    0.75, disparity 0.99."""
    constants = np.geomspace(1.02, 4, 16)
    """Constants that are tried, over the largest stored depth."""


@dataclass(frozen=True)
class Inversion:
    """Depth is `constant` minus what is stored, metres as stored; median relative residuals of planes then, and as
    inverse depth."""

    constant: float
    residual: float
    as_inverse: float


def find_inversion(frames: list[Frame]) -> Inversion | None:
    """The constant that depth was subtracted from; None: inverse depth fits as well, or nothing can be told."""
    known = [frame.depth[frame.depth > 0] for frame in frames]
    if not sum(map(len, known)):
        return None
    constants = InversionTuning.constants * float(np.percentile(np.concatenate(known), InversionTuning.percentile))
    rows = [_residuals(window.depth, window.rays, constants) for frame in frames for window in windows_of(frame)]
    flat = np.array([row for row in rows if min(row) < PlaneTuning.flat])
    if len(flat) < InversionTuning.min_windows:
        return None
    inverse, *others = np.median(flat, axis=0).tolist()
    best = int(np.argmin(others))
    return (
        Inversion(float(constants[best]), others[best], inverse)
        if others[best] < InversionTuning.max_ratio * inverse
        else None
    )


def _residuals(stored: np.ndarray, rays: np.ndarray, constants: np.ndarray) -> list[float]:
    """Of what is stored [n], read as inverse depth and as subtracted from each constant."""
    row = [residual_of(stored, rays)]
    for constant in constants.tolist():
        depth = np.maximum(constant - stored, 1e-3)
        row.append(residual_of(1 / depth, rays) * float(np.median(depth / stored)))  # in shares of what is stored
    return row
