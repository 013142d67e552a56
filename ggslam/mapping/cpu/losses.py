# SPDX-License-Identifier: Apache-2.0
"""The loss between a rendered view and a keyframe, with its gradients, in one call to the compiled core.

    loss = (1 - dssim_weight) mean rho(x - y) + dssim_weight (1 - mean SSIM(x, y))
           + depth_weight mean_valid |D - D_target| + opacity_weight mean_valid (1 - alpha)

x is the rendered colour after the keyframe's exposure (gain * rendered + offset, per channel), y the target in [0, 1];
rho is |.| or Charbonnier; SSIM (Wang et al. 2004) has an 11x11 Gaussian window, sigma 1.5, and zero padding. At pixels
without depth x is first pulled to the target, x <- w x + (1 - w) y with w = `no_depth_weight`. `mean_valid` is over
the pixels whose target depth is known. `losses_reference.py` says the same in a page of torch.
"""

from __future__ import annotations

import ctypes
from dataclasses import dataclass
from typing import Literal, Protocol

import numpy as np
import torch

from ggslam.errors import NativeCoreError, RenderError
from ggslam.interface.core.mapping import ImageLossJob
from ggslam.native.loader import NativeContext, load_library
from ggslam.system.settings import setting, settings_class


@settings_class(frozen=True)
class LossSettings:
    """Weights and kinds of the terms of the loss.

    Raises:
        ConfigError: a value outside its range.
    """

    dssim_weight: float = setting(0.2, 0, 1)
    """Share of 1 - SSIM in the colour loss. 0 skips SSIM, which is most of the work."""
    depth_weight: float = setting(0.5, 0, 1e6, "1/m")
    """Weight of the difference in depth."""
    depth_kind: Literal["accumulated", "normalised"] = "accumulated"
    """What is compared with the target: the accumulated depth (so that a transparent pixel is too near), or the
    accumulated depth divided by alpha."""
    minimum_alpha: float = setting(0.05, 1e-6, 1)
    """For "normalised": pixels rendered fainter than this have no depth to speak of and are left out."""
    color_kind: Literal["l1", "charbonnier"] = "l1"
    """rho(r) = |r|, or sqrt(r^2 + epsilon^2) - epsilon."""
    charbonnier_epsilon: float = setting(1e-3, 1e-6, 1e6)
    """Epsilon of "charbonnier", in units of colour."""
    no_depth_weight: float = setting(1.0, 0, 1)
    """How much colour counts where the keyframe has no depth. 0: not at all."""
    opacity_weight: float = setting(0.0, 0, 1e6)
    """Weight of 1 - alpha where the keyframe has depth, i.e. where there is a surface."""


_NUMBERS = (
    "dssim_weight", "depth_weight", "minimum_alpha", "charbonnier_epsilon", "no_depth_weight", "opacity_weight",
)  # fmt: skip
"""Those that the core takes as they are."""


class RenderedImages(Protocol):
    """What a renderer hands over; float32 on the CPU, contiguous."""

    @property
    def image(self) -> torch.Tensor:
        """Colour [3, H, W]."""

    @property
    def depth(self) -> torch.Tensor:
        """Accumulated (not normalised) depth [H, W], metres."""

    @property
    def alpha(self) -> torch.Tensor:
        """Opacity [H, W]."""


@dataclass(frozen=True)
class KeyframeImages:
    """The target.

    Attributes:
        color: uint8 [H, W, 3].
        depth: uint16 or float32 [H, W]; 0, negative, infinite or NaN: none.
        depth_scale: metres per unit of `depth`.
        exposure: float [3, 2], gain and offset applied to the rendered R, G, B; None: (1, 0).
    """

    color: np.ndarray
    depth: np.ndarray
    depth_scale: float
    exposure: np.ndarray | None = None


@dataclass(frozen=True)
class LossValues:
    """Values of the terms, unweighted unless said otherwise; NaN where nothing was measured.

    Attributes:
        total: the loss.
        color: mean rho(x - y).
        l1: mean |x - y|.
        ssim: mean SSIM; NaN when `dssim_weight` is 0.
        depth: depth term (its mean is over all valid pixels; 0 if there is none).
        opacity: opacity term, likewise.
        depth_l1_m: mean depth error over the pixels that count in the depth term, metres.
        psnr: over pixels with depth, of the exposed image clipped to [0, 1], dB.
        valid_pixels: number of pixels with depth.
    """

    total: float
    color: float
    l1: float
    ssim: float
    depth: float
    opacity: float
    depth_l1_m: float
    psnr: float
    valid_pixels: int


@dataclass(frozen=True)
class LossResult:
    """Loss and gradients. The tensors belong to the `ImageLoss` and are overwritten by its next evaluation.

    Attributes:
        d_image: d loss / d rendered image (before exposure), float32 [3, H, W].
        d_depth: d loss / d accumulated depth, float32 [H, W].
        d_alpha: d loss / d alpha, float32 [H, W].
        exposure_gradient: d loss / d exposure, float64 [3, 2].
    """

    values: LossValues
    d_image: torch.Tensor
    d_depth: torch.Tensor
    d_alpha: torch.Tensor
    exposure_gradient: np.ndarray

    @property
    def psnr(self) -> float:
        """Short for `values.psnr`."""
        return self.values.psnr


class ImageLoss:
    """Evaluates the loss; keeps scratch memory and gradient images between calls. One instance serves one thread.

    The result is the same, bit for bit, for any number of threads.

    Raises:
        NativeCoreError: memory ran out.
    """

    def __init__(self, context: NativeContext) -> None:
        self._workspace: int | None = None
        self._context = context
        self._library = load_library()
        self._workspace = self._library.ggslam_image_loss_create()
        if not self._workspace:
            raise NativeCoreError("no memory for the image loss")
        self._gradients = (torch.empty(0), torch.empty(0), torch.empty(0))

    def __del__(self) -> None:
        if self._workspace:
            self._library.ggslam_image_loss_destroy(self._workspace)

    def evaluate(self, rendered: RenderedImages, target: KeyframeImages, settings: LossSettings) -> LossResult:
        """Loss and gradients of one view.

        Raises:
            RenderError: an array has another shape or type than `RenderedImages` and `KeyframeImages` say.
        """
        height, width = _target_size(target)
        job = ImageLossJob(height=height, width=width)
        for name, shape in (("image", (3, height, width)), ("depth", (height, width)), ("alpha", (height, width))):
            setattr(job, name, _check_rendered(name, getattr(rendered, name), shape).data_ptr())
        color, depth = np.ascontiguousarray(target.color), np.ascontiguousarray(target.depth)
        job.target_color, job.target_depth = color.ctypes.data, depth.ctypes.data
        job.target_depth_is_float = depth.dtype == np.float32
        job.depth_scale = target.depth_scale
        job.exposure[:] = _exposure(target).ravel().tolist()
        job.normalised_depth = settings.depth_kind == "normalised"
        job.charbonnier = settings.color_kind == "charbonnier"
        for name in _NUMBERS:
            setattr(job, name, getattr(settings, name))
        d_image, d_depth, d_alpha = self._gradient_buffers(height, width)
        job.d_image, job.d_depth, job.d_alpha = d_image.data_ptr(), d_depth.data_ptr(), d_alpha.data_ptr()
        if self._library.ggslam_image_loss_evaluate(self._context.handle, self._workspace, ctypes.byref(job)):
            raise NativeCoreError(f"no memory for the loss of an image of {width}x{height} pixels")
        values = LossValues(
            job.total, job.color, job.l1, job.ssim, job.depth_term, job.opacity_term, job.depth_l1_m, job.psnr,
            int(job.valid_pixels),
        )  # fmt: skip
        return LossResult(values, d_image, d_depth, d_alpha, np.array(job.exposure_gradient).reshape(3, 2))

    def _gradient_buffers(self, height: int, width: int) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
        if self._gradients[1].shape != (height, width):
            self._gradients = (
                torch.empty(3, height, width), torch.empty(height, width), torch.empty(height, width)
            )  # fmt: skip
        return self._gradients


def _target_size(target: KeyframeImages) -> tuple[int, int]:
    color, depth = target.color, target.depth
    if color.ndim != 3 or color.shape[2] != 3 or color.dtype != np.uint8 or color.size == 0:
        raise RenderError(f"target color: expected uint8 [H, W, 3], found {color.dtype} {list(color.shape)}")
    height, width = color.shape[:2]
    if depth.shape != (height, width) or depth.dtype not in (np.uint16, np.float32):
        raise RenderError(
            f"target depth: expected uint16 or float32 [{height}, {width}] (the size of color), "
            f"found {depth.dtype} {list(depth.shape)}"
        )
    if not (np.isfinite(target.depth_scale) and target.depth_scale > 0):
        raise RenderError(f"depth_scale: expected a number above 0, found {target.depth_scale!r}")
    return height, width


def _exposure(target: KeyframeImages) -> np.ndarray:
    if target.exposure is None:
        return _IDENTITY
    exposure = np.asarray(target.exposure)
    if exposure.shape != (3, 2) or exposure.dtype.kind != "f" or not np.isfinite(exposure).all():
        raise RenderError(f"exposure: expected finite floats [3, 2], found {exposure.dtype} {exposure.tolist()}")
    return exposure


_IDENTITY = np.tile([1.0, 0.0], (3, 1))


def _check_rendered(name: str, tensor: torch.Tensor, shape: tuple[int, ...]) -> torch.Tensor:
    if tuple(tensor.shape) != shape or tensor.dtype != torch.float32 or tensor.device.type != "cpu":
        raise RenderError(
            f"rendered {name}: expected float32 {list(shape)} on the CPU (the size of the target), "
            f"found {tensor.dtype} {list(tensor.shape)} on {tensor.device}"
        )
    if not tensor.is_contiguous():
        raise RenderError(f"rendered {name}: expected a contiguous tensor, found strides {tensor.stride()}")
    return tensor
