# SPDX-License-Identifier: Apache-2.0
"""True object ids of the Gaussians themselves, from true masks, and how many labels agree with them."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Final

import numpy as np

from ggslam.errors import InputError
from ggslam.evaluation.segmentation import Matching
from ggslam.scene.camera import Camera
from ggslam.system.tuning import Tuning


class LabelTuning(Tuning):
    """When a pixel sees a Gaussian."""

    tolerance_m = 0.02
    """Largest difference between the depth of its centre and the measured one, in metres."""
    tolerance_share = 0.02
    """The same as a share of the depth."""
    keys_at_once = 1 << 22
    """Votes that are gathered before they are counted."""


_IDS: Final = 1 << 16
"""Number of instance ids: they have 16 bits."""


@dataclass(frozen=True)
class GaussianLabelScores:
    """How the labels of Gaussians agree with true masks. NaN if none has a true label.

    Attributes:
        accuracy: share of the Gaussians with a true label whose label is right; unlabelled ones are wrong.
        accuracy_by_opacity: the same with each Gaussian counted by its opacity.
        labelled: Gaussians with a true label.
        gaussians: all.
    """

    accuracy: float
    accuracy_by_opacity: float
    labelled: int
    gaussians: int


class GaussianTruth:
    """Collects the true label of each Gaussian's centre: the id that most true masks show where the centre falls and
    the measured depth says that it is seen.

    Args:
        count: Gaussians there are.
    """

    def __init__(self, count: int) -> None:
        self._count = count
        self._keys = np.zeros(0, np.int64)
        self._counts = np.zeros(0, np.int64)
        self._new: list[np.ndarray] = []

    def add(
        self, camera: Camera, T_camera_world: np.ndarray, depth: np.ndarray, truth: np.ndarray, means: np.ndarray,
        numbers: np.ndarray,
    ) -> None:  # fmt: skip
        """Takes one view in.

        Args:
            camera: of the images.
            T_camera_world: [4, 4].
            depth: measured, float32 [H, W] metres, 0 = none.
            truth: true ids uint16 [H, W], 0 = unlabelled.
            means: float32 [M, 3], world frame, of all Gaussians that the camera may see.
            numbers: which Gaussians they are, int64 [M].

        Raises:
            InputError: images of another size than the camera's.
        """
        size = (camera.height, camera.width)
        if depth.shape != size or truth.shape != size:
            raise InputError(f"expected images of {size}, found depth {depth.shape}, truth {truth.shape}")
        T = T_camera_world.astype(np.float32)
        x, y, z = T[:3, :3] @ np.ascontiguousarray(means.T) + T[:3, 3:]
        # Bounds without a division, so that only Gaussians in the image are divided and rounded.
        u, v = camera.fx * x + (camera.cx + 0.5) * z, camera.fy * y + (camera.cy + 0.5) * z
        rows = np.flatnonzero((z > 0.01) & (u >= 0) & (v >= 0) & (u < camera.width * z) & (v < camera.height * z))
        z = z[rows]
        # Rounding may lift a quotient to the width itself.
        column = np.minimum((u[rows] / z).astype(np.int64), camera.width - 1)
        line = np.minimum((v[rows] / z).astype(np.int64), camera.height - 1)
        pixel = line * camera.width + column
        measured, ids = depth.reshape(-1)[pixel], truth.reshape(-1)[pixel]
        tolerance = np.maximum(LabelTuning.tolerance_m, LabelTuning.tolerance_share * measured)
        seen = (measured > 0) & (np.abs(z - measured) <= tolerance) & (ids > 0)
        self._new.append(numbers[rows[seen]] * _IDS + ids[seen])
        if sum(map(len, self._new)) > LabelTuning.keys_at_once:
            self._gather()

    def labels(self) -> np.ndarray:
        """uint16 [N]: the most frequent true id of each Gaussian (the lowest of equals), 0 where none was seen."""
        self._gather()
        out = np.zeros(self._count, np.uint16)
        order = np.lexsort((-self._keys, self._counts))  # the last one written wins
        out[self._keys[order] // _IDS] = self._keys[order] % _IDS
        return out

    def scores(self, labels: np.ndarray, opacities: np.ndarray, matching: Matching) -> GaussianLabelScores:
        """Compares labels (integers [N], 0 = unlabelled) with the true ones.

        Args:
            labels: of the Gaussians.
            opacities: float [N], their weights in `accuracy_by_opacity`.
            matching: which label stands for which true id.
        """
        truth = self.labels()
        wanted = np.full(_IDS, -1, np.int64)
        wanted[list(matching.predicted)] = list(matching.predicted.values())
        known = truth > 0
        right = labels[known] == wanted[truth[known]]
        weights = opacities[known].astype(np.float64)
        return GaussianLabelScores(
            accuracy=float(right.mean()) if known.any() else math.nan,
            accuracy_by_opacity=float((right * weights).sum() / weights.sum()) if known.any() else math.nan,
            labelled=int(known.sum()), gaussians=len(truth),
        )  # fmt: skip

    def _gather(self) -> None:
        keys = np.concatenate([self._keys, *self._new])
        weights = np.concatenate([self._counts, *(np.ones(len(new), np.int64) for new in self._new)])
        self._new = []
        self._keys, place = np.unique(keys, return_inverse=True)
        self._counts = np.bincount(place, weights, minlength=len(self._keys)).astype(np.int64)
