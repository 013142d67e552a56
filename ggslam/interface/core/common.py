# SPDX-License-Identifier: Apache-2.0
# Written by scripts/tools/make_native_mirrors.py from common.hpp; changes are lost.
"""What all parts of the compiled core share: its version, instruction sets, threads."""

from __future__ import annotations

from ctypes import Structure, c_char_p, c_int, c_size_t, c_void_p
from enum import IntEnum
from typing import Any

HEADER = "core/common.hpp"
HEADER_SHA256 = "609ed3e0a856d9b43f7ba26c0f26d99f50f78c6de200163ac7980ecb79dbdd66"


class CoreFault(IntEnum):
    """Values of enum CoreFault."""

    NO_FAULT = 0
    BAD_INPUT = 1
    MEMORY_RAN_OUT = 2
    CORE_FAILED = 3


STRUCTURES: tuple[type[Structure], ...] = ()
FUNCTIONS: dict[str, tuple[Any, list[Any]]] = {
    "ggslam_last_error": (c_int, [c_void_p, c_size_t]),
    "ggslam_interface_hash": (c_char_p, []),
    "ggslam_source_hash": (c_char_p, []),
    "ggslam_isa_available": (c_int, [c_int]),
    "ggslam_best_isa": (c_int, []),
    "ggslam_context_create": (c_void_p, [c_int, c_int]),
    "ggslam_context_destroy": (c_int, [c_void_p]),
}
"""Result and arguments of each."""
