# SPDX-License-Identifier: Apache-2.0
# Written by scripts/tools/make_native_mirrors.py from movers.hpp; changes are lost.
"""The compiled core's comparison of depth images, by which movers are found."""

from __future__ import annotations

from ctypes import POINTER, Structure, c_float, c_int, c_int32, c_void_p
from typing import Any

HEADER = "core/movers.hpp"
HEADER_SHA256 = "5f0bfc3e507a4d39d21867f11574ffebb4cbb5de20afb387ee22f4179636f225"


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
        ("view", PlacesView), ("others", c_void_p), ("count", c_int32), ("moved", c_void_p), ("margin_least", c_float),
        ("margin_sigmas", c_float), ("noise_constant", c_float), ("noise_square", c_float), ("rough", c_float),
        ("least_share", c_float), ("nearest", c_float), ("every", c_int32), ("fewest", c_int32), ("found", c_void_p),
    ]


STRUCTURES: tuple[type[Structure], ...] = (DepthPlacesJob, PlacesView, OtherPlacesView, PlacesEvidenceJob)
FUNCTIONS: dict[str, tuple[Any, list[Any]]] = {
    "ggslam_depth_places": (c_int, [c_void_p, POINTER(DepthPlacesJob)]),
    "ggslam_places_evidence": (c_int, [c_void_p, POINTER(PlacesEvidenceJob)]),
}
"""Result and arguments of each."""
