# SPDX-License-Identifier: Apache-2.0
"""The occupancy functions of the compiled core: structures of ggslam/native/src/volumes/occupancy_api.cpp, field by
field."""

from __future__ import annotations

import ctypes
from ctypes import POINTER, Structure, c_double, c_float, c_int, c_int32, c_int64, c_uint64, c_void_p
from functools import lru_cache

import numpy as np

from ggslam.native.loader import load_library


class InsertSettings(Structure):
    _fields_ = [
        ("max_range", c_double),
        ("origin", c_float * 3),
        ("hit", c_float),
        ("miss", c_float),
        ("minimum", c_float),
        ("maximum", c_float),
        ("quantize", c_int32),
    ]


class InsertResult(Structure):
    _fields_ = [("rays", c_uint64), ("free", c_uint64), ("occupied", c_uint64)]


class DepthImage(Structure):
    _fields_ = [
        ("depth", c_void_p),
        ("width", c_int32),
        ("height", c_int32),
        *[(name, c_float) for name in ("fx", "fy", "cx", "cy", "low", "high")],
        ("T_world_camera", c_float * 12),
    ]


class Summary(Structure):
    _fields_ = [
        *[(name, c_uint64) for name in ("occupied", "free", "blocks", "nodes", "bytes")],
        *[(name, c_int32 * 3) for name in ("known_low", "known_high", "occupied_low", "occupied_high")],
    ]


LEAF = np.dtype([("centre", np.float32, 3), ("size", np.float32), ("log_odds", np.float32)])


@lru_cache(maxsize=1)
def library() -> ctypes.CDLL:
    """The core with the types of the occupancy functions declared."""
    core = load_library()
    settings, result = POINTER(InsertSettings), POINTER(InsertResult)
    core.ggslam_occupancy_create.argtypes = [c_double]
    core.ggslam_occupancy_create.restype = c_void_p
    core.ggslam_occupancy_destroy.argtypes = [c_void_p]
    core.ggslam_occupancy_destroy.restype = None
    core.ggslam_occupancy_insert.argtypes = [c_void_p, c_void_p, c_void_p, c_uint64, settings, result]
    core.ggslam_occupancy_insert_depth.argtypes = [c_void_p, c_void_p, POINTER(DepthImage), settings, result]
    core.ggslam_occupancy_look_up.argtypes = [c_void_p, c_void_p, c_void_p, c_uint64, c_float, c_void_p, c_void_p]
    core.ggslam_occupancy_look_up.restype = None
    core.ggslam_occupancy_summary.argtypes = [c_void_p, c_float, POINTER(Summary)]
    core.ggslam_occupancy_summary.restype = None
    core.ggslam_occupancy_compare.argtypes = [c_void_p, c_void_p, c_float, c_float, POINTER(c_uint64)]
    core.ggslam_occupancy_compare.restype = None
    core.ggslam_occupancy_output.argtypes = [c_void_p]
    core.ggslam_occupancy_output.restype = c_void_p
    core.ggslam_occupancy_leaves.argtypes = [c_void_p, c_float, c_int]
    core.ggslam_occupancy_leaves.restype = c_uint64
    core.ggslam_occupancy_write.argtypes = [c_void_p, c_int, c_float, POINTER(c_uint64)]
    core.ggslam_occupancy_write.restype = c_uint64
    core.ggslam_occupancy_read.argtypes = [
        c_void_p, c_int, c_void_p, c_uint64, c_float, c_float, c_uint64, POINTER(c_uint64),
    ]  # fmt: skip
    core.ggslam_occupancy_scan_keys.argtypes = [c_void_p, c_void_p, c_void_p, c_uint64, settings, result]
    core.ggslam_occupancy_scan_keys.restype = c_int64
    core.ggslam_quantize.argtypes = [c_void_p, c_double, c_void_p, c_uint64, c_void_p, c_void_p]
    core.ggslam_quantize.restype = c_uint64
    return core


def output_bytes(handle: int, size: int) -> bytes:
    """A copy of the `size` bytes that the last call left with the map."""
    return ctypes.string_at(library().ggslam_occupancy_output(handle), size) if size else b""


def contiguous_points(points: np.ndarray) -> np.ndarray:
    """Points as float32 [N, 3], C order.

    Raises:
        ValueError: another shape.
    """
    points = np.ascontiguousarray(points, np.float32)
    if points.ndim != 2 or points.shape[1] != 3:
        raise ValueError(f"points: expected shape [N, 3], found {list(points.shape)}")
    return points
