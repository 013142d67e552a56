# SPDX-License-Identifier: Apache-2.0
"""Alignments found on the device."""

from __future__ import annotations

import numpy as np

from ggslam.abi.cuda import AlignResult
from ggslam.tracking.cuda.blocks import Block
from ggslam.tracking.gicp import AlignmentResult, MatchedMedians, PointMatches, judge
from ggslam.tracking.observability import PointSpread, about_point
from ggslam.tracking.points import PointSource
from ggslam.tracking.settings import AlignSettings

_PLACES = np.zeros((6, 6), np.intp)
"""Where entry (i, j) of a symmetric matrix is in its upper triangle, row by row."""
_PLACES[np.triu_indices(6)] = range(21)
_PLACES += np.triu(_PLACES, 1).T
_STILL = np.eye(4)
_TOTAL = AlignResult.SPREAD_TOTAL
_CENTROID = slice(AlignResult.CENTROID, AlignResult.RADIUS)


def symmetric6(triangle: np.ndarray) -> np.ndarray:
    """The symmetric matrix [6, 6] whose upper triangle the first 21 numbers are, row by row."""
    return triangle[_PLACES]


class CudaMatches:
    """Matches of points that stay on the device until they are read.

    Args:
        matched: bits of the matches and squared distances, [2, room].
        room: points at most.
        count: points there are.
        medians: what the kernels told of them; None: they were not asked.
    """

    def __init__(self, matched: Block, room: int, count: int, medians: MatchedMedians | None) -> None:
        self._matched, self._room, self._count, self._medians = matched, room, count, medians
        self._matches: PointMatches | None = None

    def read(self) -> PointMatches:
        """The matches on the host; the first call waits for the device."""
        if self._matches is None:
            found = self._matched.memory[: 2 * self._room].cpu().numpy().reshape(2, -1)
            voxels, squared = found[:, : self._count].copy()
            self._matches = PointMatches(voxels.view(np.int32), squared)
        return self._matches

    def medians(self, points: PointSource) -> MatchedMedians:
        """See `MatchSource`; waits for the device unless the points expected that look."""
        return self.read().medians(points) if self._medians is None else self._medians


def cuda_alignment(
    found: np.ndarray, matched: Block, room: int, looks: bool, settings: AlignSettings
) -> AlignmentResult:
    """An alignment from what the kernels say.

    Args:
        found: float64 [ALIGN_RESULTS], see `AlignResult`.
        matched: see `CudaMatches`.
        room: points at most.
        looks: whether the kernels told the medians of the matched points.
        settings: that it was made with.
    """
    T = _STILL.copy()
    T[:3, :3], T[:3, 3] = found[:9].reshape(3, 3), found[9:12]
    information = symmetric6(found[AlignResult.INFORMATION :])
    value = found.tolist()
    spread = PointSpread(value[_TOTAL], found[_CENTROID], value[AlignResult.RADIUS])
    usable = value[AlignResult.USABLE] != 0
    status, visibility, weak = judge(information, T[:3, :3], spread, usable, settings.degenerate_below)
    medians = None
    if looks:
        medians = MatchedMedians(
            int(value[AlignResult.MATCHED]), value[AlignResult.MEDIAN_SQUARED], value[AlignResult.MATCHED_DEPTH]
        )
    return AlignmentResult(
        T, status, value[AlignResult.CONVERGED] != 0,
        int(value[AlignResult.COARSE_ITERATIONS] + value[AlignResult.FINE_ITERATIONS]),
        value[AlignResult.OVERLAP], value[AlignResult.RMSE], about_point(information, T[:3, 3]),
        information, visibility, weak, CudaMatches(matched, room, int(value[AlignResult.POINT_COUNT]), medians),
        value[AlignResult.COST], value[AlignResult.PHOTOMETRIC_RESIDUAL], value[AlignResult.PHOTOMETRIC_SHARE],
    )  # fmt: skip
