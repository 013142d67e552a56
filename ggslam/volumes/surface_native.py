# SPDX-License-Identifier: Apache-2.0
"""The compiled core's view of a TSDF's surface: mesh and depth rendering (ggslam/native/src/volumes/mesh_api.cpp,
raycast_api.cpp)."""

from __future__ import annotations

import ctypes
import math
from ctypes import POINTER, Structure, c_float, c_int32, c_int64, c_uint16, c_void_p
from functools import lru_cache
from weakref import WeakKeyDictionary

from ggslam.native.loader import load_library
from ggslam.volumes.tsdf import FULL_WEIGHT, TsdfMap


class MeshArrays(Structure):
    _fields_ = [(name, c_void_p) for name in ("vertices", "normals", "colors", "labels", "triangles")]


class RaycastView(Structure):
    _fields_ = (
        [(name, c_float) for name in ("fx", "fy", "cx", "cy", "near", "far")]
        + [("rotation", c_float * 9), ("position", c_float * 3)]
        + [(name, c_int32) for name in ("width", "height")]
    )


class SurfaceImages(Structure):
    _fields_ = [(name, c_void_p) for name in ("depth", "normals", "colors", "labels")]


@lru_cache(maxsize=1)
def library() -> ctypes.CDLL:
    """The core with the types of the surface's functions declared."""
    core = load_library()
    core.ggslam_surface_cells_create.restype = c_void_p
    core.ggslam_surface_cells_create.argtypes = [c_void_p, c_void_p, c_uint16]
    core.ggslam_mesher_create.restype = c_void_p
    core.ggslam_mesher_create.argtypes = [c_void_p, c_void_p, POINTER(c_int64)]
    core.ggslam_mesher_write.argtypes = [c_void_p, c_void_p, POINTER(MeshArrays)]
    core.ggslam_raycast.argtypes = [c_void_p, c_void_p, POINTER(RaycastView), POINTER(SurfaceImages)]
    for name in ("surface_cells_destroy", "mesher_destroy"):
        getattr(core, f"ggslam_{name}").argtypes = [c_void_p]
    for name in ("surface_cells_destroy", "mesher_destroy", "mesher_write", "raycast"):
        getattr(core, f"ggslam_{name}").restype = None
    return core


class SurfaceCells:
    """Where the surface of a map runs, as the map is now.

    Args:
        tsdf: the map.
        min_weight: in measurements from 1 m; voxels of less weight, or never seen, count as unknown.
    """

    def __init__(self, tsdf: TsdfMap, min_weight: float) -> None:
        share = min(max(min_weight / tsdf.settings.max_weight, 0), 1)
        self._library = library()
        self.revision = tsdf.revision
        self.min_weight = min_weight
        self.handle: int = self._library.ggslam_surface_cells_create(
            tsdf.context.handle, tsdf.handle, max(1, math.ceil(share * FULL_WEIGHT))
        )

    def __del__(self) -> None:
        if getattr(self, "handle", None) is not None:
            self._library.ggslam_surface_cells_destroy(self.handle)


_latest: WeakKeyDictionary[TsdfMap, SurfaceCells] = WeakKeyDictionary()


def surface_cells(tsdf: TsdfMap, min_weight: float) -> SurfaceCells:
    """Found again only where the map or the weight is another than at the last call."""
    cells = _latest.get(tsdf)
    if cells is None or cells.revision != tsdf.revision or cells.min_weight != min_weight:
        cells = _latest[tsdf] = SurfaceCells(tsdf, min_weight)
    return cells
