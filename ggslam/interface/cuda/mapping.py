# SPDX-License-Identifier: Apache-2.0
# Written by scripts/tools/make_native_mirrors.py from mapping.hpp; changes are lost.
"""The CUDA kernels of mapping: image loss, insertion, identity learning, steps of the keyframes' poses and
exposures. Pointers lead to device memory. Calls only start work on the caller's stream; those with a status return 0
or a cudaError_t."""

from __future__ import annotations

from ctypes import POINTER, Structure, c_double, c_float, c_int, c_int32, c_int64, c_void_p
from enum import IntEnum
from typing import Any

HEADER = "cuda/mapping.hpp"
HEADER_SHA256 = "e7dfb0bec0f283079c152978404a80e68392f0e677620dc80d29674b71ff8e7a"
MOST_NEIGHBOURS = 32


class LossResult(IntEnum):
    """Values of enum LossResult."""

    TOTAL = 0
    COLOR = 1
    L1 = 2
    SSIM = 3
    DEPTH = 4
    OPACITY = 5
    DEPTH_L1 = 6
    PSNR = 7
    VALID_PIXELS = 8
    EXPOSURE_GRADIENT = 9


class ImageLossJob(Structure):
    """One evaluation, all pointers lead to device memory."""

    _fields_ = [
        ("image", c_void_p), ("depth", c_void_p), ("alpha", c_void_p), ("target_color", c_void_p),
        ("target_depth", c_void_p), ("target_valid", c_void_p), ("exposure", c_void_p), ("d_image", c_void_p),
        ("d_depth", c_void_p), ("d_alpha", c_void_p), ("results", c_void_p), ("workspace", c_void_p),
        ("stream", c_void_p), ("device", c_int32), ("height", c_int32), ("width", c_int32),
        ("target_depth_is_float", c_int32), ("normalised_depth", c_int32), ("charbonnier", c_int32),
        ("depth_scale", c_float), ("dssim_weight", c_float), ("depth_weight", c_float), ("opacity_weight", c_float),
        ("no_depth_weight", c_float), ("minimum_alpha", c_float), ("charbonnier_epsilon", c_float),
    ]


class InsertionJob(Structure):
    """One keyframe, all pointers lead to device memory."""

    _fields_ = [
        ("color", c_void_p), ("depth", c_void_p), ("alpha", c_void_p), ("rendered_depth", c_void_p),
        ("total", c_void_p), ("means", c_void_p), ("quaternions", c_void_p), ("log_scales", c_void_p),
        ("rgb", c_void_p), ("pixels", c_void_p), ("workspace", c_void_p), ("stream", c_void_p), ("device", c_int32),
        ("height", c_int32), ("width", c_int32), ("count", c_int32), ("adaptive_stride", c_int32),
        ("fill_stride", c_int32), ("units_per_metre", c_float), ("fx", c_float), ("fy", c_float), ("cx", c_float),
        ("cy", c_float), ("rotation", c_float * 9), ("translation", c_float * 3), ("alpha_threshold", c_float),
        ("depth_tolerance_m", c_float), ("depth_tolerance_relative", c_float), ("scale_pixels", c_float),
        ("flatness", c_float), ("max_slope", c_float), ("texture_threshold", c_float), ("max_depth_m", c_float),
    ]


class PixelPoolJob(Structure):
    """All pointers lead to device memory."""

    _fields_ = [
        ("mask", c_void_p), ("alias", c_void_p), ("counts", c_void_p), ("per_pixel", c_void_p), ("odds", c_void_p),
        ("sums", c_void_p), ("random", c_void_p), ("pixels", c_void_p), ("vote_weights", c_void_p),
        ("stream", c_void_p), ("balance", c_double), ("boundary", c_double), ("device", c_int32), ("height", c_int32),
        ("width", c_int32), ("drawn", c_int32),
    ]


class NeighbourJob(Structure):
    """Mirror of struct ggslam::cuda::NeighbourJob."""

    _fields_ = [
        ("points", c_void_p), ("rows", c_void_p), ("neighbours", c_void_p), ("workspace", c_void_p),
        ("stream", c_void_p), ("device", c_int32), ("point_count", c_int32), ("row_count", c_int32), ("k", c_int32),
    ]


class PixelClassJob(Structure):
    """Labels of pixels, and their classes. All pointers lead to device memory."""

    _fields_ = [
        ("mask", c_void_p), ("pixels", c_void_p), ("alias", c_void_p), ("class_of", c_void_p), ("labels", c_void_p),
        ("classes", c_void_p), ("known", c_void_p), ("stream", c_void_p), ("device", c_int32), ("count", c_int32),
    ]


class CrossEntropyJob(Structure):
    """Mirror of struct ggslam::cuda::CrossEntropyJob."""

    _fields_ = [
        ("logits", c_void_p), ("targets", c_void_p), ("known", c_void_p), ("losses", c_void_p), ("stream", c_void_p),
        ("weight", c_float), ("device", c_int32), ("count", c_int32), ("classes", c_int32),
    ]


class NeighbourLossJob(Structure):
    """Mirror of struct ggslam::cuda::NeighbourLossJob."""

    _fields_ = [
        ("logits", c_void_p), ("gradients", c_void_p), ("stream", c_void_p), ("weight", c_float), ("device", c_int32),
        ("samples", c_int32), ("neighbours", c_int32), ("classes", c_int32),
    ]


class ClassAdamJob(Structure):
    """Mirror of struct ggslam::cuda::ClassAdamJob."""

    _fields_ = [
        ("rows", c_void_p), ("first_moments", c_void_p), ("second_moments", c_void_p), ("gradients", c_void_p),
        ("known", c_void_p), ("steps", c_void_p), ("stream", c_void_p), ("rate", c_float), ("device", c_int32),
        ("size", c_int64),
    ]


class AdamMoments(Structure):
    """Mirror of struct ggslam::cuda::AdamMoments."""

    _fields_ = [("first", c_double * 6), ("second", c_double * 6)]


class KeyframeState(Structure):
    """Mirror of struct ggslam::cuda::KeyframeState."""

    _fields_ = [
        ("pose", c_double * 16), ("exposure", c_double * 6), ("pose_moments", AdamMoments),
        ("exposure_moments", AdamMoments), ("pose_steps", c_int64), ("exposure_steps", c_int64),
        ("pose_copy", c_float * 12), ("exposure_copy", c_float * 6),
    ]


class LossTotals(Structure):
    """Sums over all iterations, all of them doubles."""

    _fields_ = [
        ("total", c_double), ("color", c_double), ("ssim", c_double), ("depth", c_double), ("last_psnr", c_double),
        ("iterations", c_double),
    ]


class KeyframeStepJob(Structure):
    """Pointers lead to device memory."""

    _fields_ = [
        ("state", c_void_p), ("twist", c_void_p), ("results", c_void_p), ("skipped", c_void_p), ("totals", c_void_p),
        ("stream", c_void_p), ("pose_rate", c_double), ("exposure_rate", c_double),
        ("exposure_regularization", c_double), ("step_exposure", c_int32), ("device", c_int32),
    ]


class KeyframeWriteJob(Structure):
    """Mirror of struct ggslam::cuda::KeyframeWriteJob."""

    _fields_ = [
        ("state", c_void_p), ("stream", c_void_p), ("pose", c_double * 16), ("exposure", c_double * 6),
        ("is_new", c_int32), ("device", c_int32),
    ]


STRUCTURES: tuple[type[Structure], ...] = (
    ImageLossJob, InsertionJob, PixelPoolJob, NeighbourJob, PixelClassJob, CrossEntropyJob, NeighbourLossJob,
    ClassAdamJob, AdamMoments, KeyframeState, LossTotals, KeyframeStepJob, KeyframeWriteJob,
)
FUNCTIONS: dict[str, tuple[Any, list[Any]]] = {
    "ggslam_cuda_image_loss_bytes": (c_int64, [POINTER(ImageLossJob)]),
    "ggslam_cuda_image_loss": (c_int, [POINTER(ImageLossJob)]),
    "ggslam_cuda_insertion_bytes": (c_int64, [POINTER(InsertionJob)]),
    "ggslam_cuda_insertion_select": (c_int, [POINTER(InsertionJob)]),
    "ggslam_cuda_insertion_build": (c_int, [POINTER(InsertionJob)]),
    "ggslam_cuda_pixel_odds": (c_int, [POINTER(PixelPoolJob)]),
    "ggslam_cuda_draw_pixels": (c_int, [POINTER(PixelPoolJob)]),
    "ggslam_cuda_neighbours_bytes": (c_int64, [POINTER(NeighbourJob)]),
    "ggslam_cuda_neighbours": (c_int, [POINTER(NeighbourJob)]),
    "ggslam_cuda_pixel_labels": (c_int, [POINTER(PixelClassJob)]),
    "ggslam_cuda_pixel_classes": (c_int, [POINTER(PixelClassJob)]),
    "ggslam_cuda_cross_entropy": (c_int, [POINTER(CrossEntropyJob)]),
    "ggslam_cuda_neighbour_loss": (c_int, [POINTER(NeighbourLossJob)]),
    "ggslam_cuda_class_adam": (c_int, [POINTER(ClassAdamJob)]),
    "ggslam_cuda_keyframe_step": (c_int, [POINTER(KeyframeStepJob)]),
    "ggslam_cuda_keyframe_write": (c_int, [POINTER(KeyframeWriteJob)]),
}
"""Result and arguments of each."""
