# SPDX-License-Identifier: Apache-2.0
"""The CUDA rasterizer: the interface of `CpuRasterizer`, for tensors on an NVIDIA GPU.

Work is only started, on torch's current stream. The host waits once per rendering, and only for its projection: the
number of pairs of a Gaussian and an image tile has to be known to have made room for them. What follows is started
before that, with the room that the last rendering needed and some more, and repeated in the rare case that it was not
enough; so the device does not idle while the host waits.

With `waits=False` the host does not wait at all. Room is made by what earlier renderings needed; a rendering that
overflows it is flagged and counted on the device, and the training step on it has to be repeated.
"""

from __future__ import annotations

import ctypes
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch

from ggslam.abi import core as structures
from ggslam.abi.arrays import address
from ggslam.abi.cuda import AdamStep, Rendering, Sizes
from ggslam.cuda.library import CudaLibrary, library_and_device
from ggslam.cuda.memory import ByKind, GrowingMemory
from ggslam.errors import RenderError
from ggslam.rendering.adam import AdamSettings
from ggslam.rendering.arguments import (
    camera_view,
    check_projection,
    check_tensor,
    checked_parameters,
    gaussian_arrays,
    image_buffers,
    image_gradients,
    posed_view,
)
from ggslam.rendering.cuda.adam import AdamSteps
from ggslam.rendering.cuda.finished import Counter, FinishedRendering, MapState, target_pointers
from ggslam.rendering.cuda.pixel_terms import CudaPixelTerms
from ggslam.rendering.types import (
    LOW_PASS,
    PARAMETERS,
    Gaussians,
    GaussianTensors,
    ParameterGradients,
    RenderBuffers,
)
from ggslam.scene.camera import Camera
from ggslam.scene.gaussian_map import GaussianMap

_POSE_SHAPE = torch.Size([12])


@dataclass
class CudaGradients(ParameterGradients):
    """`Gradients` on the device. Sums are formed by atomic additions: the last digits differ from run to run.

    Attributes:
        twist: float64 [6] tensor on the device, d loss / d xi as in `Gradients`.
    """

    twist: torch.Tensor


@dataclass
class CudaStepResult:
    """`CpuStepResult` on the device.

    Attributes:
        twist: float64 [6] tensor on the device, the pose gradient, as in `CudaGradients`.
        touched: uint8 [N], 1 where the Gaussian was updated.
    """

    twist: torch.Tensor
    touched: torch.Tensor


class CudaRasterizer:
    """Renders Gaussians on a GPU and differentiates what it rendered. The rules are those of
    `ggslam.rendering.reference`.

    One rasterizer serves one caller and one stream at a time and holds the buffers of one rendering. Memory grows to
    the largest rendering and stays.

    Args:
        device: CUDA device; None: the current one.
        near_plane: metres; Gaussians whose mean is nearer are left out.
        low_pass: pixels^2 added to both variances of a projected Gaussian.
        library: the compiled rasterizer; None: that of the device, compiled if need be.
        waits: False: calls never wait for the device, except as long as nothing was ever in view, and `statistics`. A
            rendering with more pairs than room was made for then lacks the farthest Gaussians here and there in its
            images; differentiating it gives zero and touches nothing, so that a step with it changes nothing.

    Attributes:
        waits: as the argument; may be changed between renderings, for one whose images have to be complete.
        close_below: 0 at first; of the renderings that follow, as the argument of `CpuRasterizer.forward`. Renderings
            with median depth are drawn to their end.
        last_overflowed: int32 [1] on the device, 1 after a rendering that ran out of room, else 0. Of the last
            rendering in stream order; 0 after one that was waited for.
        overflows: int64 [1] on the device, how many renderings ran out of room so far.
        counter: of pairs.
        memory: that renderings work in.

    Raises:
        RenderError: an impossible near plane or low-pass filter.
        MissingDependency: no CUDA device, or the rasterizer cannot be compiled.
    """

    def __init__(
        self,
        device: torch.device | str | None = None,
        near_plane: float = 0.05,
        low_pass: float = LOW_PASS,
        library: CudaLibrary | None = None,
        waits: bool = True,
    ) -> None:
        check_projection(near_plane, low_pass)
        self.near_plane = near_plane
        self.low_pass = low_pass
        self.library, self.device = library_and_device(device, library)
        self.waits = waits
        self.close_below = 0.0
        self.last_overflowed = torch.zeros(1, dtype=torch.int32, device=self.device)
        self.overflows = torch.zeros(1, dtype=torch.int64, device=self.device)
        self.counter = Counter(self.library, self.device.index or 0)
        self._adam_steps = AdamSteps()
        self._planned: tuple[object, Sizes, int, int] = (None, Sizes(), 0, 0)
        self.memory = GrowingMemory(self.device)
        self._images: ByKind[tuple[int, int], dict[str, torch.Tensor]] = ByKind(lambda size: {})
        self._last: FinishedRendering | None = None

    # --- forward -------------------------------------------------------------------------------------------------

    def forward(
        self,
        gaussians: Gaussians,
        camera: Camera,
        T_camera_world: np.ndarray | torch.Tensor,
        *,
        features: bool = True,
        median_depth: bool = False,
        active_sh_degree: int | None = None,
    ) -> RenderBuffers:
        """Renders. Arguments, results and errors as `CpuRasterizer.forward`, tensors being on the rasterizer's device;
        the images belong to the rasterizer and are overwritten by its next call.

        Args:
            T_camera_world: float64 [4, 4]; or on the device, float32 [12], its first three rows, which nobody changes
                before the rendering is differentiated. Its numbers are not checked then, as that would mean to wait for
                them: where they are not finite, nothing is in view.
        """
        self._last = None
        self._last = self.render(
            gaussians, camera, T_camera_world, self.memory, self._images.of((camera.height, camera.width)),
            features=features, median_depth=median_depth, active_sh_degree=active_sh_degree,
        )  # fmt: skip
        return self._last.buffers

    def render(
        self,
        gaussians: Gaussians,
        camera: Camera,
        T_camera_world: np.ndarray | torch.Tensor,
        memory: GrowingMemory,
        images: dict[str, torch.Tensor],
        *,
        features: bool = True,
        median_depth: bool = False,
        active_sh_degree: int | None = None,
    ) -> FinishedRendering:
        """Renders in memory and images given by the caller (images are made where they do not fit), so that several
        renderings can wait to be differentiated."""
        if isinstance(T_camera_world, torch.Tensor):
            check_tensor("T_camera_world", T_camera_world, self.device, _POSE_SHAPE)
            pose, view = T_camera_world, camera_view(camera, self.near_plane, self.low_pass)
        else:
            pose, view = None, posed_view(camera, T_camera_world, self.near_plane, self.low_pass)
        parameters = self._parameters(gaussians)
        arrays = gaussian_arrays(parameters, features, active_sh_degree)
        view.close_below = 0.0 if median_depth else self.close_below
        channels = arrays.feature_channels if arrays.render_features else 0
        buffers = image_buffers(images, camera, channels, median_depth, self.device)
        rendering = self._describe(gaussians, parameters, arrays, view, buffers, pose)
        self._run(rendering, memory)
        return rendering

    def plan(self, gaussians: GaussianMap, camera: Camera, room: int) -> FinishedRendering:
        """A rendering without features that others start, for poses that they give: in the rasterizer's memory and
        images, with room for so many pairs. Once they do, what was rendered last cannot be differentiated any more."""
        parameters = self._parameters(gaussians)
        arrays, view = gaussian_arrays(parameters, False, None), camera_view(camera, self.near_plane, self.low_pass)
        view.close_below = self.close_below
        buffers = image_buffers(self._images.of((camera.height, camera.width)), camera, 0, False, self.device)
        rendering = self._describe(gaussians, parameters, arrays, view, buffers, None)
        sizes, memory = self._plan(rendering, room), self.memory
        rendering.use("gaussian_workspace", memory.block("gaussians", sizes.gaussian_workspace))
        rendering.use("pixel_workspace", memory.block("pixels", sizes.pixel_workspace))
        self._use_pairs(rendering, sizes, memory)
        return rendering

    def forget(self) -> None:
        """What was rendered last: its memory is used by others now."""
        self._last = None

    def _describe(
        self, gaussians: Gaussians, parameters: GaussianTensors, arrays: structures.GaussianArrays,
        view: structures.CameraView, buffers: RenderBuffers, pose: torch.Tensor | None,
    ) -> FinishedRendering:  # fmt: skip
        stream, index = self.library.stream(self.device), self.device.index or 0
        native = Rendering(arrays, view, address(pose), target_pointers(buffers), stream=stream, device=index)
        native.overflowed = self.last_overflowed.data_ptr()
        native.overflows = None if self.waits else self.overflows.data_ptr()
        rendering = FinishedRendering(parameters, buffers, native, pose)
        if isinstance(gaussians, GaussianMap):
            rendering.source = MapState.of(gaussians)
        return rendering

    def _run(self, rendering: FinishedRendering, memory: GrowingMemory) -> None:
        counter = self.counter
        room = counter.expected_pairs if self.waits else counter.room_without_waiting()
        # Blocks that grow free what kernels may still be working with. That does no harm: torch gives the memory away
        # again in the order of the stream, and all the work is on one stream.
        sizes = self._plan(rendering, room or 0)
        rendering.use("gaussian_workspace", memory.block("gaussians", sizes.gaussian_workspace))
        rendering.use("pixel_workspace", memory.block("pixels", sizes.pixel_workspace))
        if room is not None and not self.waits:
            self._use_pairs(rendering, sizes, memory)
            self.library.call("render", ctypes.byref(rendering.native), counter.handle)
            return
        self.library.call("project", ctypes.byref(rendering.native), counter.handle)
        if room is not None:
            self._composite(rendering, sizes, memory)
        rendering.visible, rendering.pairs = counter.wait()
        if room is None or rendering.pairs > room:
            self._composite(rendering, self._plan(rendering, rendering.pairs), memory)

    def _plan(self, rendering: FinishedRendering, pair_capacity: int) -> Sizes:
        """Sizes of the memory blocks for so many pairs; asks the library only if it is another case than the last."""
        native = rendering.native
        key = (*rendering.parameters.features.shape, native.gaussians.render_features, native.view.width,
               native.view.height, pair_capacity)  # fmt: skip
        if key != self._planned[0]:
            sizes = rendering.plan(self.library, pair_capacity)
            self._planned = (key, sizes, native.gaussian_sorting_bytes, native.pair_sorting_bytes)
        native.pair_capacity = pair_capacity
        _, sizes, native.gaussian_sorting_bytes, native.pair_sorting_bytes = self._planned
        return sizes

    def _use_pairs(self, rendering: FinishedRendering, sizes: Sizes, memory: GrowingMemory) -> None:
        rendering.gradient_bytes = sizes.gradient_rows
        rendering.use("pair_workspace", memory.block("pairs", sizes.pair_workspace))

    def _composite(self, rendering: FinishedRendering, sizes: Sizes, memory: GrowingMemory) -> None:
        self._use_pairs(rendering, sizes, memory)
        self.library.call("composite", ctypes.byref(rendering.native))

    def statistics(self) -> dict[str, int]:
        """Of the last forward: `visible` Gaussians and `pairs` of a Gaussian and an image tile. Waits for the device if
        the rendering did not."""
        visible, pairs = self.last_rendering.totals()
        return {"visible": visible, "pairs": pairs}

    def pixel_terms(self, pixels: torch.Tensor, capacity: int = 48, min_weight: float = 1e-3) -> CudaPixelTerms:
        """Which Gaussians some pixels of the last `forward` are made of, with their weights.

        Args:
            pixels: int32 [P] on the rasterizer's device, row * width + column. One outside the image gets no terms:
                to refuse it would mean to wait for the device.
            capacity: contributions kept of each pixel, from the front.
            min_weight: weaker contributions are left out.

        Raises:
            RenderError: nothing was rendered, pixels of another shape, type or device.
        """
        last = self.last_rendering
        if pixels.device != self.device:
            raise RenderError(f"pixels: expected a tensor on {self.device}, found one on {pixels.device}")
        return CudaPixelTerms.of_rendering(last.native, pixels, capacity, min_weight, self.library)

    # --- backward --------------------------------------------------------------------------------------------------

    def backward(
        self,
        grad_image: torch.Tensor | None,
        grad_depth: torch.Tensor | None = None,
        grad_alpha: torch.Tensor | None = None,
        grad_features: torch.Tensor | None = None,
        *,
        detach_features: bool = False,
    ) -> CudaGradients:
        """Gradients of a loss through the last `forward`; arguments and errors as `CpuRasterizer.backward`."""
        grads = (grad_image, grad_depth, grad_alpha, grad_features)
        return self.differentiate(self.last_rendering, grads, self.memory, detach_features=detach_features)

    def pose_gradient(
        self,
        grad_image: torch.Tensor | None,
        grad_depth: torch.Tensor | None = None,
        grad_alpha: torch.Tensor | None = None,
        grad_features: torch.Tensor | None = None,
    ) -> torch.Tensor:
        """Only the `twist` of `backward`; the gradients of the Gaussians are not written."""
        last = self.last_rendering
        grads = (grad_image, grad_depth, grad_alpha, grad_features)
        twist, touched = self._twist_and_touched(last)
        out = structures.GaussianGradients(twist=address(twist), touched=address(touched))
        self._differentiate(last, grads, self.memory, False, out)
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
    ) -> CudaStepResult:
        """`backward` and one Adam step in one pass, nothing of which the host waits for; arguments, effect and errors
        as `CpuRasterizer.backward_step`, the map being on the rasterizer's device."""
        last = self.last_rendering
        if last.source != MapState.of(map):
            for name in PARAMETERS:
                if (address(getattr(map, name)) or None) != getattr(last.native.gaussians, name):
                    raise RenderError(f"backward_step: the map's {name} are not those that were rendered last")
        adam = self._adam_steps.make(map, optimizer, self.device)
        twist, touched = self._twist_and_touched(last)
        out = structures.GaussianGradients(twist=address(twist), touched=address(touched))
        grads = (grad_image, grad_depth, grad_alpha, grad_features)
        self._differentiate(last, grads, self.memory, detach_features, out, adam)
        self._last = None  # the parameters change now, so there is nothing left to differentiate
        return CudaStepResult(twist, touched)

    def differentiate(
        self,
        rendering: FinishedRendering,
        grads: tuple[torch.Tensor | None, ...],
        memory: GrowingMemory,
        *,
        detach_features: bool = False,
    ) -> CudaGradients:
        """Gradients through a rendering of `render`.

        Args:
            grads: d loss / d image, depth, alpha, features; None counts as zero.
            memory: to work in, besides the rendering's own.
        """
        names = PARAMETERS if rendering.buffers.features is not None else PARAMETERS[:-1]
        arrays: dict[str, Any] = {name: torch.empty_like(getattr(rendering.parameters, name)) for name in names}
        twist, touched = self._twist_and_touched(rendering)
        out = structures.GaussianGradients(
            **{name: address(array) for name, array in arrays.items()}, twist=address(twist), touched=address(touched)
        )
        self._differentiate(rendering, grads, memory, detach_features, out)
        arrays.setdefault("features", None)
        return CudaGradients(**arrays, twist=twist, touched=touched)

    def _twist_and_touched(self, rendering: FinishedRendering) -> tuple[torch.Tensor, torch.Tensor]:
        count = rendering.parameters.means.shape[0]
        twist = torch.empty(6, dtype=torch.float64, device=self.device)
        return twist, torch.empty(count, dtype=torch.uint8, device=self.device)

    def _differentiate(
        self,
        rendering: FinishedRendering,
        grads: tuple[torch.Tensor | None, ...],
        memory: GrowingMemory,
        detach_features: bool,
        out: structures.GaussianGradients,
        adam: AdamStep | None = None,
    ) -> None:
        gradients = image_gradients(rendering.buffers, grads, detach_features, self.device)
        rendering.native.stream = self.library.stream(self.device)
        rows = memory.block("gradients", rendering.gradient_bytes)
        arguments = [ctypes.byref(value) for value in (rendering.native, gradients, out)]
        step = None if adam is None else ctypes.byref(adam)
        self.library.call("backward", *arguments, step, address(rows))

    # --- checks ------------------------------------------------------------------------------------------------------

    def _parameters(self, gaussians: Gaussians) -> GaussianTensors:
        if isinstance(gaussians, GaussianMap) and gaussians.device == self.device:  # shaped as it should by itself
            return GaussianTensors(*[getattr(gaussians, name) for name in PARAMETERS])
        return checked_parameters(gaussians, self.device)

    @property
    def last_rendering(self) -> FinishedRendering:
        """Of the last `forward`; raises RenderError if there is none."""
        if self._last is None:
            raise RenderError("there is no rendering to differentiate: call forward first (and again after every step)")
        return self._last
