# SPDX-License-Identifier: Apache-2.0
"""The CPU rasterizer: differentiable splatting of Gaussians, compiled, deterministic for any number of threads."""

from __future__ import annotations

import ctypes
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch

from ggslam.abi import core as structures
from ggslam.abi.arrays import address
from ggslam.errors import CoreInputError, RenderError
from ggslam.native.loader import NativeContext, load_library
from ggslam.rendering.adam import AdamSettings
from ggslam.rendering.arguments import (
    check_projection,
    checked_parameters,
    gaussian_arrays,
    image_buffers,
    image_gradients,
    posed_view,
)
from ggslam.rendering.pixel_terms import CpuPixelTerms
from ggslam.rendering.types import (
    LOW_PASS,
    LOW_PASS_3DGS,
    PARAMETERS,
    Gaussians,
    GaussianTensors,
    Gradients,
    RenderBuffers,
)
from ggslam.scene.camera import Camera
from ggslam.scene.gaussian_map import GaussianMap

_CPU = torch.device("cpu")
_FAILURES = {
    1: "out of memory",
    2: "too many pairs of a Gaussian and an image tile (2^31): the Gaussians are far too large for the image",
}


@dataclass
class CpuStepResult:
    """What a fused backward and optimizer step leaves besides the updated map.

    Attributes:
        twist: float64 [6], the pose gradient, as in `Gradients`.
        touched: uint8 [N], 1 where the Gaussian was updated.
    """

    twist: np.ndarray
    touched: torch.Tensor


@dataclass
class _LastForward:
    """Keeps the arrays of the last forward alive: backward reads them again."""

    parameters: GaussianTensors
    arrays: structures.GaussianArrays
    buffers: RenderBuffers


class CpuRasterizer:
    """Renders Gaussians on the CPU and differentiates what it rendered last. The rules are those of
    `ggslam.rendering.reference`.

    One rasterizer serves one caller at a time and holds the buffers of one rendering. Memory grows to the largest
    rendering and stays.

    Args:
        threads, instruction_set: as in `NativeContext`.
        context: share this context instead of making one.
        near_plane: metres; Gaussians whose mean is nearer are left out.
        low_pass: pixels^2 added to both variances of a projected Gaussian.
    """

    def __init__(
        self,
        threads: int | None = None,
        instruction_set: str | None = None,
        context: NativeContext | None = None,
        near_plane: float = 0.05,
        low_pass: float = LOW_PASS,
    ) -> None:
        self._handle: ctypes.c_void_p | None = None
        self._library = load_library()
        self.context = context or NativeContext(threads, instruction_set)
        check_projection(near_plane, low_pass)
        self.near_plane = near_plane
        self.low_pass = low_pass
        self._handle = ctypes.c_void_p(self._library.ggslam_rasterizer_create(self.context.handle))
        self._images: dict[str, torch.Tensor] = {}
        self._last: _LastForward | None = None
        self.rendering = 0
        """Number of calls of `forward` so far: tells whether the last rendering is still the one that was meant."""

    def __del__(self) -> None:
        if self._handle is not None:
            self._library.ggslam_rasterizer_destroy(self._handle)

    # --- forward -------------------------------------------------------------------------------------------------

    def forward(
        self,
        gaussians: Gaussians,
        camera: Camera,
        T_camera_world: np.ndarray,
        *,
        features: bool = True,
        median_depth: bool = False,
        active_sh_degree: int | None = None,
        as_3dgs: bool = False,
        low_pass: float | None = None,
        close_below: float = 0.0,
    ) -> RenderBuffers:
        """Renders.

        Args:
            gaussians: float32 CPU tensors, contiguous, with the shapes of `Gaussians`.
            camera: the camera.
            T_camera_world: [4, 4], world to camera.
            features: render the feature channels, if there are any.
            median_depth: render the median depth, too.
            active_sh_degree: highest spherical-harmonic degree to evaluate; None: all.
            as_3dgs: draw as 3D Gaussian Splatting does: with its low-pass filter, alpha at most 0.99, and without the
                Gaussian that would take a pixel's transmittance below 1e-4. No features, no median depth, no backward.
            low_pass: this once another one than the rasterizer's.
            close_below: let the Gaussian that takes a pixel's transmittance below this, at most 0.5, take all that is
                left of it (alpha 0.999, as of rule 5), and none behind it; no median depth. 0: as in rule 6.

        Returns:
            Images that belong to the rasterizer and are overwritten by its next call of `forward`.

        Raises:
            RenderError: wrong shapes, dtypes or devices; an impossible pose or degree; out of memory; features,
                median depth or `close_below` with `as_3dgs`; median depth with `close_below`.
        """
        self._last = None
        self.rendering += 1
        parameters = checked_parameters(gaussians, _CPU)
        arrays = gaussian_arrays(parameters, features, active_sh_degree)
        low_pass = self.low_pass if low_pass is None else low_pass
        view = posed_view(camera, T_camera_world, self.near_plane, LOW_PASS_3DGS if as_3dgs else low_pass)
        channels = arrays.feature_channels if arrays.render_features else 0
        if as_3dgs and (channels or median_depth):
            raise RenderError("as_3dgs: neither features nor median depth can be rendered by the rules of 3DGS")
        if close_below and (as_3dgs or median_depth or not 0 < close_below <= 0.5):
            raise RenderError(f"close_below: must be 0 to 0.5, without median depth or as_3dgs, found {close_below}")
        view.close_below = close_below
        buffers = image_buffers(self._images, camera, channels, median_depth, _CPU)
        targets = structures.RenderTargets(
            **{field[0]: address(getattr(buffers, field[0])) for field in structures.RenderTargets._fields_}
        )
        status = self._library.ggslam_rasterizer_forward(
            self._handle, ctypes.byref(arrays), ctypes.byref(view), ctypes.byref(targets), int(as_3dgs)
        )
        self._check(status)
        self._last = None if as_3dgs else _LastForward(parameters, arrays, buffers)
        return buffers

    def statistics(self) -> dict[str, int]:
        """Of the last forward: `visible` Gaussians and `pairs` of a Gaussian and an image tile."""
        numbers = (ctypes.c_int64 * 2)()
        self._library.ggslam_rasterizer_statistics(self._handle, numbers)
        return {"visible": numbers[0], "pairs": numbers[1]}

    def pixel_terms(self, pixels: np.ndarray, capacity: int = 48, min_weight: float = 1e-3) -> CpuPixelTerms:
        """Which Gaussians some pixels of the last `forward` are made of, with their weights.

        Args:
            pixels: int [P], row * width + column.
            capacity: contributions kept of each pixel, from the front.
            min_weight: weaker contributions are left out.

        Raises:
            RenderError: nothing was rendered, a pixel outside the image, out of memory.
        """
        last = self._require_last()
        pixels = np.ascontiguousarray(pixels, np.int32)
        size = last.buffers.alpha.numel()
        if len(pixels) and (int(pixels.min()) < 0 or int(pixels.max()) >= size):
            raise RenderError(f"pixel_terms: pixels must be 0 to {size - 1}, found {pixels.min()} to {pixels.max()}")
        terms = CpuPixelTerms.empty(len(pixels), capacity, self.context)
        self._check(
            self._library.ggslam_rasterizer_pixel_terms(
                self._handle, pixels.ctypes.data, min_weight, ctypes.byref(terms.native())
            )
        )
        return terms

    def mark_shown(self, shown: np.ndarray, min_weight: float) -> None:
        """Marks the Gaussians that the last `forward` shows.

        Args:
            shown: bool [N], one for each of its Gaussians; becomes True for those that have the weight `min_weight` in
                any pixel.

        Raises:
            RenderError: nothing was rendered, `shown` of another type or shape.
        """
        self._require_last()
        if shown.dtype != np.bool_ or shown.ndim != 1 or not shown.flags.c_contiguous:
            raise RenderError(f"mark_shown: expected bool [N], found {shown.dtype} {list(shown.shape)}")
        try:
            self._library.ggslam_rasterizer_shown(self._handle, min_weight, len(shown), address(shown))
        except CoreInputError as error:
            raise RenderError(f"mark_shown: {error}") from error

    # --- backward --------------------------------------------------------------------------------------------------

    def backward(
        self,
        grad_image: torch.Tensor | None,
        grad_depth: torch.Tensor | None = None,
        grad_alpha: torch.Tensor | None = None,
        grad_features: torch.Tensor | None = None,
        *,
        detach_features: bool = False,
    ) -> Gradients:
        """Gradients of a loss through the last `forward`, whose parameters must not have changed since.

        Args:
            grad_image, grad_depth, grad_alpha, grad_features: d loss / d image, of the shapes of the rendered images,
                float32; None counts as zero.
            detach_features: let the gradients of the feature channels reach the features only, not geometry, opacity
                and pose.

        Raises:
            RenderError: nothing was rendered, wrong shapes or dtypes, out of memory.
        """
        last = self._require_last()
        given = (grad_image, grad_depth, grad_alpha, grad_features)
        grads = image_gradients(last.buffers, given, detach_features, _CPU)
        names = PARAMETERS if last.arrays.render_features else PARAMETERS[:-1]
        arrays: dict[str, Any] = {name: torch.empty_like(getattr(last.parameters, name)) for name in names}
        twist = np.zeros(6)
        touched = torch.empty(last.arrays.count, dtype=torch.uint8)
        out = structures.GaussianGradients(
            **{name: address(array) for name, array in arrays.items()},
            twist=twist.ctypes.data,
            touched=address(touched),
        )
        self._run_backward(grads, out, None)
        arrays.setdefault("features", None)
        return Gradients(**arrays, twist=twist, touched=touched)

    def pose_gradient(
        self,
        grad_image: torch.Tensor | None,
        grad_depth: torch.Tensor | None = None,
        grad_alpha: torch.Tensor | None = None,
        grad_features: torch.Tensor | None = None,
    ) -> np.ndarray:
        """Only the `twist` of `backward`; the gradients of the Gaussians are not written."""
        last = self._require_last()
        given = (grad_image, grad_depth, grad_alpha, grad_features)
        grads = image_gradients(last.buffers, given, False, _CPU)
        twist = np.zeros(6)
        touched = torch.empty(last.arrays.count, dtype=torch.uint8)
        out = structures.GaussianGradients(twist=twist.ctypes.data, touched=address(touched))
        self._run_backward(grads, out, None)
        return twist

    def backward_step(
        self,
        map: GaussianMap,
        grad_image: torch.Tensor | None,
        grad_depth: torch.Tensor | None = None,
        grad_alpha: torch.Tensor | None = None,
        grad_features: torch.Tensor | None = None,
        *,
        optimizer: AdamSettings,
        detach_features: bool = False,
    ) -> CpuStepResult:
        """`backward` and one Adam step in one pass: parameters, moments and update counts of the Gaussians that
        contributed are changed in place; those of the others stay as they are. No gradient array is written.

        Args:
            map: the map that was rendered by the last `forward`, unchanged since, with moments.
            optimizer: learning rates and the like.
            Others: as in `backward`. Features that were not rendered are not updated.

        Raises:
            RenderError: as in `backward`; the map is not the one rendered last or has no moments.
        """
        last = self._require_last()
        for name in PARAMETERS:
            if getattr(map, name).data_ptr() != getattr(last.parameters, name).data_ptr():
                raise RenderError(f"backward_step: the map's {name} are not those that were rendered last")
        if not map.moments:
            raise RenderError("backward_step: the map was made without moments")
        given = (grad_image, grad_depth, grad_alpha, grad_features)
        grads = image_gradients(last.buffers, given, detach_features, _CPU)
        schedule = optimizer.schedule()
        adam = structures.AdamArguments(
            updates=address(map.updates), schedule=address(schedule), schedule_rows=schedule.shape[0],
            beta1=optimizer.beta1, beta2=optimizer.beta2, epsilon=optimizer.epsilon,
        )  # fmt: skip
        if map.compact_features and grad_features is not None:
            raise RenderError("backward_step: the moments of the map's features are compact")
        for name, (first, second) in map.moments.items():
            setattr(adam, name, structures.AdamArrays(address(getattr(map, name)), address(first), address(second)))
        twist = np.zeros(6)
        touched = torch.empty(last.arrays.count, dtype=torch.uint8)
        out = structures.GaussianGradients(twist=twist.ctypes.data, touched=address(touched))
        self._last = None  # the parameters change now, so there is nothing left to differentiate
        self._run_backward(grads, out, adam)
        return CpuStepResult(twist, touched)

    def _run_backward(
        self,
        image_gradients: structures.ImageGradients,
        out: structures.GaussianGradients,
        adam: structures.AdamArguments | None,
    ) -> None:
        status = self._library.ggslam_rasterizer_backward(
            self._handle,
            ctypes.byref(image_gradients),
            ctypes.byref(out),
            None if adam is None else ctypes.byref(adam),
        )
        self._check(status)

    def _require_last(self) -> _LastForward:
        if self._last is None:
            raise RenderError("there is no rendering to differentiate: call forward first (and again after every step)")
        return self._last

    @staticmethod
    def _check(status: int) -> None:
        if status != 0:
            raise RenderError(f"rendering failed: {_FAILURES[status]}")
