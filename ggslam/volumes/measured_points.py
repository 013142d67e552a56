# SPDX-License-Identifier: Apache-2.0
"""Where a TSDF holds measured points: eighths of voxels, each with a point of a surface in it."""

from __future__ import annotations

import numpy as np

from ggslam.native.loader import load_library
from ggslam.volumes.tsdf import TsdfMap


def measured_octants(tsdf: TsdfMap) -> np.ndarray:
    """Centres of the octants of occupied voxels that points were measured in, float64 [N, 3], metres. An octant reaches
    a quarter of a voxel from its centre along each axis."""
    library = load_library()
    middles = np.empty((int(library.ggslam_tsdf_octants(tsdf.handle, None)), 3))
    library.ggslam_tsdf_octants(tsdf.handle, middles.ctypes.data)
    return middles * tsdf.settings.voxel
