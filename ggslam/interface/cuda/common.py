# SPDX-License-Identifier: Apache-2.0
# Written by scripts/tools/make_native_mirrors.py from common.hpp; changes are lost.
"""What all parts of the CUDA kernels share: their version, the text of an error."""

from __future__ import annotations

from ctypes import Structure, c_char_p, c_int
from typing import Any

HEADER = "cuda/common.hpp"
HEADER_SHA256 = "759ab489928b7ebec798c91b6e6cef212543a0b91cca470692548b870186f60f"


STRUCTURES: tuple[type[Structure], ...] = ()
FUNCTIONS: dict[str, tuple[Any, list[Any]]] = {
    "ggslam_cuda_interface_hash": (c_char_p, []),
    "ggslam_cuda_error_text": (c_char_p, [c_int]),
}
"""Result and arguments of each."""
