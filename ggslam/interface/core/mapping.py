# SPDX-License-Identifier: Apache-2.0
# Written by scripts/tools/make_native_mirrors.py from mapping.hpp; changes are lost.
"""The compiled core's losses, of images and of what pixels are classified as, and the Gaussians that a keyframe
brings."""

from __future__ import annotations

from ctypes import POINTER, Structure, c_double, c_float, c_int, c_int32, c_int64, c_void_p
from typing import Any

HEADER = "core/mapping.hpp"
HEADER_SHA256 = "01f42dadc662068ed7d37011461990e34bfa7b5aeb528807a21d4a58f68b21b2"


class ImageLossJob(Structure):
    """One evaluation of the loss; H = height, W = width."""

    _fields_ = [
        ("image", c_void_p), ("depth", c_void_p), ("alpha", c_void_p), ("target_color", c_void_p),
        ("target_depth", c_void_p), ("target_valid", c_void_p), ("d_image", c_void_p), ("d_depth", c_void_p),
        ("d_alpha", c_void_p), ("height", c_int32), ("width", c_int32), ("target_row", c_int32),
        ("target_step", c_int32), ("target_depth_is_float", c_int32), ("normalised_depth", c_int32),
        ("charbonnier", c_int32), ("depth_scale", c_float), ("exposure", c_float * 6), ("dssim_weight", c_float),
        ("depth_weight", c_float), ("opacity_weight", c_float), ("no_depth_weight", c_float),
        ("minimum_alpha", c_float), ("charbonnier_epsilon", c_float), ("total", c_double), ("color", c_double),
        ("l1", c_double), ("ssim", c_double), ("depth_term", c_double), ("opacity_term", c_double),
        ("depth_l1_m", c_double), ("psnr", c_double), ("valid_pixels", c_double), ("exposure_gradient", c_double * 6),
    ]


class InsertionJob(Structure):
    """One keyframe to insert Gaussians for; H = height, W = width."""

    _fields_ = [
        ("color", c_void_p), ("depth", c_void_p), ("where", c_void_p), ("marks", c_void_p), ("pixels", c_void_p),
        ("means", c_void_p), ("quaternions", c_void_p), ("log_scales", c_void_p), ("rgb", c_void_p),
        ("height", c_int32), ("width", c_int32), ("adaptive_stride", c_int32), ("fx", c_float), ("fy", c_float),
        ("cx", c_float), ("cy", c_float), ("rotation", c_float * 9), ("translation", c_float * 3),
        ("texture_threshold", c_float), ("max_depth", c_float), ("scale_pixels", c_float), ("flatness", c_float),
        ("max_slope", c_float),
    ]


class CrossEntropyOfPixels(Structure):
    """Softmax cross-entropy of classified features at P pixels; F channels, K classes. Being nothing competes with
    the classes."""

    _fields_ = [
        ("features", c_void_p), ("classes", c_void_p), ("weight", c_void_p), ("bias", c_void_p),
        ("d_features", c_void_p), ("d_rows", c_void_p), ("pixels", c_int64), ("channels", c_int32), ("count", c_int32),
        ("nothing_logit", c_float), ("loss", c_double),
    ]


STRUCTURES: tuple[type[Structure], ...] = (ImageLossJob, InsertionJob, CrossEntropyOfPixels)
FUNCTIONS: dict[str, tuple[Any, list[Any]]] = {
    "ggslam_image_loss_create": (c_void_p, []),
    "ggslam_image_loss_destroy": (c_int, [c_void_p]),
    "ggslam_image_loss_evaluate": (c_int, [c_void_p, c_void_p, POINTER(ImageLossJob)]),
    "ggslam_insertion_select": (c_int64, [c_void_p, POINTER(InsertionJob)]),
    "ggslam_insertion_shape": (c_int, [c_void_p, POINTER(InsertionJob), c_int64]),
    "ggslam_cross_entropy_of_pixels": (c_int, [c_void_p, POINTER(CrossEntropyOfPixels)]),
}
"""Result and arguments of each."""
