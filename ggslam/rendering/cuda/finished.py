# SPDX-License-Identifier: Apache-2.0
"""What one rendering on the GPU holds on to."""

from __future__ import annotations

import ctypes
from dataclasses import dataclass, field

import torch

from ggslam.cuda.library import CudaLibrary
from ggslam.rendering import _native
from ggslam.rendering._native import pointer
from ggslam.rendering.cuda.contract import Rendering, Sizes
from ggslam.rendering.types import GaussianTensors, RenderBuffers


class Counter:
    """Receives the number of visible Gaussians and of pairs of a Gaussian and a tile from the device.

    Args:
        library: the rasterizer.
        device_index: of the CUDA device.
    """

    def __init__(self, library: CudaLibrary, device_index: int) -> None:
        self._library = library
        self.handle = ctypes.c_void_p()
        self.expected_pairs: int | None = None
        """Room to make for pairs before their number is known; None: wait for it."""
        library.call("counter_create", device_index, ctypes.byref(self.handle))

    def wait(self) -> tuple[int, int]:
        """Visible Gaussians and pairs of the last projection; waits for that projection, not for what follows."""
        totals = (ctypes.c_int64 * 2)()
        self._library.call("wait", self.handle, totals)
        return totals[0], totals[1]

    def __del__(self) -> None:
        if self.handle:
            self._library.functions.ggslam_cuda_counter_destroy(self.handle)


@dataclass
class FinishedRendering:
    """A rendering that can be differentiated as long as this is kept and its parameters stay as they were.

    Attributes:
        parameters: what was rendered.
        buffers: the images.
        native: the arguments of the C functions; its pointers lead into the tensors here.
        visible: number of Gaussians in view.
        pairs: number of pairs of a Gaussian and an image tile.
        gradient_bytes: memory that differentiating it needs.
        memory: the blocks that the rendering works in.
    """

    parameters: GaussianTensors
    buffers: RenderBuffers
    native: Rendering
    visible: int = 0
    pairs: int = 0
    gradient_bytes: int = 0
    memory: dict[str, torch.Tensor] = field(default_factory=dict)

    def plan(self, library: CudaLibrary, pair_capacity: int) -> Sizes:
        """Sizes of the memory blocks for so many pairs."""
        sizes = Sizes()
        self.native.pair_capacity = pair_capacity
        library.call("plan", ctypes.byref(self.native), ctypes.byref(sizes))
        return sizes

    def use(self, name: str, block: torch.Tensor) -> None:
        """Lets the rendering work in this block, one of Rendering's workspaces."""
        self.memory[name] = block
        setattr(self.native, name, pointer(block))


def target_pointers(buffers: RenderBuffers) -> _native.RenderTargets:
    """Addresses of the images."""
    names = [field_[0] for field_ in _native.RenderTargets._fields_]
    return _native.RenderTargets(**{name: pointer(getattr(buffers, name)) for name in names})
