# SPDX-License-Identifier: Apache-2.0
"""The numbers of a map as splat formats want them: checked, quaternions of unit length, turned where y is upwards."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, fields
from pathlib import Path

import numpy as np
import torch

from ggslam.errors import FormatError
from ggslam.scene.gaussian_map import GaussianMap
from ggslam.scene.harmonics import harmonic_rotations

UPRIGHT = np.diag([1.0, -1.0, -1.0])
"""Rotation from x right, y down, z forward to y up, z backwards; its own inverse."""


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
        if self.sh.shape[1] > 1:
            signs = np.diag(harmonic_rotations(UPRIGHT, self.sh.shape[1]))  # it is diagonal, of 1 and -1
            self.sh[:] *= signs.astype(np.float32)[:, None]
