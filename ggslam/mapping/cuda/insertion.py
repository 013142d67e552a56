# SPDX-License-Identifier: Apache-2.0
"""New Gaussians for a keyframe on an NVIDIA GPU: what `ggslam.mapping.cpu.insertion` does, by kernels.

The same Gaussians in the same order, to rounding, with two differences where holes are filled. The nearest pixel with
depth is found exactly, where the CPU takes the nearest by an approximate distance; among equally near ones either may
take another. And mean colours are rounded to the nearest of 256 levels, where OpenCV, for an even `fill_stride`, may
take the next.
"""

from __future__ import annotations

import ctypes
import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, Final

import numpy as np
import torch

from ggslam.abi.arrays import address
from ggslam.abi.cuda import BirthLabelJob, InsertionJob
from ggslam.cuda.library import CudaLibrary, library_and_device
from ggslam.cuda.memory import GrowingMemory
from ggslam.errors import RenderError
from ggslam.mapping.cuda.map_rows import MapRows
from ggslam.mapping.new_gaussians import NewGaussians
from ggslam.mapping.settings import InsertionSettings
from ggslam.rendering.types import check_pose
from ggslam.scene.camera import Camera
from ggslam.scene.gaussian_map import GaussianMap

_NUMBERS = ("alpha_threshold", "depth_tolerance_m", "depth_tolerance_relative", "scale_pixels", "flatness",
            "max_slope", "texture_threshold", "max_depth_m")  # fmt: skip
_SHAPES: Final = ("means", "quaternions", "log_scales")
_MOST_PIXELS: Final = 1 << 29
"""Most pixels of an image: the kernels number pixels and points for filling together in 31 bits."""


@dataclass(frozen=True)
class Selection:
    """Pixels that get a Gaussian.

    Attributes:
        job: for `CudaInsertion.build`.
        total: their number, int32 [1] on the device.
        library: the kernels.
    """

    job: InsertionJob
    total: torch.Tensor
    library: CudaLibrary

    def start(self) -> None:
        """Starts to choose the pixels."""
        self.library.call("insertion_select", ctypes.byref(self.job))


@dataclass(frozen=True)
class NewRows:
    """Gaussians that were inserted.

    Attributes:
        rows: of the map.
        pixels: address on the device of the flat indices of the pixels that they come from, int32 [M]; valid until the
            next insertion.
    """

    rows: slice
    pixels: int


class CudaInsertion:
    """Finds new Gaussians on torch's current stream; keeps scratch memory between keyframes. One instance serves one
    caller and one stream at a time.

    Args:
        device: CUDA device; None: the current one.
        library: the compiled kernels; None: those of the device, compiled if need be.

    Raises:
        MissingDependency: no CUDA device, or the kernels cannot be compiled.
        NativeCoreError: the compiled kernels do not fit this code.
    """

    def __init__(self, device: torch.device | str | None = None, library: CudaLibrary | None = None) -> None:
        self.library, self.device = library_and_device(device, library)
        self._memory = GrowingMemory(self.device)
        self._total = torch.empty(1, dtype=torch.int32, device=self.device)
        self._sizes: dict[tuple[int, ...], int] = {}  # of the workspace, for the last images and settings
        self.rows = MapRows(self.device, self.library)
        """Of maps that are inserted to."""

    def new_gaussians(self, *arguments: Any, **named: Any) -> NewGaussians[torch.Tensor]:
        """`selection` and `build`. Waits for the device once, for the number of Gaussians."""
        selection = self.selection(*arguments, **named)
        selection.start()
        return self.build(selection, int(selection.total.item()))

    def selection(
        self,
        color: torch.Tensor,
        depth: torch.Tensor,
        depth_scale: float,
        alpha: torch.Tensor | None,
        expected_depth: torch.Tensor | None,
        camera: Camera,
        T_world_camera: np.ndarray,
        settings: InsertionSettings,
        total: torch.Tensor | None = None,
    ) -> Selection:
        """What chooses, once it is started, what the map lacks: first the pixels that `find_unexplained` gives
        `new_gaussians`, then, if holes are filled, those of `fill_gaussians`. Valid until the next one; the images have
        to stay till `build`.

        Args:
            color: measured, uint8 [H, W, 3].
            depth: measured, uint16 [H, W], 0 = none.
            depth_scale: metres per unit of `depth`.
            alpha: rendered alpha, float32 [H, W]; None: the map is empty, so Gaussians are wanted everywhere.
            expected_depth: rendered expected depth, float32 [H, W], metres; not None unless `alpha` is.
            camera: intrinsics of the image size [H, W].
            T_world_camera: [4, 4], pose of the camera.
            total: int32 [1] on the device, is written; None: memory of this object.

        Raises:
            RenderError: an array has another shape, type or device, or a number is impossible.
        """
        self._check_images(color, depth, alpha, expected_depth, camera)
        if not (math.isfinite(depth_scale) and depth_scale > 0):
            raise RenderError(f"depth_scale: expected a number above 0, found {depth_scale!r}")
        job = self._job(camera, check_pose(T_world_camera, "T_world_camera"), settings)
        job.units_per_metre = 1 / depth_scale
        job.color, job.depth = color.data_ptr(), depth.data_ptr()
        job.alpha, job.rendered_depth = address(alpha), address(expected_depth)
        total = self._total if total is None else total
        job.total = total.data_ptr()
        key = (camera.height, camera.width, settings.fill_stride)
        if key not in self._sizes:
            self._sizes = {key: self.library.functions.ggslam_cuda_insertion_bytes(ctypes.byref(job))}
        job.workspace = self._memory.block("insertion", self._sizes[key]).data_ptr()
        return Selection(job, total, self.library)

    def build(self, selection: Selection, count: int) -> NewGaussians[torch.Tensor]:
        """The Gaussians of a selection, `count` being the number in its `total`."""
        job = selection.job
        job.count = count
        new = self._empty(count)
        for name in (*_SHAPES, "pixels"):
            setattr(job, name, getattr(new, name).data_ptr())
        job.colors, job.color_numbers, job.as_harmonics = new.rgb.data_ptr(), 3, 0
        self.library.call("insertion_build", ctypes.byref(job))
        return new

    def insert(
        self, selection: Selection, count: int, gaussians: GaussianMap, opacity: float, keyframe: int,
        births: Callable[[NewRows], BirthLabelJob] | None = None,
    ) -> NewRows:  # fmt: skip
        """The Gaussians of a selection, as of `build`, in a map: of one opacity, born at keyframe number `keyframe`,
        and with the first labels that `births` says, which is asked if there are any Gaussians."""
        logit = float(np.log(opacity / (1 - opacity)))
        rows, fill = self.rows.extend(gaussians, count, logit, keyframe)
        if count == 0:
            return NewRows(rows, 0)
        job, places = selection.job, self.rows.places(gaussians, rows.start)
        job.count = count
        for name in _SHAPES:
            setattr(job, name, places[name])
        job.colors, job.color_numbers, job.as_harmonics = places["sh"], 3 * (gaussians.sh_degree + 1) ** 2, 1
        job.pixels = self._memory.block("pixels", 4 * count).data_ptr()
        new = NewRows(rows, job.pixels)
        labels = None if births is None else ctypes.byref(births(new))
        self.library.call("insert_rows", ctypes.byref(fill), ctypes.byref(job), labels)
        return new

    def _job(self, camera: Camera, T_world_camera: np.ndarray, settings: InsertionSettings) -> InsertionJob:
        job = InsertionJob(
            device=self.device.index or 0, height=camera.height, width=camera.width, fx=camera.fx, fy=camera.fy,
            cx=camera.cx, cy=camera.cy, adaptive_stride=settings.adaptive_stride, fill_stride=settings.fill_stride,
        )  # fmt: skip
        job.rotation[:] = T_world_camera[:3, :3].reshape(-1).tolist()
        job.translation[:] = T_world_camera[:3, 3].tolist()
        for name in _NUMBERS:
            setattr(job, name, getattr(settings, name))
        job.stream = self.library.stream(self.device)
        return job

    def _empty(self, count: int) -> NewGaussians[torch.Tensor]:
        means, quaternions, log_scales, rgb = (torch.empty(count, n, device=self.device) for n in (3, 4, 3, 3))
        pixels = torch.empty(count, dtype=torch.int32, device=self.device)
        return NewGaussians(means, quaternions, log_scales, rgb, pixels)

    def _check_images(
        self, color: torch.Tensor, depth: torch.Tensor, alpha: torch.Tensor | None,
        expected_depth: torch.Tensor | None, camera: Camera,
    ) -> None:  # fmt: skip
        shape = (camera.height, camera.width)
        if camera.height * camera.width > _MOST_PIXELS:
            raise RenderError(f"insertion: expected at most {_MOST_PIXELS} pixels, found {list(shape)}")
        self._check("color", color, torch.uint8, (*shape, 3))
        self._check("depth", depth, torch.uint16, shape)
        if (alpha is None) != (expected_depth is None):
            raise RenderError("insertion: expected both or neither of alpha and expected_depth")
        if alpha is not None and expected_depth is not None:
            self._check("alpha", alpha, torch.float32, shape)
            self._check("expected_depth", expected_depth, torch.float32, shape)

    def _check(self, name: str, tensor: torch.Tensor, dtype: torch.dtype, shape: tuple[int, ...]) -> None:
        if tuple(tensor.shape) != shape or tensor.dtype != dtype or tensor.device != self.device:
            found = f"{tensor.dtype} {list(tensor.shape)} on {tensor.device}"
            raise RenderError(f"{name}: expected {dtype} {list(shape)} on {self.device}, found {found}")
        if not tensor.is_contiguous():
            raise RenderError(f"{name}: expected a contiguous tensor, found strides {tensor.stride()}")
