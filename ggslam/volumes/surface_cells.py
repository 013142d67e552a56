# SPDX-License-Identifier: Apache-2.0
"""Where the surface of a TSDF runs, found once for mesh and depth rendering."""

from __future__ import annotations

import math
from weakref import WeakKeyDictionary

from ggslam.native.loader import load_library
from ggslam.volumes.tsdf import FULL_WEIGHT, TsdfMap


class SurfaceCells:
    """Where the surface of a map runs, as the map is now.

    Args:
        tsdf: the map.
        min_weight: in measurements from 1 m; voxels of less weight, or never seen, count as unknown.
    """

    def __init__(self, tsdf: TsdfMap, min_weight: float) -> None:
        share = min(max(min_weight / tsdf.settings.max_weight, 0), 1)
        self._library = load_library()
        self.revision = tsdf.revision
        self.min_weight = min_weight
        self.handle: int = self._library.ggslam_surface_cells_create(
            tsdf.context.handle, tsdf.handle, max(1, math.ceil(share * FULL_WEIGHT))
        )

    def __del__(self) -> None:
        if getattr(self, "handle", None) is not None:
            self._library.ggslam_surface_cells_destroy(self.handle)


_latest: WeakKeyDictionary[TsdfMap, SurfaceCells] = WeakKeyDictionary()


def surface_cells(tsdf: TsdfMap, min_weight: float | None = None) -> SurfaceCells:
    """Found again only where the map or the weight is another than at the last call. Without a weight it is that of the
    map's settings."""
    min_weight = tsdf.settings.least_weight if min_weight is None else min_weight
    cells = _latest.get(tsdf)
    if cells is None or cells.revision != tsdf.revision or cells.min_weight != min_weight:
        cells = _latest[tsdf] = SurfaceCells(tsdf, min_weight)
    return cells
