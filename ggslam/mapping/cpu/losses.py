# SPDX-License-Identifier: Apache-2.0
"""The loss of `ggslam.mapping.losses` with its gradients, in one call to the compiled core."""

from __future__ import annotations

import ctypes
from dataclasses import dataclass
from typing import Final

import numpy as np
import torch

from ggslam.abi.arrays import address
from ggslam.abi.core import ImageLossJob
from ggslam.errors import NativeCoreError, RenderError
from ggslam.mapping.losses import LOSS_WEIGHTS, LossGradients, LossTarget, LossValues, RenderedImages
from ggslam.mapping.settings import LossSettings
from ggslam.native.loader import NativeContext, load_library


@dataclass(frozen=True)
class CpuLossResult(LossGradients):
    """Loss and gradients. The tensors belong to the `CpuImageLoss` and are overwritten by its next evaluation.

    Attributes:
        values: the terms of the loss.
        exposure_gradient: d loss / d exposure, float64 [3, 2].
    """

    values: LossValues
    exposure_gradient: np.ndarray

    @property
    def psnr(self) -> float:
        """Short for `values.psnr`."""
        return self.values.psnr


class CpuImageLoss:
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

    def evaluate(
        self, rendered: RenderedImages, target: LossTarget[np.ndarray], settings: LossSettings
    ) -> CpuLossResult:
        """Loss and gradients of one view.

        Raises:
            RenderError: an array has another shape or type than `RenderedImages` and `LossTarget` say.
        """
        height, width = _target_size(target)
        job = ImageLossJob(height=height, width=width)
        for name, shape in (("image", (3, height, width)), ("depth", (height, width)), ("alpha", (height, width))):
            setattr(job, name, _check_rendered(name, getattr(rendered, name), shape).data_ptr())
        color, depth, valid = target.color, target.depth, target.valid
        pitch = _pitch(color, depth, valid)
        if pitch is None:
            color, depth = np.ascontiguousarray(color), np.ascontiguousarray(depth)
            valid = None if valid is None else np.ascontiguousarray(valid)
        job.target_row, job.target_step = pitch or (width, 1)
        job.target_color, job.target_depth = address(color), address(depth)
        job.target_depth_is_float = depth.dtype == np.float32
        job.target_valid = address(valid)
        job.depth_scale = target.depth_scale
        job.exposure[:] = _exposure(target).ravel().tolist()
        job.normalised_depth = settings.depth_kind == "normalised"
        job.charbonnier = settings.color_kind == "charbonnier"
        for name in LOSS_WEIGHTS:
            setattr(job, name, getattr(settings, name))
        d_image, d_depth, d_alpha = self._gradient_buffers(height, width)
        job.d_image, job.d_depth, job.d_alpha = d_image.data_ptr(), d_depth.data_ptr(), d_alpha.data_ptr()
        if self._library.ggslam_image_loss_evaluate(self._context.handle, self._workspace, ctypes.byref(job)):
            raise NativeCoreError(f"no memory for the loss of an image of {width}x{height} pixels")
        values = LossValues(
            job.total, job.color, job.l1, job.ssim, job.depth_term, job.opacity_term, job.depth_l1_m, job.psnr,
            int(job.valid_pixels),
        )  # fmt: skip
        exposure_gradient = np.array(job.exposure_gradient).reshape(3, 2)
        return CpuLossResult(d_image, d_depth, d_alpha, values, exposure_gradient)

    def _gradient_buffers(self, height: int, width: int) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
        if self._gradients[1].shape != (height, width):
            self._gradients = (
                torch.empty(3, height, width), torch.empty(height, width), torch.empty(height, width)
            )  # fmt: skip
        return self._gradients


def _target_size(target: LossTarget[np.ndarray]) -> tuple[int, int]:
    color, depth = target.color, target.depth
    if color.ndim != 3 or color.shape[2] != 3 or color.dtype != np.uint8 or color.size == 0:
        raise RenderError(f"target color: expected uint8 [H, W, 3], found {color.dtype} {list(color.shape)}")
    height, width = color.shape[:2]
    if depth.shape != (height, width) or depth.dtype not in (np.uint16, np.float32):
        raise RenderError(
            f"target depth: expected uint16 or float32 [{height}, {width}] (the size of color), "
            f"found {depth.dtype} {list(depth.shape)}"
        )
    if target.valid is not None and (target.valid.shape != (height, width) or target.valid.dtype != np.bool_):
        found = f"{target.valid.dtype} {list(target.valid.shape)}"
        raise RenderError(f"target valid: expected bool [{height}, {width}] (the size of color), found {found}")
    if not (np.isfinite(target.depth_scale) and target.depth_scale > 0):
        raise RenderError(f"depth_scale: expected a number above 0, found {target.depth_scale!r}")
    return height, width


def _pitch(color: np.ndarray, depth: np.ndarray, valid: np.ndarray | None) -> tuple[int, int] | None:
    """Pixels from one to that below it and to the next one, if the target's images lie in memory like one another and
    forwards: every n-th pixel of an image does, and is read where it lies."""
    row, step = color.strides[0] // 3, color.strides[1] // 3
    alike = color.strides == (3 * row, 3 * step, 1) and depth.strides == (depth.itemsize * row, depth.itemsize * step)
    alike = alike and (valid is None or valid.strides == (row, step))
    return (row, step) if alike and 1 <= step <= row <= _LONGEST_ROW else None


_LONGEST_ROW: Final = 1 << 15
"""Most pixels between two rows that the compiled core accepts."""


def _exposure(target: LossTarget[np.ndarray]) -> np.ndarray:
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
