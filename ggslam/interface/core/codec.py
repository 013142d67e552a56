# SPDX-License-Identifier: Apache-2.0
# Written by scripts/tools/make_native_mirrors.py from codec.hpp; changes are lost.
"""The compiled core's G-PCC codec (ISO/IEC 23090-9, first edition) and LZF."""

from __future__ import annotations

from ctypes import POINTER, Structure, c_double, c_float, c_int, c_int32, c_int64, c_size_t, c_uint8, c_uint32, c_void_p
from enum import IntEnum
from typing import Any

HEADER = "core/codec.hpp"
HEADER_SHA256 = "2c1c7cbcced73fc9a750c52a8241e7e63a4bd932d0f2f94669e16e7f4f6fbf2e"


class Status(IntEnum):
    """Values of enum Status."""

    OK = 0
    OUT_OF_MEMORY = 1
    TRUNCATED = 2
    COUNT_MISMATCH = 3
    TOO_LARGE = 4


class OctreeSettings(Structure):
    """What octree geometry coding depends on."""

    _fields_ = [
        ("depth", c_int32), ("neighbour_boundary", c_int32), ("adjacent_child", c_int32), ("intra_prediction", c_int32),
        ("unique_points", c_int32),
    ]


class TreeSettings(Structure):
    """What geometry coding in general depends on: trees whose nodes are not split along every axis (QTBT), planes,
    points that are coded directly, scaled positions, several codewords."""

    _fields_ = [
        ("levels", c_int32), ("neighbour_boundary", c_int32), ("adjacent_child", c_int32),
        ("intra_prediction", c_int32), ("unique_points", c_int32), ("direct_mode", c_int32), ("direct_pairs", c_int32),
        ("direct_rate", c_int32), ("planes", c_int32), ("plane_thresholds", c_int32 * 3), ("scaling", c_int32),
        ("slice_qp", c_int32), ("direct_qp", c_int32), ("qp_shift", c_int32), ("codewords", c_int32),
        ("separate_bits", c_int32), ("axes", c_uint8 * 64),
    ]


class PredictiveSettings(Structure):
    """What predictive geometry depends on."""

    _fields_ = [
        ("unique_points", c_int32), ("scaling", c_int32), ("slice_qp", c_int32), ("qp_shift", c_int32),
        ("qp_interval", c_int32), ("residual_bits", c_int32 * 3), ("separate_bits", c_int32),
    ]


class RahtSettings(Structure):
    """What an attribute's coding by the region-adaptive hierarchical transform depends on."""

    _fields_ = [
        ("components", c_int32), ("bit_depth", c_int32), ("qp", c_int32), ("qp_secondary", c_int32),
        ("prediction", c_int32), ("min_parent_neighbours", c_int32), ("min_neighbours", c_int32), ("layers", c_int32),
        ("layer_qps", c_int32 * 2 * 32), ("separate_bits", c_int32), ("index", c_int32), ("first_version", c_int32),
        ("rdoq", c_float),
    ]


class DetailSettings(Structure):
    """What an attribute's coding by the predicting and the lifting transform depends on."""

    _fields_ = [
        ("components", c_int32), ("bit_depth", c_int32), ("lifting", c_int32), ("neighbours", c_int32),
        ("search_between", c_int32), ("bias", c_int32 * 3), ("levels", c_int32), ("canonical_order", c_int32),
        ("decimation", c_int32), ("periods", c_int32 * 32), ("first_distance", c_int32), ("direct_predictors", c_int32),
        ("direct_threshold", c_int32), ("no_average", c_int32), ("search_within", c_int32), ("skip_layers", c_int32),
        ("blend", c_int32), ("weighted", c_int32), ("component_weights", c_int32 * 2 * 32), ("layers", c_int32),
        ("layer_qps", c_int32 * 2 * 32), ("separate_bits", c_int32), ("index", c_int32),
    ]


class Grid(Structure):
    """clip(floor(scale p + rounding), first, last) - first."""

    _fields_ = [
        ("scale", c_double), ("rounding", c_double), ("first", c_int64 * 3), ("last", c_int64 * 3), ("exact", c_int32),
    ]


class Points(Structure):
    """Points [*, 3] of which `rows` [count] are meant; without rows, the first `count`."""

    _fields_ = [("data", c_void_p), ("rows", c_void_p), ("count", c_size_t), ("kind", c_int32)]


STRUCTURES: tuple[type[Structure], ...] = (
    OctreeSettings, TreeSettings, PredictiveSettings, RahtSettings, DetailSettings, Grid, Points,
)
FUNCTIONS: dict[str, tuple[Any, list[Any]]] = {
    "ggslam_gpcc_slice_create": (c_void_p, []),
    "ggslam_gpcc_slice_destroy": (c_int, [c_void_p]),
    "ggslam_gpcc_build": (c_int64, [c_void_p, c_void_p, c_void_p, c_uint32, c_int32, c_void_p]),
    "ggslam_gpcc_leaves": (c_uint32, [c_void_p]),
    "ggslam_gpcc_nodes": (c_uint32, [c_void_p, c_int32]),
    "ggslam_gpcc_leaf_points": (c_int, [c_void_p, c_void_p]),
    "ggslam_gpcc_merge": (c_int64, [c_void_p]),
    "ggslam_gpcc_encode_geometry": (c_int64, [c_void_p, c_void_p, POINTER(OctreeSettings)]),
    "ggslam_gpcc_encode_attribute": (c_int64, [c_void_p, c_void_p, POINTER(RahtSettings), c_void_p]),
    "ggslam_gpcc_take": (c_int, [c_void_p, c_void_p]),
    "ggslam_gpcc_decode_geometry": (c_int64, [
        c_void_p, c_void_p, POINTER(OctreeSettings), c_void_p, c_size_t, c_uint32,
    ]),
    "ggslam_gpcc_decode_tree": (c_int64, [
        c_void_p, c_void_p, POINTER(TreeSettings), c_int32, c_void_p, c_size_t, c_uint32,
    ]),
    "ggslam_gpcc_decode_predictive": (c_int64, [
        c_void_p, c_void_p, POINTER(PredictiveSettings), c_int32, c_void_p, c_size_t, c_uint32,
    ]),
    "ggslam_gpcc_encode_tree": (c_int64, [c_void_p, c_void_p, POINTER(TreeSettings)]),
    "ggslam_gpcc_go_on": (c_int64, [c_void_p, c_void_p]),
    "ggslam_gpcc_positions": (c_int64, [c_void_p, c_void_p, c_void_p]),
    "ggslam_gpcc_decode_attribute": (c_int64, [
        c_void_p, c_void_p, POINTER(RahtSettings), c_void_p, c_size_t, c_void_p,
    ]),
    "ggslam_gpcc_decode_details": (c_int64, [
        c_void_p, c_void_p, POINTER(DetailSettings), c_void_p, c_size_t, c_void_p,
    ]),
    "ggslam_gpcc_sort_values": (c_int64, [c_void_p, c_int32, c_void_p]),
    "ggslam_gpcc_to_ycbcr": (c_int, [c_void_p, c_void_p, c_uint32, c_void_p, c_uint32, c_void_p]),
    "ggslam_gpcc_from_ycbcr": (c_int, [c_void_p, c_void_p, c_uint32, c_void_p]),
    "ggslam_gpcc_on_grid": (c_int, [POINTER(Points), POINTER(Grid), c_void_p]),
    "ggslam_gpcc_along_axis": (c_int, [POINTER(Points), POINTER(Grid), c_int32, c_void_p]),
    "ggslam_gpcc_plane_counts": (c_int, [POINTER(Points), POINTER(Grid), c_int32, c_void_p]),
    "ggslam_gpcc_number_planes": (c_int, [
        POINTER(Points), POINTER(Grid), c_int32, c_void_p, c_void_p, c_void_p, c_void_p,
    ]),
    "ggslam_gpcc_sample_cubes": (c_int64, [POINTER(Points), POINTER(Grid), c_int32, c_uint32, c_uint32, c_void_p]),
    "ggslam_lzf_compress": (c_int64, [c_void_p, c_int64, c_void_p, c_int64]),
    "ggslam_lzf_decompress": (c_int64, [c_void_p, c_int64, c_void_p, c_int64]),
}
"""Result and arguments of each."""
