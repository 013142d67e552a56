# SPDX-License-Identifier: Apache-2.0
"""What new keyframes see of a map on a device, in memory that is used again: all that the host has to know of it lies
in one block and is fetched at once."""

from __future__ import annotations

import ctypes
from dataclasses import dataclass
from typing import Final

import numpy as np
import torch

from ggslam.abi.arrays import address
from ggslam.abi.cuda import KeyframeLookJob
from ggslam.cuda.transfers import Download
from ggslam.mapping.cuda.vote_labels import CudaVoteLabels
from ggslam.rendering.cuda.pixel_terms import CudaPixelTerms
from ggslam.rendering.cuda.rasterizer import CudaRasterizer
from ggslam.rendering.exposure import ExposureTuning
from ggslam.rendering.types import RenderBuffers
from ggslam.scene.gaussian_map import GaussianMap

LABEL_STRIDE: Final = 2
"""Objects are looked at on every so manyth pixel and row."""


@dataclass(frozen=True)
class LookKind:
    """What is looked at.

    Attributes:
        size: height and width of the keyframe's images.
        with_labels: whether the objects that the map shows are wanted.
        with_colors: whether its colours are.
    """

    size: tuple[int, int]
    with_labels: bool
    with_colors: bool


class _Block:
    """Numbers on a device, in several parts, that are fetched at once.

    Args:
        size: of all parts, 4 bytes each.
        device: where.
    """

    def __init__(self, size: int, device: torch.device) -> None:
        self._download = Download(size, device, torch.int32)
        self._used = 0
        self.fetch = self._download.fetch

    def part(self, dtype: torch.dtype, *shape: int) -> tuple[torch.Tensor, np.ndarray]:
        """The next part, int32 or float32: on the device, and as it was fetched last."""
        where = slice(self._used, self._used + int(np.prod(shape)))
        self._used = where.stop
        there, here = self._download.source[where], self._download.newest[where]
        return there.view(dtype).view(shape), here.view(np.dtype(str(dtype).removeprefix("torch."))).reshape(shape)


class LookMemory:
    """For looks of a kind.

    Args:
        rasterizer: that renders the map.
        kind: of the looks.
    """

    def __init__(self, rasterizer: CudaRasterizer, kind: LookKind) -> None:
        self._rasterizer, self.kind, device = rasterizer, kind, rasterizer.device
        size, thin, grid = kind.size, _thinned(kind.size, ExposureTuning.stride), _thinned(kind.size, LABEL_STRIDE)
        wanted = 4 + kind.with_colors * 5 * thin[0] * thin[1]
        wanted += kind.with_labels * (size[0] * size[1] + 2 * grid[0] * grid[1])
        block = _Block(wanted, device)
        self._fetch = block.fetch
        self.total, self._total = block.part(torch.int32, 1)
        """On the device: the number of Gaussians to insert, int32 [1]; another writes it."""
        self._short, self._was_short = block.part(torch.int32, 3)
        self._thinned: tuple[torch.Tensor, np.ndarray] | None = None
        if kind.with_colors:
            self._thinned = block.part(torch.float32, 5, *thin)
        depth = torch.empty(0 if kind.with_labels else size, device=device)
        if kind.with_labels:
            depth, self._depth = block.part(torch.float32, *size)
            self._ids, self._shares = block.part(torch.int32, *grid), block.part(torch.float32, *grid)
            self._pixels = _grid(size, LABEL_STRIDE, device)
            self._terms = CudaPixelTerms.empty(len(self._pixels), 48, rasterizer.library, device)
            self._votes = CudaVoteLabels(device, rasterizer.library)
        self.explained = torch.empty(size, device=device), depth
        """Alpha and depth in metres, float32 [H, W], of what the map explains."""

    def see(self, gaussians: GaussianMap, view: RenderBuffers, valid: torch.Tensor | None) -> None:
        """Starts to look at what was rendered last, `view`.

        Args:
            valid: bool [H, W] on the device, where the keyframe shows something: elsewhere there is nothing to explain;
                None: everywhere.
        """
        rasterizer, (height, width) = self._rasterizer, self.kind.size
        if self.kind.with_labels:
            self._terms.collect(rasterizer.last_rendering.native, self._pixels, _LEAST_WEIGHT)
            self._terms.label(self._votes.of(gaussians), self._ids[0], self._shares[0])
        job = KeyframeLookJob(
            image=address(view.image), depth=address(view.depth), alpha=address(view.alpha), valid=address(valid),
            overflowed=address(rasterizer.last_overflowed), was_short=address(self._short),
            stream=rasterizer.library.stream(rasterizer.device), device=rasterizer.device.index or 0, height=height,
            width=width, thin_stride=ExposureTuning.stride, label_stride=LABEL_STRIDE,
        )  # fmt: skip
        job.explained_alpha, job.explained_depth = map(address, self.explained)
        job.thinned = None if self._thinned is None else address(self._thinned[0])
        job.shares = address(self._shares[0]) if self.kind.with_labels else None
        rasterizer.library.call("keyframe_look", ctypes.byref(job))

    # --- on the host -------------------------------------------------------------------------------------------------

    def fetch(self) -> tuple[int, bool]:
        """The number of Gaussians to insert, and whether the rendering lacks a part of what is in view; the host waits
        for them and for all that follows, which is good until the next `fetch`."""
        self._fetch()
        return int(self._total[0]), bool(self._was_short[0])

    def thinned(self) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Colour [3, h, w], alpha and depth [h, w] at every `ExposureTuning.stride`-th row and column."""
        assert self._thinned is not None
        planes = self._thinned[1]
        return planes[:3], planes[3], planes[4]

    def labels(self) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Objects, int32 [h, w], and their shares at every `LABEL_STRIDE`-th row and column, and depth [H, W]."""
        return self._ids[1], self._shares[1], self._depth


_LEAST_WEIGHT: Final = 1e-3


def _thinned(size: tuple[int, int], stride: int) -> tuple[int, int]:
    return -(-size[0] // stride), -(-size[1] // stride)


def _grid(size: tuple[int, int], stride: int, device: torch.device) -> torch.Tensor:
    """Every `stride`-th pixel of every `stride`-th row, flat indices, int32 [P]."""
    pixels = torch.arange(size[0] * size[1], dtype=torch.int32, device=device).view(size)
    return pixels[::stride, ::stride].reshape(-1)
