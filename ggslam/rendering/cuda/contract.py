# SPDX-License-Identifier: Apache-2.0
"""The C interface of the CUDA rasterizer: structures as in cuda/kernels/rendering/contract.cuh, functions of api.cu."""

from __future__ import annotations

import ctypes

from ggslam.cuda.library import CudaLibrary
from ggslam.rendering import _native

_pointer = ctypes.c_void_p
_int32 = ctypes.c_int32
_int64 = ctypes.c_int64


class Rendering(ctypes.Structure):
    """What to render, where to, and the device memory to work in."""

    _fields_ = [
        ("gaussians", _native.GaussianArrays), ("view", _native.View), ("pose", _pointer),
        ("targets", _native.RenderTargets),
        ("gaussian_workspace", _pointer), ("pair_workspace", _pointer), ("pixel_workspace", _pointer),
        ("pair_capacity", _int64), ("gaussian_sorting_bytes", _int64), ("pair_sorting_bytes", _int64),
        ("overflowed", _pointer), ("overflows", _pointer),
        ("stream", _pointer), ("device", _int32),
    ]  # fmt: skip


class Sizes(ctypes.Structure):
    """Bytes of the memory that a rendering works in."""

    _fields_ = [(name, _int64) for name in ("gaussian_workspace", "pair_workspace", "pixel_workspace", "gradient_rows")]


def declare_rasterizer(library: CudaLibrary) -> None:
    """Declares the functions of the rasterizer."""
    library.check_size("rendering", Rendering)
    library.declare("counter_create", [ctypes.c_int, _pointer])
    library.declare("counter_destroy", [_pointer], None)
    library.declare("recent_pairs", [_pointer], _int64)
    for name, arguments in {"plan": 2, "project": 2, "wait": 2, "composite": 1, "backward": 5}.items():
        library.declare(name, [_pointer] * arguments)
