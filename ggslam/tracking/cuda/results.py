# SPDX-License-Identifier: Apache-2.0
"""Alignments found on the device."""

from __future__ import annotations

from typing import Any

import numpy as np
import torch

from ggslam.interface.cuda.tracking import AlignResult
from ggslam.tracking.gicp import AlignmentResult, judge
from ggslam.tracking.observability import PointSpread, about_point
from ggslam.tracking.settings import AlignSettings

_PLACES = np.zeros((6, 6), np.intp)
"""Where entry (i, j) of a symmetric matrix is in its upper triangle, row by row."""
_PLACES[np.triu_indices(6)] = range(21)
_PLACES += np.triu(_PLACES, 1).T


class DeviceAlignment(AlignmentResult):
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


def device_alignment(found: np.ndarray, matched: torch.Tensor, settings: AlignSettings) -> DeviceAlignment:
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
    values = {
        "T_world_camera": T, "status": status, "converged": bool(found[AlignResult.CONVERGED]),
        "iterations": int(found[AlignResult.COARSE_ITERATIONS] + found[AlignResult.FINE_ITERATIONS]),
        "overlap": float(found[AlignResult.OVERLAP]), "rmse": float(found[AlignResult.RMSE]),
        "information": about_point(information, T[:3, 3]), "camera_information": information,
        "visibility": visibility, "weak_directions": weak, "cost": float(found[AlignResult.COST]),
        "photometric_residual": float(found[AlignResult.PHOTOMETRIC_RESIDUAL]),
        "photometric_share": float(found[AlignResult.PHOTOMETRIC_SHARE]),
        "_matched": matched, "_count": int(found[AlignResult.POINT_COUNT]),
    }  # fmt: skip
    result = object.__new__(DeviceAlignment)  # the dataclass's own constructor asks for the matches
    for name, value in values.items():
        object.__setattr__(result, name, value)
    return result
