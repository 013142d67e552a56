# SPDX-License-Identifier: Apache-2.0
# Written by scripts/make_native_mirrors.py from common.hpp; changes are lost.
"""What all parts of the compiled core share: its version, instruction sets, threads."""

from __future__ import annotations

from ctypes import Structure, c_char_p, c_int, c_void_p
from typing import Any

HEADER = "core/common.hpp"
HEADER_SHA256 = "ea6c5bd9f9c711d43954609297c675ff2b655fd7554b0a2c6b4b799a18b4c3b2"


STRUCTURES: tuple[type[Structure], ...] = ()
FUNCTIONS: dict[str, tuple[Any, list[Any]]] = {
    "ggslam_interface_hash": (c_char_p, []),
    "ggslam_source_hash": (c_char_p, []),
    "ggslam_isa_available": (c_int, [c_int]),
    "ggslam_best_isa": (c_int, []),
    "ggslam_context_create": (c_void_p, [c_int, c_int]),
    "ggslam_context_destroy": (None, [c_void_p]),
}
"""Result and arguments of each."""
