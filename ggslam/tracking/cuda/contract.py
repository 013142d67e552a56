# SPDX-License-Identifier: Apache-2.0
"""The tracking functions of the compiled kernels: structures of cuda/kernels/tracking/contract.cuh, field by field."""

from __future__ import annotations

import ctypes
from ctypes import Structure, c_double, c_float, c_int32, c_int64, c_uint64, c_void_p

from ggslam.cuda.library import CudaLibrary
from ggslam.errors import NativeCoreError
from ggslam.tracking import native


def _pointers(*names: str) -> list:
    return [(name, c_void_p) for name in names]


class PointArrays(Structure):
    """Mirror of struct PointArrays."""

    _fields_ = _pointers("header", "points", "normals", "covariances", "pixels", "weights")


class DepthPointsJob(Structure):
    """Mirror of struct DepthPointsJob."""

    _fields_ = [
        *_pointers("depth"), ("out", PointArrays), *_pointers("workspace", "stream"),
        ("settings", native.DepthPointsSettings), ("device", c_int32), ("columns", c_int32), ("rows", c_int32),
    ]  # fmt: skip


class VoxelLevel(Structure):
    """Mirror of struct VoxelLevel."""

    _fields_ = [*_pointers("voxels", "slots"), ("slot_mask", c_uint64), ("size", c_float), ("inverse_size", c_float)]


class VoxelLevelJob(Structure):
    """Mirror of struct VoxelLevelJob."""

    _fields_ = [
        *_pointers("blocks", "moments"), ("level", VoxelLevel), *_pointers("voxels", "stream"),
        ("settings", native.TargetSettings), ("device", c_int32), ("block_count", c_int32), ("voxel_count", c_int32),
    ]  # fmt: skip


class AlignJob(Structure):
    """Mirror of struct AlignJob."""

    _fields_ = [
        ("points", PointArrays), ("fine", VoxelLevel), ("coarse", VoxelLevel),
        ("photometric_points", native.PhotometricPoints), ("reference", native.PhotometricReferenceView),
        *_pointers("match", "squared_distance", "results", "workspace", "stream"), ("guess", c_double * 12),
        ("settings", native.AlignSettings), ("device", c_int32), ("room", c_int32),
    ]  # fmt: skip


POSE = slice(0, 12)
INFORMATION = slice(12, 33)
COST, OVERLAP, RMSE, RESIDUAL, SHARE, COARSE_ITERATIONS, FINE_ITERATIONS, CONVERGED, USABLE = range(33, 42)
POINT_COUNT, MEDIAN_DEPTH, SPREAD_TOTAL = range(42, 45)
CENTROID = slice(45, 48)
RADIUS = 48
RESULTS = 49
"""Places of the results of an alignment, as enum AlignResult has them, and their number."""

VOXEL_BYTES, MOMENT_BYTES, BLOCK_BYTES, SLOT_BYTES = 64, 88, 24, 32
HEADER_BYTES = 8


def declare_tracking(library: CudaLibrary) -> None:
    """Tells the C types of the tracking functions.

    Raises:
        NativeCoreError: the compiled kernels do not fit this code.
    """
    for name, mirror in (
        ("depth_points_job", DepthPointsJob), ("voxel_level_job", VoxelLevelJob), ("align_job", AlignJob)
    ):  # fmt: skip
        library.check_size(name, mirror)
    for name in ("depth_points", "voxel_level", "align"):
        library.declare(name, [c_void_p])
    for name in ("depth_points_bytes", "align_bytes"):
        library.declare(name, [c_void_p], c_int64)
    library.declare("align_results", [], ctypes.c_int)
    found = library.functions.ggslam_cuda_align_results()
    if found != RESULTS:
        raise NativeCoreError(f"compiled kernels: an alignment has {found} results, expected {RESULTS}")
