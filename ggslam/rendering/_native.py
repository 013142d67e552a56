# SPDX-License-Identifier: Apache-2.0
"""The C interface of the rasterizer: structures as laid out in native/src/rendering/rasterizer.hpp."""

from __future__ import annotations

import ctypes
from functools import lru_cache

import torch

from ggslam.native.loader import load_library

_pointer = ctypes.c_void_p
_int32 = ctypes.c_int32
_float = ctypes.c_float

ADAM_GROUPS = ("means", "quaternions", "log_scales", "opacity_logits", "sh_dc", "sh_rest", "features")
"""Parameter groups with a learning rate of their own, in the order of the columns of an Adam schedule."""


class GaussianArrays(ctypes.Structure):
    """Pointers to the parameters and what to render of them."""

    _fields_ = [
        ("count", ctypes.c_int64),
        ("means", _pointer), ("quaternions", _pointer), ("log_scales", _pointer),
        ("opacity_logits", _pointer), ("sh", _pointer), ("features", _pointer),
        ("sh_coefficients", _int32), ("active_sh_coefficients", _int32),
        ("feature_channels", _int32), ("render_features", _int32),
    ]  # fmt: skip


class View(ctypes.Structure):
    """Camera and its pose."""

    _fields_ = [
        ("width", _int32), ("height", _int32),
        ("fx", _float), ("fy", _float), ("cx", _float), ("cy", _float), ("near_plane", _float), ("low_pass", _float),
        ("camera_world", _float * 12),
    ]  # fmt: skip


class RenderTargets(ctypes.Structure):
    """Images to write."""

    _fields_ = [(name, _pointer) for name in ("image", "features", "depth", "alpha", "median_depth")]


class ImageGradients(ctypes.Structure):
    """Gradients of a loss with respect to the images."""

    _fields_ = [*((name, _pointer) for name in ("image", "features", "depth", "alpha")), ("detach_features", _int32)]


class GaussianGradients(ctypes.Structure):
    """Gradients to write."""

    _fields_ = [
        (name, _pointer)
        for name in ("means", "quaternions", "log_scales", "opacity_logits", "sh", "features", "twist", "touched")
    ]


class AdamArrays(ctypes.Structure):
    """A parameter array and its two moments."""

    _fields_ = [("parameters", _pointer), ("first_moments", _pointer), ("second_moments", _pointer)]


class AdamArguments(ctypes.Structure):
    """What the fused optimizer works on."""

    _fields_ = [
        *((name, AdamArrays) for name in ("means", "quaternions", "log_scales", "opacity_logits", "sh", "features")),
        ("updates", _pointer), ("schedule", _pointer), ("schedule_rows", _int32),
        ("beta1", _float), ("beta2", _float), ("epsilon", _float),
    ]  # fmt: skip


class PixelTerms(ctypes.Structure):
    """Terms of pixels, as laid out in native/src/rendering/pixel_terms.hpp."""

    _fields_ = [
        ("pixels", ctypes.c_int64), ("capacity", _int32), ("gaussians", _pointer), ("weights", _pointer),
        ("counts", _pointer),
    ]  # fmt: skip


class FeatureAdam(ctypes.Structure):
    """Features and the optimizer's state of them, as laid out in native/src/rendering/pixel_terms.hpp."""

    _fields_ = [
        ("gaussians", ctypes.c_int64), ("features", _pointer), ("first_moments", _pointer),
        ("second_moments", _pointer), ("updates", _pointer), ("schedule", _pointer), ("schedule_rows", _int32),
        ("channels", _int32), ("beta1", _float), ("beta2", _float), ("epsilon", _float),
    ]  # fmt: skip


@lru_cache(maxsize=1)
def rasterizer_library() -> ctypes.CDLL:
    """The compiled core with the signatures of the rasterizer's functions declared."""
    library = load_library()
    library.ggslam_rasterizer_create.restype = _pointer
    library.ggslam_rasterizer_create.argtypes = [_pointer]
    library.ggslam_rasterizer_destroy.argtypes = [_pointer]
    library.ggslam_rasterizer_forward.argtypes = [_pointer] * 4
    library.ggslam_rasterizer_backward.argtypes = [_pointer] * 4
    library.ggslam_rasterizer_statistics.argtypes = [_pointer] * 2
    library.ggslam_rasterizer_pixel_terms.argtypes = [_pointer, _pointer, _float, _pointer]
    library.ggslam_terms_blend.argtypes = [_pointer, _pointer, _pointer, ctypes.c_int, _pointer]
    library.ggslam_terms_step.argtypes = [_pointer] * 4
    library.ggslam_terms_vote.argtypes = [
        _pointer, _pointer, _pointer, _pointer, ctypes.c_int64, ctypes.c_int, _pointer, _pointer,
    ]  # fmt: skip
    library.ggslam_terms_label.argtypes = [_pointer] * 5
    return library


def pointer(tensor: torch.Tensor | None) -> int | None:
    """Address of the first element; None stays None (a null pointer)."""
    return None if tensor is None else tensor.data_ptr()
