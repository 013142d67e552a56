# SPDX-License-Identifier: Apache-2.0
# Written by scripts/tools/make_native_mirrors.py from volumes.hpp; changes are lost.
"""The compiled core's volumes: truncated signed distances, their surface, the distance field, occupancy."""

from __future__ import annotations

from ctypes import (
    POINTER,
    Structure,
    c_double,
    c_float,
    c_int,
    c_int32,
    c_int64,
    c_uint16,
    c_uint32,
    c_uint64,
    c_void_p,
)
from typing import Any

HEADER = "core/volumes.hpp"
HEADER_SHA256 = "a675622d766e51ab50f4db551b8939d9bd773526dac60bb0cb2362f8ab395f68"


class VoxelArrays(Structure):
    """Voxels of blocks as arrays of [blocks, 512] (colour: [blocks, 512, 3]); any may be null."""

    _fields_ = [
        ("value", c_void_p), ("weight", c_void_p), ("label", c_void_p), ("color", c_void_p), ("votes", c_void_p),
        ("hits", c_void_p), ("octants", c_void_p),
    ]


class FusionSettings(Structure):
    """Numbers of the fusion. Distances in metres."""

    _fields_ = [
        ("min_depth", c_float), ("max_depth", c_float), ("free_share", c_float), ("edge", c_float),
        ("clearing", c_float), ("max_free_weight", c_float), ("points", c_int32), ("bounded", c_int32),
        ("low", c_int32 * 3), ("high", c_int32 * 3),
    ]


class FusionInput(Structure):
    """A view to be fused. `color` [H, W, 3] and `labels` [H, W] may be null."""

    _fields_ = [
        ("depth", c_void_p), ("color", c_void_p), ("labels", c_void_p), ("width", c_int32), ("height", c_int32),
        ("fx", c_float), ("fy", c_float), ("cx", c_float), ("cy", c_float), ("rotation", c_double * 9),
        ("translation", c_double * 3),
    ]


class FusionStats(Structure):
    """Blocks that a view touched, and the time of the stages."""

    _fields_ = [
        ("blocks", c_int64), ("updated", c_int64), ("made", c_int64), ("freed", c_int64), ("prepare_ms", c_double),
        ("select_ms", c_double), ("update_ms", c_double),
    ]


class FieldStats(Structure):
    """What an update of the distance field did."""

    _fields_ = [
        ("changed_blocks", c_int64), ("changed_sites", c_int64), ("recomputed_blocks", c_int64), ("blocks", c_int64),
        ("transformed", c_int64), ("sites_ms", c_double), ("select_ms", c_double), ("transform_ms", c_double),
    ]


class MeshArrays(Structure):
    """Vertices [n, 3] in metres, unit normals [n, 3], colours [n, 3], labels [n]; triangles [m, 3]."""

    _fields_ = [
        ("vertices", c_void_p), ("normals", c_void_p), ("colors", c_void_p), ("labels", c_void_p),
        ("triangles", c_void_p),
    ]


class RaycastView(Structure):
    """A camera and its pose."""

    _fields_ = [
        ("fx", c_float), ("fy", c_float), ("cx", c_float), ("cy", c_float), ("near", c_float), ("far", c_float),
        ("rotation", c_float * 9), ("position", c_float * 3), ("width", c_int32), ("height", c_int32),
    ]


class SurfaceImages(Structure):
    """[height, width]: depth along the optical axis in metres, 0 where no surface is seen; unit normals [.., 3] in
    the camera's axes; colours [.., 3]; labels."""

    _fields_ = [("depth", c_void_p), ("normals", c_void_p), ("colors", c_void_p), ("labels", c_void_p)]


class InsertSettings(Structure):
    """How a scan is inserted; log-odds."""

    _fields_ = [
        ("max_range", c_double), ("origin", c_float * 3), ("hit", c_float), ("miss", c_float), ("minimum", c_float),
        ("maximum", c_float), ("quantize", c_int32), ("last_voxel", c_int32),
    ]


class InsertResult(Structure):
    """What a scan saw."""

    _fields_ = [("rays", c_uint64), ("free", c_uint64), ("occupied", c_uint64)]


class DepthImage(Structure):
    """A depth image [height, width]; depths outside [low, high] count as none, but +inf frees space up to `free` (0:
    it counts as none, too)."""

    _fields_ = [
        ("depth", c_void_p), ("width", c_int32), ("height", c_int32), ("fx", c_float), ("fy", c_float), ("cx", c_float),
        ("cy", c_float), ("low", c_float), ("high", c_float), ("free", c_float), ("T_world_camera", c_float * 12),
    ]


class OccupancyLeaf(Structure):
    """A leaf of the pruned octree."""

    _fields_ = [("centre", c_float * 3), ("size", c_float), ("log_odds", c_float)]


class OccupancySummary(Structure):
    """What a map holds."""

    _fields_ = [
        ("occupied", c_uint64), ("free", c_uint64), ("blocks", c_uint64), ("nodes", c_uint64), ("bytes", c_uint64),
        ("known_low", c_int32 * 3), ("known_high", c_int32 * 3), ("occupied_low", c_int32 * 3),
        ("occupied_high", c_int32 * 3),
    ]


STRUCTURES: tuple[type[Structure], ...] = (
    VoxelArrays, FusionSettings, FusionInput, FusionStats, FieldStats, MeshArrays, RaycastView, SurfaceImages,
    InsertSettings, InsertResult, DepthImage, OccupancyLeaf, OccupancySummary,
)
FUNCTIONS: dict[str, tuple[Any, list[Any]]] = {
    "ggslam_tsdf_create": (c_void_p, [c_float, c_float, c_float]),
    "ggslam_tsdf_destroy": (c_int, [c_void_p]),
    "ggslam_tsdf_clear": (c_int, [c_void_p]),
    "ggslam_tsdf_size": (c_int64, [c_void_p]),
    "ggslam_tsdf_dense": (c_int64, [c_void_p]),
    "ggslam_tsdf_bytes": (c_int64, [c_void_p]),
    "ggslam_tsdf_revision": (c_uint32, [c_void_p]),
    "ggslam_tsdf_list": (c_int, [c_void_p, c_void_p, c_void_p, c_void_p, c_void_p, c_void_p]),
    "ggslam_tsdf_read": (c_int, [c_void_p, c_int64, c_void_p, POINTER(VoxelArrays)]),
    "ggslam_tsdf_write": (c_int, [c_void_p, c_int64, c_void_p, POINTER(VoxelArrays)]),
    "ggslam_tsdf_write_free": (c_int, [c_void_p, c_int64, c_void_p, c_void_p]),
    "ggslam_tsdf_erase": (c_int, [c_void_p, c_int64, c_void_p]),
    "ggslam_tsdf_freeze": (c_int, [c_void_p, c_int]),
    "ggslam_tsdf_integrate": (c_int, [
        c_void_p, c_void_p, POINTER(FusionInput), POINTER(FusionSettings), POINTER(FusionStats),
    ]),
    "ggslam_tsdf_decay": (c_int64, [c_void_p, c_void_p, c_float, c_int, c_int]),
    "ggslam_surface_cells_create": (c_void_p, [c_void_p, c_void_p, c_uint16]),
    "ggslam_surface_cells_destroy": (c_int, [c_void_p]),
    "ggslam_mesher_create": (c_void_p, [c_void_p, c_void_p, c_void_p]),
    "ggslam_mesher_write": (c_int, [c_void_p, c_void_p, POINTER(MeshArrays)]),
    "ggslam_mesher_destroy": (c_int, [c_void_p]),
    "ggslam_raycast": (c_int, [c_void_p, c_void_p, POINTER(RaycastView), POINTER(SurfaceImages)]),
    "ggslam_esdf_create": (c_void_p, [c_void_p, c_float]),
    "ggslam_esdf_destroy": (c_int, [c_void_p]),
    "ggslam_esdf_clear": (c_int, [c_void_p]),
    "ggslam_esdf_size": (c_int64, [c_void_p]),
    "ggslam_esdf_bytes": (c_int64, [c_void_p]),
    "ggslam_esdf_update": (c_int, [c_void_p, c_void_p, POINTER(FieldStats)]),
    "ggslam_esdf_list": (c_int, [c_void_p, c_void_p]),
    "ggslam_esdf_read": (c_int, [c_void_p, c_int64, c_void_p, c_void_p]),
    "ggslam_esdf_sites": (c_int64, [c_void_p, c_void_p, c_void_p]),
    "ggslam_esdf_query": (c_int, [c_void_p, c_void_p, c_int64, c_void_p, c_void_p, c_void_p, c_void_p]),
    "ggslam_occupancy_create": (c_void_p, [c_double]),
    "ggslam_occupancy_destroy": (c_int, [c_void_p]),
    "ggslam_occupancy_insert": (c_int, [
        c_void_p, c_void_p, c_void_p, c_uint64, POINTER(InsertSettings), POINTER(InsertResult),
    ]),
    "ggslam_occupancy_insert_depth": (c_int, [
        c_void_p, c_void_p, POINTER(DepthImage), POINTER(InsertSettings), POINTER(InsertResult),
    ]),
    "ggslam_occupancy_look_up": (c_int, [c_void_p, c_void_p, c_void_p, c_uint64, c_float, c_void_p, c_void_p]),
    "ggslam_occupancy_summary": (c_int, [c_void_p, c_float, POINTER(OccupancySummary)]),
    "ggslam_occupancy_compare": (c_int, [c_void_p, c_void_p, c_float, c_float, c_void_p]),
    "ggslam_occupancy_output": (c_void_p, [c_void_p]),
    "ggslam_occupancy_leaves": (c_uint64, [c_void_p, c_float, c_int]),
    "ggslam_occupancy_write": (c_uint64, [c_void_p, c_int, c_float, c_void_p]),
    "ggslam_occupancy_read": (c_int, [c_void_p, c_int, c_void_p, c_uint64, c_float, c_float, c_uint64, c_void_p]),
    "ggslam_occupancy_scan_keys": (c_int64, [
        c_void_p, c_void_p, c_void_p, c_uint64, POINTER(InsertSettings), POINTER(InsertResult),
    ]),
    "ggslam_quantize": (c_uint64, [c_void_p, c_double, c_void_p, c_uint64, c_void_p, c_void_p]),
}
"""Result and arguments of each."""
