# SPDX-License-Identifier: Apache-2.0
"""Alignments found on the device."""

from __future__ import annotations

from typing import Any

import numpy as np
import torch

from ggslam.tracking.cuda import contract
from ggslam.tracking.gicp import AlignmentResult, judge
from ggslam.tracking.observability import PointSpread, about_point
from ggslam.tracking.settings import AlignSettings

_PLACES = np.zeros((6, 6), np.intp)
"""Where entry (i, j) of a symmetric matrix is in its upper triangle, row by row."""
_PLACES[np.triu_indices(6)] = range(21)
_PLACES += np.triu(_PLACES, 1).T


class CudaAlignment(AlignmentResult):
    """`AlignmentResult` whose matches and distances stay on the device until someone asks for them."""

    _matched: torch.Tensor
    _count: int

    def __getattr__(self, name: str) -> Any:
        """Matches and distances, at the first look at either."""
        if name not in ("matches", "squared_distances"):
            raise AttributeError(name)
        matches, squared = self._matched.cpu().numpy()[:, : self._count]
        object.__setattr__(self, "matches", matches.view(np.int32))
        object.__setattr__(self, "squared_distances", squared)
        return object.__getattribute__(self, name)


def cuda_alignment(found: np.ndarray, matched: torch.Tensor, settings: AlignSettings) -> CudaAlignment:
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
    values = {
        "T_world_camera": T, "status": status, "converged": bool(found[contract.CONVERGED]),
        "iterations": int(found[contract.COARSE_ITERATIONS] + found[contract.FINE_ITERATIONS]),
        "overlap": float(found[contract.OVERLAP]), "rmse": float(found[contract.RMSE]),
        "information": about_point(information, T[:3, 3]), "camera_information": information,
        "visibility": visibility, "weak_directions": weak, "cost": float(found[contract.COST]),
        "photometric_residual": float(found[contract.RESIDUAL]), "photometric_share": float(found[contract.SHARE]),
        "_matched": matched, "_count": int(found[contract.POINT_COUNT]),
    }  # fmt: skip
    result = object.__new__(CudaAlignment)  # the dataclass's own constructor asks for the matches
    for name, value in values.items():
        object.__setattr__(result, name, value)
    return result
