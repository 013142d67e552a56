# SPDX-License-Identifier: Apache-2.0
# Written by scripts/tools/make_native_mirrors.py from sight.hpp; changes are lost.
"""What a view's depth says of other places: it looks through them, shows them, or has something before them."""

from __future__ import annotations

from ctypes import POINTER, Structure, c_double, c_float, c_int, c_int32, c_int64, c_void_p
from enum import IntEnum
from typing import Any

HEADER = "core/sight.hpp"
HEADER_SHA256 = "91876932df3af81065e77a804b097189ffe5c5f37c173422020a0b6474e9f293"


class SightCode(IntEnum):
    """Values of enum SightCode."""

    OUTSIDE = 0
    UNKNOWN = 1
    THROUGH = 2
    BEFORE = 3
    SAME = 4
    BEHIND = 5
    HIDDEN = 6


class SightMargin(Structure):
    """How far depths z of one surface may differ: max(least, share * z) + sigmas * (constant + square * z^2),
    metres."""

    _fields_ = [
        ("least", c_double), ("share", c_double), ("sigmas", c_double), ("constant", c_double), ("square", c_double),
    ]


class SightJob(Structure):
    """A view, and the points that it is asked about."""

    _fields_ = [
        ("depth", c_void_p), ("near", c_void_p), ("far", c_void_p), ("height", c_int32), ("width", c_int32),
        ("fx", c_double), ("fy", c_double), ("cx", c_double), ("cy", c_double), ("T_camera_world", c_double * 12),
        ("margin", SightMargin), ("points", c_void_p), ("depths", c_void_p), ("count", c_int64), ("codes", c_void_p),
        ("pixels", c_void_p), ("z", c_void_p),
    ]


class DepthPlacesJob(Structure):
    """What a depth image [height, width] has about places `factor` pixels apart. Place (i, j) stands for the pixels
    [i factor, (i + 1) factor) x [j factor, (j + 1) factor); h = height / factor, w = width / factor."""

    _fields_ = [
        ("depth", c_void_p), ("height", c_int32), ("width", c_int32), ("factor", c_int32), ("reach", c_int32),
        ("nearest", c_void_p), ("farthest", c_void_p), ("least", c_void_p), ("count", c_void_p), ("total", c_void_p),
        ("squares", c_void_p),
    ]


class PlacesView(Structure):
    """A view's places, as `DepthPlacesJob` has them: [height, width] each."""

    _fields_ = [
        ("depth", c_void_p), ("near", c_void_p), ("far", c_void_p), ("whole", c_void_p), ("smooth", c_void_p),
        ("height", c_int32), ("width", c_int32), ("fx", c_float), ("fy", c_float), ("cx", c_float), ("cy", c_float),
    ]


class OtherPlacesView(Structure):
    """Another view of the same world."""

    _fields_ = [("places", PlacesView), ("T_this_view", c_float * 12)]


class PlacesEvidenceJob(Structure):
    """What other views say of the places of a view."""

    _fields_ = [
        ("view", PlacesView), ("others", c_void_p), ("count", c_int32), ("moved", c_void_p), ("margin", SightMargin),
        ("rough", c_float), ("least_share", c_float), ("nearest", c_float), ("every", c_int32), ("fewest", c_int32),
        ("found", c_void_p),
    ]


STRUCTURES: tuple[type[Structure], ...] = (
    SightMargin, SightJob, DepthPlacesJob, PlacesView, OtherPlacesView, PlacesEvidenceJob,
)
FUNCTIONS: dict[str, tuple[Any, list[Any]]] = {
    "ggslam_sight": (c_int, [c_void_p, POINTER(SightJob)]),
    "ggslam_depth_places": (c_int, [c_void_p, POINTER(DepthPlacesJob)]),
    "ggslam_places_evidence": (c_int, [c_void_p, POINTER(PlacesEvidenceJob)]),
}
"""Result and arguments of each."""
