# SPDX-License-Identifier: Apache-2.0
"""What one rendering on the GPU holds on to."""

from __future__ import annotations

import ctypes
import weakref
from dataclasses import dataclass, field
from typing import Final

import torch

from ggslam.abi import core as structures
from ggslam.abi.cuda import Rendering, Sizes
from ggslam.cuda.library import CudaLibrary
from ggslam.errors import RenderError
from ggslam.rendering.types import GaussianTensors, RenderBuffers
from ggslam.scene.gaussian_map import GaussianMap
from ggslam.system.tuning import Tuning

_TARGETS: Final = tuple(field_[0] for field_ in structures.RenderTargets._fields_)
_MAX_PAIRS: Final = 2**31 - 1
"""Largest number of pairs: kernels number them in 31 bits."""
_TOO_MANY_PAIRS: Final = (
    "rendering failed: too many pairs of a Gaussian and an image tile (2^31): "
    "the Gaussians are far too large for the image"
)


class PairRoomTuning(Tuning):
    """Room for pairs of a Gaussian and a tile."""

    step = 4096
    """The room is a multiple of this many pairs."""


class Counter:
    """Receives the number of visible Gaussians and of pairs of a Gaussian and a tile from the device, and tells how
    much room to make for the pairs of a rendering before their number is known.

    Args:
        library: the rasterizer.
        device_index: of the CUDA device.
    """

    def __init__(self, library: CudaLibrary, device_index: int) -> None:
        self._library = library
        self.handle = ctypes.c_void_p()
        self.expected_pairs: int | None = None
        """Room to make for pairs before their number is known, if that is going to be waited for; None: none."""
        self.spare_pairs = 1 << 16
        """Room that `room_without_waiting` adds to a quarter more than was needed."""
        self._needed = 0
        library.call("counter_create", device_index, ctypes.byref(self.handle))

    def wait(self) -> tuple[int, int]:
        """Visible Gaussians and pairs of the last projection; waits for that projection, not for what follows.

        Raises:
            RenderError: more pairs than can be numbered.
        """
        totals = (ctypes.c_int64 * 2)()
        self._library.call("wait", self.handle, totals)
        visible, pairs = totals
        if pairs > _MAX_PAIRS:
            raise RenderError(_TOO_MANY_PAIRS)
        self.expected_pairs = min(pairs + pairs // 16 + 4096, _MAX_PAIRS)
        return visible, pairs

    def room_without_waiting(self) -> int | None:
        """Room to make for the pairs of the next rendering by what the renderings needed that are done: somewhat more
        than the most of 64 of them; what was needed before that is forgotten over as many again. None while no pair
        was ever seen.

        Raises:
            RenderError: one of them had more pairs than can be numbered.
        """
        return self.room_for(self.recent_pairs())

    def recent_pairs(self) -> int:
        """The most pairs of the last 64 renderings that are done, or calls of training."""
        return self._library.functions.ggslam_cuda_recent_pairs(self.handle)

    def room_for(self, recent: int) -> int | None:
        """As `room_without_waiting`, given what `recent_pairs` says."""
        if recent > _MAX_PAIRS:
            raise RenderError(_TOO_MANY_PAIRS)
        self._needed = max(recent, self._needed - (self._needed - recent) // 64 - 1)
        if self._needed == 0:
            return None
        # Whole steps, so that the plan of the memory stays the same for a while.
        step = PairRoomTuning.step
        room = (self._needed + self._needed // 4 + self.spare_pairs + step - 1) // step * step
        return min(room, _MAX_PAIRS)

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
        pose: where the kernels read the pose; None: it is among the arguments.
        visible, pairs: number of Gaussians in view and of pairs of a Gaussian and an image tile; None: not known here.
        gradient_bytes: memory that differentiating it needs.
        memory: the blocks that the rendering works in.
    """

    parameters: GaussianTensors
    buffers: RenderBuffers
    native: Rendering
    pose: torch.Tensor | None = None
    visible: int | None = None
    pairs: int | None = None
    gradient_bytes: int = 0
    memory: dict[str, torch.Tensor] = field(default_factory=dict)
    source: MapState | None = None
    """Of the map that the parameters are the arrays of; None: they are of no map, or that is not known."""

    def plan(self, library: CudaLibrary, pair_capacity: int) -> Sizes:
        """Sizes of the memory blocks for so many pairs."""
        sizes = Sizes()
        self.native.pair_capacity = pair_capacity
        library.call("plan", ctypes.byref(self.native), ctypes.byref(sizes))
        return sizes

    def totals(self) -> tuple[int, int]:
        """Visible Gaussians and pairs; waits for the device if they are not known here."""
        if self.visible is None or self.pairs is None:
            # They are the first numbers of the Gaussians' workspace.
            self.visible, self.pairs = self.memory["gaussian_workspace"][:16].view(torch.int64).tolist()
        return self.visible, self.pairs

    def use(self, name: str, block: torch.Tensor) -> None:
        """Lets the rendering work in this block, one of Rendering's workspaces."""
        self.memory[name] = block
        setattr(self.native, name, block.data_ptr())


@dataclass(frozen=True)
class MapState:
    """Equal for two looks at a map if its arrays have the same rows at the same addresses."""

    map: weakref.ref[GaussianMap]
    version: int
    allocations: int

    @staticmethod
    def of(gaussians: GaussianMap) -> MapState:
        """As the map is now."""
        # The address of an array without rows is null, so not only allocations count.
        return MapState(weakref.ref(gaussians), gaussians.version, gaussians.allocations)


def target_pointers(buffers: RenderBuffers) -> structures.RenderTargets:
    """Addresses of the images."""
    images = [(name, getattr(buffers, name)) for name in _TARGETS]
    return structures.RenderTargets(**{name: image.data_ptr() for name, image in images if image is not None})
