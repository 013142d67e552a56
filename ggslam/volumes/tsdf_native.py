# SPDX-License-Identifier: Apache-2.0
"""The compiled core's block store of the TSDF (ggslam/native/src/volumes/tsdf_api.cpp) and the fusion of views
(tsdf_fusion.hpp): its structures, field by field."""

from __future__ import annotations

import ctypes
from ctypes import POINTER, Structure, c_double, c_float, c_int, c_int32, c_int64, c_uint32, c_void_p
from functools import lru_cache

from ggslam.native.loader import load_library


class VoxelArrays(Structure):
    _fields_ = [(name, c_void_p) for name in ("value", "weight", "label", "color", "votes")]


class FusionSettings(Structure):
    _fields_ = [
        (name, c_float) for name in ("min_depth", "max_depth", "free_share", "edge", "clearing", "max_free_weight")
    ]


class FusionInput(Structure):
    _fields_ = (
        [(name, c_void_p) for name in ("depth", "color", "labels")]
        + [(name, c_int32) for name in ("width", "height")]
        + [(name, c_float) for name in ("fx", "fy", "cx", "cy")]
        + [("rotation", c_double * 9), ("translation", c_double * 3)]
    )


class FusionStats(Structure):
    _fields_ = [(name, c_int64) for name in ("blocks", "updated", "made", "freed")] + [
        (name, c_double) for name in ("prepare_ms", "select_ms", "update_ms")
    ]


@lru_cache(maxsize=1)
def library() -> ctypes.CDLL:
    """The core with the types of the store's functions declared."""
    core = load_library()
    core.ggslam_tsdf_create.restype = c_void_p
    core.ggslam_tsdf_create.argtypes = [c_float, c_float, c_float]
    for name in ("size", "dense", "bytes"):
        getattr(core, f"ggslam_tsdf_{name}").restype = c_int64
        getattr(core, f"ggslam_tsdf_{name}").argtypes = [c_void_p]
    core.ggslam_tsdf_revision.restype = c_uint32
    core.ggslam_tsdf_revision.argtypes = [c_void_p]
    signatures: dict[str, list] = {
        "destroy": [], "clear": [], "freeze": [c_int], "list": 5 * [c_void_p],
        "read": [c_int64, c_void_p, POINTER(VoxelArrays)], "write": [c_int64, c_void_p, POINTER(VoxelArrays)],
        "write_free": [c_int64, c_void_p, c_void_p], "erase": [c_int64, c_void_p],
        "integrate": [c_void_p, POINTER(FusionInput), POINTER(FusionSettings), POINTER(FusionStats)],
    }  # fmt: skip
    for name, arguments in signatures.items():
        function = getattr(core, f"ggslam_tsdf_{name}")
        function.argtypes, function.restype = [c_void_p, *arguments], None
    core.ggslam_tsdf_decay.argtypes = [c_void_p, c_void_p, c_float, c_int, c_int]
    core.ggslam_tsdf_decay.restype = c_int64
    return core
