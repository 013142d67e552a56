# SPDX-License-Identifier: Apache-2.0
"""Alignments found on the device."""

from __future__ import annotations

import numpy as np
import torch

from ggslam.tracking.cuda import contract
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
        found: float64 [RESULTS], see `contract`.
        matched: float32 [2, room] on the device, bits of the matches and squared distances.
        settings: that it was made with.
    """
    T = np.eye(4)
    T[:3, :3], T[:3, 3] = found[contract.POSE][:9].reshape(3, 3), found[contract.POSE][9:]
    information = found[contract.INFORMATION][_PLACES]
    spread = PointSpread(float(found[contract.SPREAD_TOTAL]), found[contract.CENTROID], float(found[contract.RADIUS]))
    usable = bool(found[contract.USABLE])
    status, visibility, weak = judge(information, T[:3, :3], spread, usable, settings.degenerate_below)
    return AlignmentResult(
        T, status, bool(found[contract.CONVERGED]),
        int(found[contract.COARSE_ITERATIONS] + found[contract.FINE_ITERATIONS]), float(found[contract.OVERLAP]),
        float(found[contract.RMSE]), about_point(information, T[:3, 3]), information, visibility, weak,
        CudaMatches(matched, int(found[contract.POINT_COUNT])), float(found[contract.COST]),
        float(found[contract.RESIDUAL]), float(found[contract.SHARE]),
    )  # fmt: skip
