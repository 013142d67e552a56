# SPDX-License-Identifier: Apache-2.0
"""The numbers of a map as splat formats want them: checked, quaternions of unit length, turned where y is upwards."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, fields
from pathlib import Path
from typing import Final

import numpy as np
import torch

from ggslam.errors import FormatError
from ggslam.scene.gaussian_map import GaussianMap
from ggslam.scene.harmonics import harmonic_rotations
from ggslam.scene.poses import left_multiplication, matrix_to_quaternion
from ggslam.system.tuning import Tuning

UPRIGHT = np.diag([1.0, -1.0, -1.0])
"""Rotation from x right, y down, z forward to y up, z backwards; its own inverse."""


MAX_FLOAT_ID: Final = 2**24
"""Largest object id where ids are stored as float32, which holds whole numbers up to here."""


class SplatTuning(Tuning):
    """Limits on files and poses."""

    max_stretch = 1e-3
    """Largest deviation of a rotation from an orthogonal matrix."""
    max_spare = 1 << 20
    """Gaussians that a file of any size may claim; larger files may claim as many as they have bytes."""


def check_count(count: int, held: int) -> None:
    """Raises ValueError if a file of `held` bytes claims, or repeats, more Gaussians than it can hold."""
    if count > max(SplatTuning.max_spare, held):
        raise ValueError(f"it claims {count:,} Gaussians, which {held:,} bytes cannot hold")


@dataclass(frozen=True)
class SplatColumns:
    """Copies of what a map consists of, float32 but for the ids, in the order of the map.

    Attributes:
        means: [N, 3] metres.
        log_scales: [N, 3] natural logarithm of standard deviations in metres.
        quaternions: [N, 4] wxyz, of unit length.
        logits: [N] of opacities.
        sh: [N, K, 3] spherical harmonics, the base colour first.
        object_id: int32 [N], 0 = none.
    """

    means: np.ndarray
    log_scales: np.ndarray
    quaternions: np.ndarray
    logits: np.ndarray
    sh: np.ndarray
    object_id: np.ndarray

    def __len__(self) -> int:
        return len(self.means)

    @staticmethod
    def of(path: str | Path, gaussians: GaussianMap) -> SplatColumns:
        """Those of a map that is to be written to `path`; raises FormatError for a number that is not finite."""
        unit = torch.nn.functional.normalize(gaussians.quaternions, dim=1)
        tensors = (gaussians.means, gaussians.log_scales, unit, gaussians.opacity_logits, gaussians.sh)
        names = ("position", "size", "quaternion", "opacity", "colour")
        arrays = [values.detach().cpu().numpy().astype(np.float32) for values in tensors]
        for name, values in zip(names, arrays, strict=True):
            bad = ~np.isfinite(values).all(tuple(range(1, values.ndim)))
            if bad.any():
                raise FormatError(f"{path}: the {name} of Gaussian {int(bad.argmax())} is not a finite number")
        means, log_scales, quaternions, logits, sh = arrays
        object_id = gaussians.object_id.cpu().numpy().copy()
        return SplatColumns(means, log_scales, quaternions, logits, sh, object_id)

    @staticmethod
    def join(parts: Sequence[SplatColumns]) -> SplatColumns:
        """Those of maps one after the other, of which there is at least one."""
        return SplatColumns(*(np.concatenate([getattr(part, f.name) for part in parts]) for f in fields(SplatColumns)))

    def take(self, rows: np.ndarray) -> SplatColumns:
        """Those of some rows, int64 [M]."""
        return SplatColumns(*(getattr(self, f.name)[rows] for f in fields(SplatColumns)))

    def turn_upright(self) -> None:
        """Turns everything by 180 degrees about x: from x right, y down, z forward to y up, z backwards, or back."""
        self.means[:, 1:] *= -1
        self.quaternions[:, 2:] *= -1  # D R D with D = diag(1, -1, -1): the same ellipsoid as D R
        self._turn_colors(UPRIGHT)

    def move(self, R: np.ndarray, t: np.ndarray, scale: float = 1.0) -> None:
        """Moves everything, in place: positions become scale R x + t.

        Args:
            R: rotation [3, 3].
            t: [3] metres.
            scale: above 0.
        """
        self.means[:] = scale * (self.means.astype(np.float64) @ R.T) + t
        self.log_scales[:] += np.float32(np.log(scale))
        turn = left_multiplication(matrix_to_quaternion(R))
        self.quaternions[:] = self.quaternions.astype(np.float64) @ turn.T
        self._turn_colors(R)

    def move_by(self, T: np.ndarray) -> None:
        """`move` by a matrix [4, 4]; raises ValueError for one that mirrors, shears or stretches."""
        if np.array_equal(T, np.eye(4)):
            return
        size = float(np.linalg.det(T[:3, :3]))
        if not (np.isfinite(T).all() and size > 0):
            raise ValueError("Gaussians are mirrored or flattened, which is not read")
        scale = float(np.cbrt(size))
        R = T[:3, :3] / scale
        if np.abs(R @ R.T - np.eye(3)).max() > SplatTuning.max_stretch:
            raise ValueError("Gaussians are stretched along one axis, which is not read")
        self.move(R, T[:3, 3], scale)

    def _turn_colors(self, R: np.ndarray) -> None:
        if self.sh.shape[1] > 1:
            turn = harmonic_rotations(R, self.sh.shape[1])
            self.sh[:] = np.einsum("kl,nlc->nkc", turn, self.sh.astype(np.float64))
