# SPDX-License-Identifier: Apache-2.0
"""Real spherical harmonics, in the order and with the signs of 3D Gaussian Splatting, and how they turn."""

from __future__ import annotations

import math
from functools import cache

import numpy as np
import torch

from ggslam.system.tuning import Tuning


class HarmonicsTuning(Tuning):
    """Computation of rotations of spherical harmonics."""

    directions = 64
    """Random directions that the matrices are fitted to."""
    max_rounding = 1e-12
    """Largest distance of an entry from a whole number that it is rounded to."""


def spherical_harmonics(directions: torch.Tensor, count: int) -> torch.Tensor:
    """Real spherical harmonics [..., count] of unit directions [..., 3], count = 1, 4, 9 or 16."""
    x, y, z = directions.unbind(-1)
    pi = math.pi
    basis = [torch.full_like(x, math.sqrt(1 / (4 * pi)))]
    if count >= 4:
        c = math.sqrt(3 / (4 * pi))
        basis += [-c * y, c * z, -c * x]
    if count >= 9:
        c = math.sqrt(15 / (4 * pi))
        zonal = math.sqrt(5 / (16 * pi)) * (2 * z * z - x * x - y * y)
        basis += [c * x * y, -c * y * z, zonal, -c * x * z, c / 2 * (x * x - y * y)]
    if count >= 16:
        a, b = math.sqrt(35 / (32 * pi)), math.sqrt(105 / (4 * pi))
        c, d = math.sqrt(21 / (32 * pi)), math.sqrt(7 / (16 * pi))
        basis += [
            -a * y * (3 * x * x - y * y),
            b * x * y * z,
            -c * y * (4 * z * z - x * x - y * y),
            d * z * (2 * z * z - 3 * x * x - 3 * y * y),
            -c * x * (4 * z * z - x * x - y * y),
            b / 2 * z * (x * x - y * y),
            -a * x * (x * x - 3 * y * y),
        ]
    return torch.stack(basis, -1)


def harmonic_rotations(R_new_old: np.ndarray, count: int) -> np.ndarray:
    """Matrices that turn coefficients with what they colour: seen along R d, the turned has the colour that the
    original had along d.

    Harmonics of a degree turn among themselves, so M = B^+ B', where rows of B are the harmonics of directions that
    span them all, and those of B' are of the same directions turned back. Entries that rounding alone keeps from 0, 1
    and -1 are set to these: turns by 180 degrees about an axis only change signs, exactly.

    Args:
        R_new_old: rotations, float [..., 3, 3].
        count: of coefficients: 1, 4, 9 or 16.

    Returns:
        float64 [..., count, count]; coefficients of one channel, [count], become M @ coefficients.
    """
    directions, inverse = _directions(count)
    back = torch.from_numpy(directions @ np.asarray(R_new_old, np.float64))  # rows d^T R = (R^T d)^T
    matrices = inverse @ spherical_harmonics(back, count).numpy()
    whole = np.rint(matrices)
    return np.where(np.abs(matrices - whole) < HarmonicsTuning.max_rounding, whole, matrices)


@cache
def _directions(count: int) -> tuple[np.ndarray, np.ndarray]:
    """Unit vectors [n, 3], and the pseudo-inverse [count, n] of their harmonics."""
    vectors = np.random.default_rng(0).normal(size=(HarmonicsTuning.directions, 3))
    directions = vectors / np.linalg.norm(vectors, axis=1, keepdims=True)
    return directions, np.linalg.pinv(spherical_harmonics(torch.from_numpy(directions), count).numpy())
