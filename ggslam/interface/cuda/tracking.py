# SPDX-License-Identifier: Apache-2.0
# Written by scripts/tools/make_native_mirrors.py from tracking.hpp; changes are lost.
"""The CUDA kernels' tracking. Pointers lead to device memory. Calls only start work on the caller's stream; those
with a status return 0 or a cudaError_t."""

from __future__ import annotations

from ctypes import POINTER, Structure, c_double, c_float, c_int, c_int32, c_int64, c_uint64, c_void_p
from enum import IntEnum
from typing import Any

from ggslam.interface.core.tracking import (
    AlignSettings,
    DepthPointsSettings,
    PhotometricPoints,
    PhotometricReferenceView,
    TargetSettings,
)

HEADER = "cuda/tracking.hpp"
HEADER_SHA256 = "cd3a699e0b80fdde417cc2056d24938a8159c12cdc498f378759408c07795f86"


class AlignResult(IntEnum):
    """Values of enum AlignResult."""

    POSE = 0
    INFORMATION = 12
    COST = 33
    OVERLAP = 34
    RMSE = 35
    PHOTOMETRIC_RESIDUAL = 36
    PHOTOMETRIC_SHARE = 37
    COARSE_ITERATIONS = 38
    FINE_ITERATIONS = 39
    CONVERGED = 40
    USABLE = 41
    POINT_COUNT = 42
    MEDIAN_DEPTH = 43
    SPREAD_TOTAL = 44
    CENTROID = 45
    RADIUS = 48
    ALIGN_RESULTS = 49


class PointsHeader(Structure):
    """What the device alone knows of a frame's points."""

    _fields_ = [("count", c_int32), ("median_depth", c_float)]


class PointArrays(Structure):
    """The points of a frame, row by row of the image; `count` of the header are in use."""

    _fields_ = [
        ("header", c_void_p), ("points", c_void_p), ("normals", c_void_p), ("covariances", c_void_p),
        ("pixels", c_void_p), ("weights", c_void_p),
    ]


class DepthPointsJob(Structure):
    """Points to take from a depth image."""

    _fields_ = [
        ("depth", c_void_p), ("out", PointArrays), ("workspace", c_void_p), ("stream", c_void_p),
        ("settings", DepthPointsSettings), ("device", c_int32), ("columns", c_int32), ("rows", c_int32),
    ]


class VoxelBlock(Structure):
    """A block of 4 x 4 x 4 voxels, which lie one after the other in the order of their bits x + 4 y + 16 z."""

    _fields_ = [("key", c_uint64), ("occupied", c_uint64), ("first", c_uint64)]


class VoxelSlot(Structure):
    """A place of the hash table with open addressing: all that a look-up reads lies in one sector of memory."""

    _fields_ = [("key", c_uint64), ("occupied", c_uint64), ("first", c_uint64), ("reserved", c_uint64)]


class VoxelLevel(Structure):
    """The voxels of one size, and how they are found."""

    _fields_ = [
        ("voxels", c_void_p), ("slots", c_void_p), ("slot_mask", c_uint64), ("size", c_float),
        ("inverse_size", c_float),
    ]


class VoxelLevelJob(Structure):
    """A level to set up."""

    _fields_ = [
        ("blocks", c_void_p), ("moments", c_void_p), ("level", VoxelLevel), ("voxels", c_void_p), ("stream", c_void_p),
        ("settings", TargetSettings), ("device", c_int32), ("block_count", c_int32), ("voxel_count", c_int32),
    ]


class AlignJob(Structure):
    """Points to align to a target."""

    _fields_ = [
        ("points", PointArrays), ("fine", VoxelLevel), ("coarse", VoxelLevel),
        ("photometric_points", PhotometricPoints), ("reference", PhotometricReferenceView), ("match", c_void_p),
        ("squared_distance", c_void_p), ("results", c_void_p), ("workspace", c_void_p), ("stream", c_void_p),
        ("guess", c_double * 12), ("settings", AlignSettings), ("device", c_int32), ("room", c_int32),
    ]


STRUCTURES: tuple[type[Structure], ...] = (
    PointsHeader, PointArrays, DepthPointsJob, VoxelBlock, VoxelSlot, VoxelLevel, VoxelLevelJob, AlignJob,
)
FUNCTIONS: dict[str, tuple[Any, list[Any]]] = {
    "ggslam_cuda_depth_points_bytes": (c_int64, [POINTER(DepthPointsJob)]),
    "ggslam_cuda_depth_points": (c_int, [POINTER(DepthPointsJob)]),
    "ggslam_cuda_voxel_level": (c_int, [POINTER(VoxelLevelJob)]),
    "ggslam_cuda_align_bytes": (c_int64, [POINTER(AlignJob)]),
    "ggslam_cuda_align": (c_int, [POINTER(AlignJob)]),
}
"""Result and arguments of each."""
