# SPDX-License-Identifier: Apache-2.0
"""Inputs and outputs of a renderer, the same for all backends."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final, Protocol

import numpy as np
import torch

from ggslam.errors import RenderError
from ggslam.scene.camera import Camera

PARAMETERS = ("means", "quaternions", "log_scales", "opacity_logits", "sh", "features")
"""Names of the parameter arrays of a set of Gaussians."""


LOW_PASS_3DGS: Final = 0.3
"""Pixels^2 that 3D Gaussian Splatting, and viewers that follow it, add to both variances of a projected Gaussian."""
LOW_PASS = LOW_PASS_3DGS
"""Ours: the same, so that a map looks alike everywhere. Trained with 0.1 and drawn with 0.3, maps lose up to 4 dB."""

LARGEST_ZOOM: Final = 50.0
"""Up to which `low_pass_at` grows."""


def low_pass_at(zoom: float) -> float:
    """The filter, pixels^2, with which pictures `zoom` times as large show a map as those did that it was trained on:
    as wide as theirs. But a pixel is the mean over its square, with a variance of 1/12: what smaller squares blur less
    the filter blurs less, too."""
    square = min(zoom, LARGEST_ZOOM) ** 2
    return LOW_PASS * square + (1 - square) / 12


def focal_of(camera: Camera) -> float:
    """Focal length, pixels, as of square ones."""
    return math.sqrt(camera.fx * camera.fy)


def low_pass_for(camera: Camera, trained: Sequence[Camera]) -> float:
    """That of pictures by `camera` of a map that pictures by the cameras `trained` taught: as against the one whose
    focal length in pixels is nearest, by the ratio, to that of `camera`, the longer one of two as near. So what each of
    them took is drawn as it was trained, and what is finer than all of them as the finest one trained it. Of a map that
    no recording is known of (there are none) 3DGS's."""
    focal = focal_of(camera)
    zooms = [focal / focal_of(one) for one in trained]
    return low_pass_at(min(zooms, key=lambda zoom: (abs(math.log(zoom)), zoom))) if zooms else LOW_PASS


class Gaussians(Protocol):
    """Anything that can be rendered; `GaussianMap` and `GaussianTensors` are.

    Attributes:
        means: [N, 3], metres, world frame.
        quaternions: [N, 4] wxyz, of any length but zero.
        log_scales: [N, 3], natural logarithm of the standard deviations in metres.
        opacity_logits: [N].
        sh: [N, K, 3] spherical-harmonic coefficients, K = 1, 4, 9 or 16.
        features: [N, F], F >= 0.
    """

    @property
    def means(self) -> torch.Tensor: ...
    @property
    def quaternions(self) -> torch.Tensor: ...
    @property
    def log_scales(self) -> torch.Tensor: ...
    @property
    def opacity_logits(self) -> torch.Tensor: ...
    @property
    def sh(self) -> torch.Tensor: ...
    @property
    def features(self) -> torch.Tensor: ...


@dataclass
class GaussianTensors:
    """The plainest set of Gaussians: six tensors, see `Gaussians`."""

    means: torch.Tensor
    quaternions: torch.Tensor
    log_scales: torch.Tensor
    opacity_logits: torch.Tensor
    sh: torch.Tensor
    features: torch.Tensor


@dataclass
class RenderBuffers:
    """Rendered images.

    Attributes:
        image: [3, H, W] colour over black, 0 or more; nothing keeps it below 1.
        depth: [H, W] sum of weight times depth (metres along the optical axis); see `expected_depth`.
        alpha: [H, W] sum of the weights, in [0, 1).
        features: [F, H, W] or None.
        median_depth: [H, W] depth of the Gaussian at which the transmittance falls below 0.5, 0 where alpha stays
            at most 0.5; None unless asked for. Not differentiable.
    """

    image: torch.Tensor
    depth: torch.Tensor
    alpha: torch.Tensor
    features: torch.Tensor | None = None
    median_depth: torch.Tensor | None = None

    @property
    def expected_depth(self) -> torch.Tensor:
        """[H, W] metres: depth / alpha, 0 where alpha is below 0.001."""
        if self.depth.device.type == "cpu" and not (self.depth.requires_grad or self.alpha.requires_grad):
            alpha, depth = self.alpha.numpy(), self.depth.numpy()  # torch would wake its threads for this
            seen = alpha >= np.float32(1e-3)
            return torch.from_numpy(np.divide(depth, alpha, out=np.zeros_like(depth), where=seen))
        return torch.where(self.alpha >= 1e-3, self.depth / self.alpha.clamp_min(1e-3), torch.zeros_like(self.depth))


@dataclass
class ParameterGradients:
    """Gradients of a loss with respect to the parameters of N Gaussians.

    Attributes:
        means, quaternions, log_scales, opacity_logits, sh, features: as the parameters; features None if not rendered.
        touched: uint8 [N], 1 where the Gaussian contributed to some pixel. All other rows are zero.
    """

    means: torch.Tensor
    quaternions: torch.Tensor
    log_scales: torch.Tensor
    opacity_logits: torch.Tensor
    sh: torch.Tensor
    features: torch.Tensor | None
    touched: torch.Tensor


@dataclass
class Gradients(ParameterGradients):
    """Gradients of a loss with respect to the parameters of N Gaussians and the camera pose.

    Attributes:
        twist: float64 [6], d loss / d xi at xi = 0 for T_camera_world <- exp(xi) T_camera_world (left perturbation, in
            the camera frame; translation first).
    """

    twist: np.ndarray


def check_gaussians(gaussians: Gaussians) -> None:
    """Raises RenderError unless the shapes in `Gaussians` hold and all arrays share one dtype and device."""
    means = gaussians.means
    count = means.shape[0] if means.ndim else -1
    expected: dict[str, tuple[int, ...]] = {
        "means": (count, 3), "quaternions": (count, 4), "log_scales": (count, 3), "opacity_logits": (count,),
        "sh": (count, -1, 3), "features": (count, -1),
    }  # fmt: skip
    for name, shape in expected.items():
        tensor = getattr(gaussians, name)
        agrees = tensor.ndim == len(shape) and all(a in (b, -1) for a, b in zip(shape, tensor.shape, strict=True))
        if not agrees:
            raise RenderError(f"{name}: expected shape {list(shape)}, found {list(tensor.shape)} (-1: any)")
        if tensor.dtype != means.dtype or tensor.device != means.device:
            raise RenderError(
                f"{name}: expected {means.dtype} on {means.device} like means, found {tensor.dtype} on {tensor.device}"
            )
    if gaussians.sh.shape[1] not in (1, 4, 9, 16):
        raise RenderError(f"sh: expected 1, 4, 9 or 16 coefficients, found {gaussians.sh.shape[1]}")


def active_coefficients(gaussians: Gaussians, active_sh_degree: int | None) -> int:
    """Number of spherical-harmonic coefficients to evaluate; None: all there are."""
    stored = gaussians.sh.shape[1]
    if active_sh_degree is None:
        return stored
    if active_sh_degree < 0 or (active_sh_degree + 1) ** 2 > stored:
        raise RenderError(f"active_sh_degree {active_sh_degree} is impossible with {stored} coefficients per Gaussian")
    return (active_sh_degree + 1) ** 2


def check_pose(matrix: np.ndarray, name: str = "T_camera_world") -> np.ndarray:
    """The pose as float64 [4, 4]; raises RenderError on another shape or numbers that are not finite."""
    matrix = np.asarray(matrix, np.float64)
    if matrix.shape != (4, 4):
        raise RenderError(f"{name}: expected a 4x4 matrix, found shape {list(matrix.shape)}")
    if not np.isfinite(matrix).all():
        raise RenderError(f"{name}: expected finite numbers, found {matrix.tolist()}")
    return matrix
