# SPDX-License-Identifier: Apache-2.0
"""The loss of `ggslam.mapping.losses` on an NVIDIA GPU: the same values and gradients, by kernels that are only
started here.

Nothing waits for the device: the values stay there as a tensor until they are read, and the exposure is read
from the device, so that it can be optimised there. Sums have a fixed order: the result repeats bit for bit.
"""

from __future__ import annotations

import ctypes
from dataclasses import dataclass, fields

import numpy as np
import torch

from ggslam.abi.cuda import ImageLossJob
from ggslam.cuda.library import CudaLibrary, library_and_device
from ggslam.cuda.memory import ByKind, GrowingMemory
from ggslam.errors import RenderError
from ggslam.mapping.keyframe_exposures import KeyframeExposureTuning
from ggslam.mapping.losses import LOSS_WEIGHTS, LossGradients, LossTarget, LossValues, RenderedImages
from ggslam.mapping.settings import LossSettings
from ggslam.rendering.exposure import ExposureTuning

_VALUES = len(fields(LossValues))


@dataclass(frozen=True)
class CudaLossResult(LossGradients):
    """Loss and gradients on the device. The tensors belong to the `CudaImageLoss` and are overwritten by its next
    evaluation.

    Attributes:
        results: float64 [15], the numbers of `LossValues` in their order, then `exposure_gradient`.
    """

    results: torch.Tensor

    @property
    def exposure_gradient(self) -> torch.Tensor:
        """d loss / d exposure, float64 [3, 2]."""
        return self.results[_VALUES:].view(3, 2)

    def read_values(self) -> LossValues:
        """The terms of the loss. Waits for the device."""
        values = dict(zip((field.name for field in fields(LossValues)), self.results.tolist(), strict=False))
        return LossValues(**values | {"valid_pixels": int(values["valid_pixels"])})


class CudaImageLoss:
    """Evaluates the loss on torch's current stream; keeps scratch memory and gradient images between calls. One
    instance serves one caller and one stream at a time.

    Args:
        device: CUDA device; None: the current one.
        library: the compiled kernels; None: those of the device, compiled if need be.
        leaves_saturated: whether saturated pixels of targets that are brighter than the map are left out, as
            `KeyframeExposures.usable_pixels` does.

    Raises:
        MissingDependency: no CUDA device, or the kernels cannot be compiled.
        NativeCoreError: the compiled kernels do not fit this code.
    """

    def __init__(
        self, device: torch.device | str | None = None, library: CudaLibrary | None = None,
        leaves_saturated: bool = False,
    ) -> None:  # fmt: skip
        self.library, self.device = library_and_device(device, library)
        self._leaves_saturated = leaves_saturated
        self.memory = GrowingMemory(self.device)
        self._results = torch.empty(_VALUES + 6, dtype=torch.float64, device=self.device)
        self._sizes: dict[tuple[int, int, bool], int] = {}  # of the workspace
        self._images = ByKind(self._new_gradients)
        self._gradients = self._images.of((0, 0))

    def evaluate(
        self, rendered: RenderedImages, target: LossTarget[torch.Tensor], settings: LossSettings
    ) -> CudaLossResult:
        """Starts the evaluation of loss and gradients of one view.

        Raises:
            RenderError: an array has another shape, type or device than `RenderedImages` and `LossTarget` say.
        """
        job = self.plan(rendered, self._target_size(target), settings)
        job.depth_scale = target.depth_scale
        job.target_color, job.target_depth = target.color.data_ptr(), target.depth.data_ptr()
        job.target_depth_is_float = target.depth.dtype == torch.float32
        job.target_valid = None if target.valid is None else target.valid.data_ptr()
        job.exposure = None if target.exposure is None else target.exposure.data_ptr()
        job.stream = self.library.stream(self.device)
        self.library.call("image_loss", ctypes.byref(job))
        return self.result

    @property
    def result(self) -> CudaLossResult:
        """Where the last evaluation writes."""
        return CudaLossResult(*self._gradients, self._results)

    def plan(self, rendered: RenderedImages, size: tuple[int, int], settings: LossSettings) -> ImageLossJob:
        """An evaluation of images of `size` (height, width) without a target, and not started: `result` is where it
        will write, `memory` what it works in.

        Raises:
            RenderError: an image has another shape, type or device than `RenderedImages` says.
        """
        height, width = size
        job = ImageLossJob(height=height, width=width, device=self.device.index or 0)
        for name, shape in (("image", (3, height, width)), ("depth", (height, width)), ("alpha", (height, width))):
            tensor = getattr(rendered, name)
            self._check(f"rendered {name}", tensor, (torch.float32,), shape)
            setattr(job, name, tensor.data_ptr())
        job.normalised_depth = settings.depth_kind == "normalised"
        job.charbonnier = settings.color_kind == "charbonnier"
        if self._leaves_saturated:
            job.overexposed_gain = KeyframeExposureTuning.overexposed_gain
            job.saturated_from = 255 * ExposureTuning.bright
        for name in LOSS_WEIGHTS:
            setattr(job, name, getattr(settings, name))
        self._gradients = self._images.of((height, width))
        job.d_image, job.d_depth, job.d_alpha = (gradient.data_ptr() for gradient in self._gradients)
        job.results = self._results.data_ptr()
        case = height, width, job.dssim_weight > 0
        if case not in self._sizes:
            self._sizes[case] = self.library.functions.ggslam_cuda_image_loss_bytes(ctypes.byref(job))
        job.workspace = self.memory.block("loss", self._sizes[case]).data_ptr()
        return job

    def _new_gradients(self, size: tuple[int, int]) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
        height, width = size
        image = torch.empty(3, height, width, device=self.device)
        return image, torch.empty(height, width, device=self.device), torch.empty(height, width, device=self.device)

    def _target_size(self, target: LossTarget[torch.Tensor]) -> tuple[int, int]:
        height, width = target.color.shape[:2] if target.color.ndim == 3 and target.color.numel() else (0, 0)
        self._check("target color", target.color, (torch.uint8,), (height, width, 3))
        self._check("target depth", target.depth, (torch.uint16, torch.float32), (height, width))
        if target.valid is not None:
            self._check("target valid", target.valid, (torch.bool,), (height, width))
        if target.exposure is not None:
            self._check("exposure", target.exposure, (torch.float32,), (3, 2))
        if not (np.isfinite(target.depth_scale) and target.depth_scale > 0):
            raise RenderError(f"depth_scale: expected a number above 0, found {target.depth_scale!r}")
        return height, width

    def _check(self, name: str, tensor: torch.Tensor, types: tuple[torch.dtype, ...], shape: tuple[int, ...]) -> None:
        if tuple(tensor.shape) != shape or tensor.dtype not in types or tensor.device != self.device:
            expected = f"{' or '.join(map(str, types))} {list(shape)} on {self.device}"
            found = f"{tensor.dtype} {list(tensor.shape)} on {tensor.device}"
            raise RenderError(f"{name}: expected {expected}, found {found}")
        if not tensor.is_contiguous():
            raise RenderError(f"{name}: expected a contiguous tensor, found strides {tensor.stride()}")
