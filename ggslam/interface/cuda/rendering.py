# SPDX-License-Identifier: Apache-2.0
# Written by scripts/tools/make_native_mirrors.py from rendering.hpp; changes are lost.
"""The CUDA kernels' rasterizer and sampled compositing. Pointers lead to device memory, those of the core's
structures, too. Calls only start work on the caller's stream, but for ggslam_cuda_wait; those with a status return 0
or a cudaError_t."""

from __future__ import annotations

from ctypes import POINTER, Structure, c_float, c_int, c_int32, c_int64, c_void_p
from enum import IntEnum
from typing import Any

from ggslam.interface.core.rendering import (
    AdamArrays,
    CameraView,
    GaussianArrays,
    GaussianGradients,
    ImageGradients,
    RenderTargets,
)

HEADER = "cuda/rendering.hpp"
HEADER_SHA256 = "2abc6d2a93da3acb821a95b3dd8d6a2a4da1cba4caf957a0e4d0f969fb8219cd"


class AdamGroup(IntEnum):
    """Values of enum AdamGroup."""

    MEANS = 0
    QUATERNIONS = 1
    LOG_SCALES = 2
    OPACITY_LOGITS = 3
    SH_CONSTANT = 4
    SH_REST = 5
    FEATURES = 6
    ADAM_GROUPS = 7


class Rendering(Structure):
    """One rendering: what to render, where to, and the device memory to work in (see workspace.cuh)."""

    _fields_ = [
        ("gaussians", GaussianArrays), ("view", CameraView), ("pose", c_void_p), ("targets", RenderTargets),
        ("gaussian_workspace", c_void_p), ("pair_workspace", c_void_p), ("pixel_workspace", c_void_p),
        ("pair_capacity", c_int64), ("gaussian_sorting_bytes", c_int64), ("pair_sorting_bytes", c_int64),
        ("overflowed", c_void_p), ("overflows", c_void_p), ("stream", c_void_p), ("device", c_int32),
    ]


class Sizes(Structure):
    """Sizes of the memory that a rendering works in."""

    _fields_ = [
        ("gaussian_workspace", c_int64), ("pair_workspace", c_int64), ("pixel_workspace", c_int64),
        ("gradient_rows", c_int64),
    ]


class AdamStep(Structure):
    """One step of the optimizer that is fused into the backward pass."""

    _fields_ = [
        ("means", AdamArrays), ("quaternions", AdamArrays), ("log_scales", AdamArrays), ("opacity_logits", AdamArrays),
        ("sh", AdamArrays), ("features", AdamArrays), ("updates", c_void_p), ("rates", c_float * 7),
        ("decayed_groups", c_int32), ("falling_groups", c_int32), ("log_decay", c_float), ("decay_floor", c_float),
        ("fall_rate", c_float), ("fall_floor", c_float), ("beta1", c_float), ("beta2", c_float), ("log_beta1", c_float),
        ("log_beta2", c_float), ("epsilon", c_float),
    ]


class PixelTerms(Structure):
    """The terms of P pixels: the first counts[p] of row p are in use, front to back; the rest are zero."""

    _fields_ = [
        ("pixels", c_int64), ("gaussians", c_void_p), ("weights", c_void_p), ("counts", c_void_p), ("stream", c_void_p),
        ("capacity", c_int32), ("device", c_int32),
    ]


class TermsByGaussian(Structure):
    """All places of the terms, sorted by Gaussian; those of one Gaussian are in the order of the pixels. Places not
    in use come last, under the number `count`."""

    _fields_ = [("gaussians", c_void_p), ("places", c_void_p), ("size", c_int64), ("count", c_int64)]


STRUCTURES: tuple[type[Structure], ...] = (Rendering, Sizes, AdamStep, PixelTerms, TermsByGaussian)
FUNCTIONS: dict[str, tuple[Any, list[Any]]] = {
    "ggslam_cuda_counter_create": (c_int, [c_int, c_void_p]),
    "ggslam_cuda_counter_destroy": (None, [c_void_p]),
    "ggslam_cuda_plan": (c_int, [POINTER(Rendering), POINTER(Sizes)]),
    "ggslam_cuda_project": (c_int, [POINTER(Rendering), c_void_p]),
    "ggslam_cuda_wait": (c_int, [c_void_p, c_void_p]),
    "ggslam_cuda_recent_pairs": (c_int64, [c_void_p]),
    "ggslam_cuda_composite": (c_int, [POINTER(Rendering)]),
    "ggslam_cuda_backward": (c_int, [
        POINTER(Rendering), POINTER(ImageGradients), POINTER(GaussianGradients), POINTER(AdamStep), c_void_p,
    ]),
    "ggslam_cuda_terms_collect": (c_int, [POINTER(PixelTerms), POINTER(Rendering), c_void_p, c_float]),
    "ggslam_cuda_terms_of_gaussians": (c_int, [POINTER(PixelTerms), c_void_p]),
    "ggslam_cuda_terms_blend": (c_int, [POINTER(PixelTerms), c_void_p, c_int64, c_int, c_void_p]),
    "ggslam_cuda_terms_label": (c_int, [POINTER(PixelTerms), c_void_p, c_int64, c_void_p, c_void_p]),
    "ggslam_cuda_terms_sorting_bytes": (c_int64, [c_int64]),
    "ggslam_cuda_terms_sort": (c_int, [POINTER(PixelTerms), POINTER(TermsByGaussian), c_void_p]),
    "ggslam_cuda_terms_step": (c_int, [
        POINTER(PixelTerms), POINTER(TermsByGaussian), c_void_p, c_int, POINTER(AdamStep),
    ]),
    "ggslam_cuda_terms_vote": (c_int, [
        POINTER(PixelTerms), POINTER(TermsByGaussian), c_void_p, c_void_p, c_int64, c_void_p, c_void_p,
    ]),
    "ggslam_cuda_terms_sum": (c_int, [POINTER(PixelTerms), POINTER(TermsByGaussian), c_void_p, c_void_p]),
}
"""Result and arguments of each."""
