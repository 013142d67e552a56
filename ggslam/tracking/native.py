# SPDX-License-Identifier: Apache-2.0
"""The tracking functions of the compiled core: structures of native/src/tracking/tracking_types.hpp, field by field."""

from __future__ import annotations

import ctypes
from ctypes import POINTER, Structure, c_double, c_float, c_int32, c_int64, c_uint64, c_void_p
from functools import lru_cache

import numpy as np

from ggslam.native.loader import load_library

_float_p, _int_p, _double_p = POINTER(c_float), POINTER(c_int32), POINTER(c_double)


def _fields(kind: object, *names: str) -> list:
    return [(name, kind) for name in names]


class DepthPointsSettings(Structure):
    _fields_ = _fields(
        c_float, "fx", "fy", "cx", "cy", "noise_constant", "noise_square", "min_depth", "max_depth",
        "min_thickness", "max_elongation", "min_neighbours",
    ) + _fields(c_int32, "width", "height", "stride", "window", "window_step")  # fmt: skip


class DepthPointsOutput(Structure):
    _fields_ = _fields(c_void_p, "points", "normals", "covariances", "pixels", "weights")


class TargetInput(Structure):
    _fields_ = _fields(
        c_void_p, "means", "quaternions", "log_scales", "opacity_logits", "birth", "camera_positions"
    ) + _fields(c_int32, "count", "cameras")


class TargetSettings(Structure):
    _fields_ = _fields(
        c_float, "voxel", "min_opacity_logit", "min_thickness", "max_thickness", "max_elongation",
        "scatter_weight", "neighbour_weight",
    )  # fmt: skip


class AlignPoints(Structure):
    _fields_ = _fields(c_void_p, "points", "normals", "covariances", "weights") + _fields(c_int32, "count")


class AlignSettings(Structure):
    _fields_ = (
        _fields(c_double, "translation_tolerance", "rotation_tolerance", "coarse_kernel_factor")
        + _fields(
            c_float, "noise_constant", "noise_square", "kernel_constant", "kernel_sigmas", "overlap_constant",
            "overlap_sigmas", "min_normal_dot", "plane_variance",
        )
        + _fields(c_int32, "coarse_iterations", "fine_iterations", "coarse_points", "min_matches")
        + _fields(c_float, "photometric_weight", "huber", "depth_tolerance")
    )  # fmt: skip


class PhotometricPoints(Structure):
    _fields_ = _fields(c_void_p, "points", "intensity") + _fields(c_int32, "count")


class PhotometricReferenceView(Structure):
    _fields_ = (
        _fields(c_void_p, "pixels")
        + _fields(c_float, "fx", "fy", "cx", "cy")
        + _fields(c_int32, "width", "height")
        + [("rotation", c_float * 9), ("translation", c_float * 3)]
    )


class AlignResult(Structure):
    _fields_ = (
        [("pose", c_double * 16), ("normal_matrix", c_double * 36), ("information", c_double * 36)]
        + _fields(
            c_double, "cost", "overlap", "rmse", "photometric_residual", "photometric_share", "gain", "bias"
        )
        + _fields(c_int32, "coarse_iterations", "fine_iterations", "matches", "inliers", "converged", "usable")
    )  # fmt: skip


@lru_cache(maxsize=1)
def library() -> ctypes.CDLL:
    """The core with the types of the tracking functions declared."""
    core = load_library()
    core.ggslam_depth_points.argtypes = [c_void_p, c_void_p, POINTER(DepthPointsSettings), POINTER(DepthPointsOutput)]
    core.ggslam_gicp_target_create.restype = c_void_p
    core.ggslam_gicp_target_destroy.argtypes = [c_void_p]
    core.ggslam_gicp_target_destroy.restype = None
    for build in (core.ggslam_gicp_target_build, core.ggslam_gicp_target_gather):
        build.argtypes = [c_void_p, c_void_p, c_void_p, POINTER(TargetInput), POINTER(TargetSettings)]
        build.restype = None
    core.ggslam_gicp_target_finish.argtypes = [c_void_p, c_void_p, POINTER(TargetSettings)]
    core.ggslam_gicp_target_finish.restype = None
    core.ggslam_gicp_target_moments.argtypes = [c_void_p, ctypes.c_int, c_void_p]
    core.ggslam_gicp_target_moments.restype = None
    core.ggslam_gicp_target_size.argtypes = [c_void_p, ctypes.c_int]
    core.ggslam_gicp_target_voxels.argtypes = [c_void_p, ctypes.c_int, c_void_p]
    core.ggslam_gicp_target_voxels.restype = None
    core.ggslam_gicp_target_blocks.argtypes = [c_void_p, ctypes.c_int, c_void_p]
    core.ggslam_target_part_create.argtypes = [c_void_p, POINTER(TargetInput), POINTER(TargetSettings), c_uint64]
    core.ggslam_target_part_create.restype = c_void_p
    core.ggslam_target_part_destroy.argtypes = [c_void_p]
    core.ggslam_target_part_destroy.restype = None
    core.ggslam_target_part_bytes.argtypes = [c_void_p]
    core.ggslam_target_part_bytes.restype = c_int64
    core.ggslam_gicp_target_compose.argtypes = [
        c_void_p, c_void_p, c_void_p, POINTER(c_void_p), ctypes.c_int, POINTER(TargetSettings)
    ]  # fmt: skip
    core.ggslam_gicp_target_compose.restype = None
    core.ggslam_gicp_align.argtypes = [
        c_void_p, c_void_p, POINTER(AlignPoints), POINTER(AlignSettings), POINTER(PhotometricPoints),
        POINTER(PhotometricReferenceView), c_void_p, c_void_p, c_void_p, POINTER(AlignResult),
    ]  # fmt: skip
    core.ggslam_gicp_align.restype = None
    core.ggslam_gicp_linearize.argtypes = [
        c_void_p, c_void_p, POINTER(AlignPoints), POINTER(AlignSettings), ctypes.c_int, c_void_p, c_void_p, c_void_p,
        c_void_p, c_void_p,
    ]  # fmt: skip
    core.ggslam_gicp_linearize.restype = c_double
    return core


def address(array: np.ndarray) -> int:
    """Address of an array's first element; the caller keeps the array alive and contiguous."""
    return array.ctypes.data
