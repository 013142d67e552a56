# SPDX-License-Identifier: Apache-2.0
"""The compiled core's distance field (ggslam/native/src/volumes/esdf_api.cpp)."""

from __future__ import annotations

import ctypes
from ctypes import POINTER, Structure, c_double, c_float, c_int64, c_void_p
from functools import lru_cache

from ggslam.native.loader import load_library


class FieldStats(Structure):
    _fields_ = [
        (name, c_int64) for name in ("changed_blocks", "changed_sites", "recomputed_blocks", "blocks", "transformed")
    ] + [(name, c_double) for name in ("sites_ms", "select_ms", "transform_ms")]


@lru_cache(maxsize=1)
def library() -> ctypes.CDLL:
    """The core with the types of the field's functions declared."""
    core = load_library()
    core.ggslam_esdf_create.restype = c_void_p
    core.ggslam_esdf_create.argtypes = [c_void_p, c_float]
    for name in ("size", "bytes"):
        getattr(core, f"ggslam_esdf_{name}").restype = c_int64
        getattr(core, f"ggslam_esdf_{name}").argtypes = [c_void_p]
    core.ggslam_esdf_sites.restype = c_int64
    core.ggslam_esdf_sites.argtypes = 3 * [c_void_p]
    signatures: dict[str, list] = {
        "destroy": [], "clear": [], "update": [c_void_p, POINTER(FieldStats)], "list": [c_void_p],
        "read": [c_int64, c_void_p, c_void_p], "query": [c_void_p, c_int64, *4 * [c_void_p]],
    }  # fmt: skip
    for name, arguments in signatures.items():
        function = getattr(core, f"ggslam_esdf_{name}")
        function.argtypes, function.restype = [c_void_p, *arguments], None
    return core
