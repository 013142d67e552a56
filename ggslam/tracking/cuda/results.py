# SPDX-License-Identifier: Apache-2.0
"""Alignments found on the device."""

from __future__ import annotations

import numpy as np
import torch

from ggslam.abi.cuda import AlignResult
from ggslam.tracking.gicp import AlignmentResult, PointMatches, judge
from ggslam.tracking.observability import PointSpread, about_point
from ggslam.tracking.settings import AlignSettings

_PLACES = np.zeros((6, 6), np.intp)
"""Where entry (i, j) of a symmetric matrix is in its upper triangle, row by row."""
_PLACES[np.triu_indices(6)] = range(21)
_PLACES += np.triu(_PLACES, 1).T


class CudaMatches:
    """Matches of points that stay on the device until they are read.

    Args:
        matched: float32 [2, room] on the device, bits of the matches and squared distances.
        count: points there are.
    """

    def __init__(self, matched: torch.Tensor, count: int) -> None:
        self._matched, self._count = matched, count
        self._matches: PointMatches | None = None

    def read(self) -> PointMatches:
        """The matches on the host; the first call waits for the device."""
        if self._matches is None:
            voxels, squared = self._matched.cpu().numpy()[:, : self._count]
            self._matches = PointMatches(voxels.view(np.int32), squared)
        return self._matches


def cuda_alignment(found: np.ndarray, matched: torch.Tensor, settings: AlignSettings) -> AlignmentResult:
    """An alignment from what the kernels say.

    Args:
        found: float64 [ALIGN_RESULTS], see `AlignResult`.
        matched: float32 [2, room] on the device, bits of the matches and squared distances.
        settings: that it was made with.
    """
    T = np.eye(4)
    T[:3, :3], T[:3, 3] = found[AlignResult.POSE :][:9].reshape(3, 3), found[AlignResult.POSE :][9:12]
    information = found[AlignResult.INFORMATION :][_PLACES]
    centroid = found[AlignResult.CENTROID : AlignResult.RADIUS]
    spread = PointSpread(float(found[AlignResult.SPREAD_TOTAL]), centroid, float(found[AlignResult.RADIUS]))
    usable = bool(found[AlignResult.USABLE])
    status, visibility, weak = judge(information, T[:3, :3], spread, usable, settings.degenerate_below)
    return AlignmentResult(
        T, status, bool(found[AlignResult.CONVERGED]),
        int(found[AlignResult.COARSE_ITERATIONS] + found[AlignResult.FINE_ITERATIONS]),
        float(found[AlignResult.OVERLAP]), float(found[AlignResult.RMSE]), about_point(information, T[:3, 3]),
        information, visibility, weak, CudaMatches(matched, int(found[AlignResult.POINT_COUNT])),
        float(found[AlignResult.COST]), float(found[AlignResult.PHOTOMETRIC_RESIDUAL]),
        float(found[AlignResult.PHOTOMETRIC_SHARE]),
    )  # fmt: skip
