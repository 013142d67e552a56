# SPDX-License-Identifier: Apache-2.0
# Written by scripts/tools/make_native_mirrors.py from rendering.hpp; changes are lost.
"""The compiled core's rasterizer, sampled compositing (which Gaussians make up a pixel) and pictures of meshes."""

from __future__ import annotations

from ctypes import POINTER, Structure, c_float, c_int, c_int32, c_int64, c_void_p
from typing import Any

HEADER = "core/rendering.hpp"
HEADER_SHA256 = "ec99881f6f1951d61eba4c3558f3ecedb0e46127e47e6020a5a3cb4b1fc83b7e"


class GaussianArrays(Structure):
    """Parameters of Gaussians, and what of them is rendered."""

    _fields_ = [
        ("count", c_int64), ("means", c_void_p), ("quaternions", c_void_p), ("log_scales", c_void_p),
        ("opacity_logits", c_void_p), ("sh", c_void_p), ("features", c_void_p), ("sh_coefficients", c_int32),
        ("active_sh_coefficients", c_int32), ("feature_channels", c_int32), ("render_features", c_int32),
    ]


class CameraView(Structure):
    """A camera and its pose."""

    _fields_ = [
        ("width", c_int32), ("height", c_int32), ("fx", c_float), ("fy", c_float), ("cx", c_float), ("cy", c_float),
        ("near_plane", c_float), ("low_pass", c_float), ("close_below", c_float), ("camera_world", c_float * 12),
    ]


class RenderTargets(Structure):
    """Images to write, planes [H, W]; features and median_depth may be null."""

    _fields_ = [
        ("image", c_void_p), ("features", c_void_p), ("depth", c_void_p), ("alpha", c_void_p),
        ("median_depth", c_void_p),
    ]


class ImageGradients(Structure):
    """Gradients of a loss with respect to the images; each may be null, which means zero."""

    _fields_ = [
        ("image", c_void_p), ("features", c_void_p), ("depth", c_void_p), ("alpha", c_void_p),
        ("detach_features", c_int32),
    ]


class GaussianGradients(Structure):
    """Gradients to write. The arrays may all be null; twist and touched are always written."""

    _fields_ = [
        ("means", c_void_p), ("quaternions", c_void_p), ("log_scales", c_void_p), ("opacity_logits", c_void_p),
        ("sh", c_void_p), ("features", c_void_p), ("twist", c_void_p), ("touched", c_void_p),
    ]


class AdamArrays(Structure):
    """A parameter array and its two moments."""

    _fields_ = [("parameters", c_void_p), ("first_moments", c_void_p), ("second_moments", c_void_p)]


class AdamArguments(Structure):
    """What the optimizer that is fused into the backward pass works on; the schedule is that of
    AdamSettings.schedule (ggslam/rendering/adam.py)."""

    _fields_ = [
        ("means", AdamArrays), ("quaternions", AdamArrays), ("log_scales", AdamArrays), ("opacity_logits", AdamArrays),
        ("sh", AdamArrays), ("features", AdamArrays), ("updates", c_void_p), ("schedule", c_void_p),
        ("schedule_rows", c_int32), ("beta1", c_float), ("beta2", c_float), ("epsilon", c_float),
    ]


class PixelTerms(Structure):
    """The terms of P pixels: the first counts[p] of row p are in use, front to back."""

    _fields_ = [
        ("pixels", c_int64), ("capacity", c_int32), ("gaussians", c_void_p), ("weights", c_void_p),
        ("counts", c_void_p),
    ]


class FeatureAdam(Structure):
    """Features of Gaussians and their optimizer."""

    _fields_ = [
        ("gaussians", c_int64), ("features", c_void_p), ("first_moments", c_void_p), ("second_moments", c_void_p),
        ("updates", c_void_p), ("schedule", c_void_p), ("schedule_rows", c_int32), ("channels", c_int32),
        ("beta1", c_float), ("beta2", c_float), ("epsilon", c_float), ("short_moments", c_void_p),
    ]


class TermVotes(Structure):
    """Votes of Gaussians, and the labels that pixels give them."""

    _fields_ = [
        ("labels", c_void_p), ("pixel_weights", c_void_p), ("ids", c_void_p), ("weights", c_void_p), ("slots", c_int32),
    ]


class MeshPictureInput(Structure):
    """A mesh and a camera. Positions [vertices, 3] in the camera's axes, colours [vertices, 3] as they are to be
    seen; triangles [triangles, 3], counter-clockwise seen from their front."""

    _fields_ = [
        ("positions", c_void_p), ("colors", c_void_p), ("triangles", c_void_p), ("vertices", c_int64),
        ("count", c_int64), ("fx", c_float), ("fy", c_float), ("cx", c_float), ("cy", c_float), ("near", c_float),
        ("width", c_int32), ("height", c_int32), ("cull", c_int32),
    ]


STRUCTURES: tuple[type[Structure], ...] = (
    GaussianArrays, CameraView, RenderTargets, ImageGradients, GaussianGradients, AdamArrays, AdamArguments, PixelTerms,
    FeatureAdam, TermVotes, MeshPictureInput,
)
FUNCTIONS: dict[str, tuple[Any, list[Any]]] = {
    "ggslam_rasterizer_create": (c_void_p, [c_void_p]),
    "ggslam_rasterizer_destroy": (c_int, [c_void_p]),
    "ggslam_rasterizer_forward": (c_int, [
        c_void_p, POINTER(GaussianArrays), POINTER(CameraView), POINTER(RenderTargets), c_int,
    ]),
    "ggslam_rasterizer_backward": (c_int, [
        c_void_p, POINTER(ImageGradients), POINTER(GaussianGradients), POINTER(AdamArguments),
    ]),
    "ggslam_rasterizer_statistics": (c_int, [c_void_p, c_void_p]),
    "ggslam_rasterizer_pixel_terms": (c_int, [c_void_p, c_void_p, c_float, POINTER(PixelTerms)]),
    "ggslam_terms_blend": (c_int, [c_void_p, POINTER(PixelTerms), c_void_p, c_int64, c_int, c_void_p]),
    "ggslam_terms_step": (c_int, [c_void_p, POINTER(PixelTerms), c_void_p, POINTER(FeatureAdam)]),
    "ggslam_terms_vote": (c_int, [
        c_void_p, POINTER(PixelTerms), c_void_p, c_void_p, c_int64, c_int, c_void_p, c_void_p,
    ]),
    "ggslam_terms_learn": (c_int, [c_void_p, POINTER(PixelTerms), c_void_p, POINTER(FeatureAdam), POINTER(TermVotes)]),
    "ggslam_terms_label": (c_int, [c_void_p, POINTER(PixelTerms), c_void_p, c_int64, c_void_p, c_void_p]),
    "ggslam_draw_mesh": (c_int, [c_void_p, POINTER(MeshPictureInput), c_void_p, c_void_p]),
}
"""Result and arguments of each."""
