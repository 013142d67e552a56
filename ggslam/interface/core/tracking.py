# SPDX-License-Identifier: Apache-2.0
# Written by scripts/tools/make_native_mirrors.py from tracking.hpp; changes are lost.
"""The compiled core's tracking: points of a depth image, the voxels they are aligned to, alignment."""

from __future__ import annotations

from ctypes import POINTER, Structure, c_double, c_float, c_int, c_int32, c_int64, c_uint64, c_void_p
from typing import Any

HEADER = "core/tracking.hpp"
HEADER_SHA256 = "320c2a5b729dfe7de799b815a71f2b6b5eb2e3654dd22af498ae740ea56e1f5b"


class DepthPointsSettings(Structure):
    """How points are taken from a depth image."""

    _fields_ = [
        ("fx", c_float), ("fy", c_float), ("cx", c_float), ("cy", c_float), ("noise_constant", c_float),
        ("noise_square", c_float), ("min_depth", c_float), ("max_depth", c_float), ("min_thickness", c_float),
        ("max_elongation", c_float), ("min_neighbours", c_float), ("max_weight", c_float), ("width", c_int32),
        ("height", c_int32), ("stride", c_int32), ("window", c_int32), ("window_step", c_int32),
    ]


class DepthPointsOutput(Structure):
    """Points to write."""

    _fields_ = [
        ("points", c_void_p), ("normals", c_void_p), ("covariances", c_void_p), ("pixels", c_void_p),
        ("weights", c_void_p),
    ]


class TargetInput(Structure):
    """Gaussians of a map."""

    _fields_ = [
        ("means", c_void_p), ("quaternions", c_void_p), ("log_scales", c_void_p), ("opacity_logits", c_void_p),
        ("birth", c_void_p), ("camera_positions", c_void_p), ("count", c_int32), ("cameras", c_int32),
    ]


class TargetSettings(Structure):
    """How Gaussians are gathered in voxels."""

    _fields_ = [
        ("voxel", c_float), ("min_opacity_logit", c_float), ("min_thickness", c_float), ("max_thickness", c_float),
        ("max_elongation", c_float), ("scatter_weight", c_float), ("neighbour_weight", c_float),
    ]


class VoxelMoments(Structure):
    """Sums over the members of a voxel."""

    _fields_ = [
        ("weight", c_float), ("offset", c_float * 3), ("outer", c_float * 6), ("own", c_float * 6),
        ("normal", c_float * 3), ("centre", c_float * 3),
    ]


class Voxel(Structure):
    """A voxel of a target."""

    _fields_ = [
        ("mean", c_float * 3), ("weight", c_float), ("normal", c_float * 3), ("reserved", c_float),
        ("covariance", c_float * 6), ("padding", c_float * 2),
    ]


class AlignSettings(Structure):
    """How points are aligned to voxels."""

    _fields_ = [
        ("translation_tolerance", c_double), ("rotation_tolerance", c_double), ("coarse_kernel_factor", c_double),
        ("noise_constant", c_float), ("noise_square", c_float), ("kernel_constant", c_float),
        ("kernel_sigmas", c_float), ("overlap_constant", c_float), ("overlap_sigmas", c_float),
        ("min_normal_dot", c_float), ("plane_variance", c_float), ("coarse_iterations", c_int32),
        ("fine_iterations", c_int32), ("coarse_points", c_int32), ("min_matches", c_int32),
        ("photometric_weight", c_float), ("huber", c_float), ("depth_tolerance", c_float),
    ]


class AlignPoints(Structure):
    """The points of a frame, as DepthPointsOutput has them."""

    _fields_ = [
        ("points", c_void_p), ("normals", c_void_p), ("covariances", c_void_p), ("weights", c_void_p),
        ("depths", c_void_p), ("count", c_int32),
    ]


class PhotometricPoints(Structure):
    """Points whose grey is compared."""

    _fields_ = [("points", c_void_p), ("intensity", c_void_p), ("count", c_int32)]


class PhotometricReferenceView(Structure):
    """What their grey is compared with."""

    _fields_ = [
        ("pixels", c_void_p), ("fx", c_float), ("fy", c_float), ("cx", c_float), ("cy", c_float), ("width", c_int32),
        ("height", c_int32), ("rotation", c_float * 9), ("translation", c_float * 3),
    ]


class AlignResult(Structure):
    """What an alignment found."""

    _fields_ = [
        ("pose", c_double * 16), ("normal_matrix", c_double * 36), ("information", c_double * 36), ("cost", c_double),
        ("overlap", c_double), ("rmse", c_double), ("photometric_residual", c_double), ("photometric_share", c_double),
        ("gain", c_double), ("bias", c_double), ("coarse_iterations", c_int32), ("fine_iterations", c_int32),
        ("matches", c_int32), ("inliers", c_int32), ("converged", c_int32), ("usable", c_int32),
    ]


STRUCTURES: tuple[type[Structure], ...] = (
    DepthPointsSettings, DepthPointsOutput, TargetInput, TargetSettings, VoxelMoments, Voxel, AlignSettings,
    AlignPoints, PhotometricPoints, PhotometricReferenceView, AlignResult,
)
FUNCTIONS: dict[str, tuple[Any, list[Any]]] = {
    "ggslam_depth_points": (c_int, [c_void_p, c_void_p, POINTER(DepthPointsSettings), POINTER(DepthPointsOutput)]),
    "ggslam_gicp_target_create": (c_void_p, []),
    "ggslam_gicp_target_destroy": (c_int, [c_void_p]),
    "ggslam_gicp_target_build": (c_int, [c_void_p, c_void_p, c_void_p, POINTER(TargetInput), POINTER(TargetSettings)]),
    "ggslam_gicp_target_build_like": (c_int, [
        c_void_p, c_void_p, c_void_p, POINTER(TargetInput), POINTER(TargetSettings),
    ]),
    "ggslam_gicp_target_gather": (c_int, [c_void_p, c_void_p, c_void_p, POINTER(TargetInput), POINTER(TargetSettings)]),
    "ggslam_gicp_target_finish": (c_int, [c_void_p, c_void_p, POINTER(TargetSettings)]),
    "ggslam_gicp_target_size": (c_int, [c_void_p, c_int]),
    "ggslam_gicp_target_moments": (c_int, [c_void_p, c_int, c_void_p]),
    "ggslam_gicp_target_voxels": (c_int, [c_void_p, c_int, c_void_p]),
    "ggslam_gicp_target_normals": (c_int, [c_void_p, c_void_p, c_int64, c_void_p]),
    "ggslam_gicp_target_blocks": (c_int, [c_void_p, c_int, c_void_p]),
    "ggslam_target_part_create": (c_void_p, [c_void_p, POINTER(TargetInput), POINTER(TargetSettings), c_uint64]),
    "ggslam_target_part_destroy": (c_int, [c_void_p]),
    "ggslam_target_part_bytes": (c_int64, [c_void_p]),
    "ggslam_gicp_target_compose": (c_int, [c_void_p, c_void_p, c_void_p, c_void_p, c_int, POINTER(TargetSettings)]),
    "ggslam_gicp_align": (c_int, [
        c_void_p, c_void_p, POINTER(AlignPoints), POINTER(AlignSettings), POINTER(PhotometricPoints),
        POINTER(PhotometricReferenceView), c_void_p, c_void_p, c_void_p, POINTER(AlignResult),
    ]),
    "ggslam_gicp_linearize": (c_double, [
        c_void_p, c_void_p, POINTER(AlignPoints), POINTER(AlignSettings), c_int, c_void_p, c_void_p, c_void_p, c_void_p,
        c_void_p,
    ]),
}
"""Result and arguments of each."""
