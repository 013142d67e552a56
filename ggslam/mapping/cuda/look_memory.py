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
from ggslam.abi.cuda import BrightnessRatios, KeyframeLookJob, SeenLabelJob
from ggslam.cuda.transfers import Download
from ggslam.mapping.cuda.image_store import CudaKeyframeImages
from ggslam.mapping.cuda.insertion import Selection
from ggslam.mapping.cuda.vote_labels import CudaVoteLabels
from ggslam.rendering.cuda.pixel_terms import CudaPixelTerms
from ggslam.rendering.cuda.rasterizer import CudaRasterizer
from ggslam.rendering.exposure import ExposureTuning, exposure_of, is_enough
from ggslam.rendering.types import RenderBuffers
from ggslam.scene.gaussian_map import GaussianMap

LABEL_STRIDE: Final = 2
"""Objects are looked at on every so manyth pixel and row."""
_LEAST_WEIGHT: Final = 1e-3
"""Of a Gaussian that shows an object, in [0, 1]."""
_MOST_TERMS: Final = 48
"""Of a pixel."""
_RATIO_WORDS: Final = ctypes.sizeof(BrightnessRatios) // 4


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
        size, grid = kind.size, _grid_size(kind.size, LABEL_STRIDE)
        wanted = 4 + _RATIO_WORDS + kind.with_labels * (size[0] * size[1] + 2 * grid[0] * grid[1])
        block = _Block(wanted, device)
        self._fetch = block.fetch
        self.total, self._total = block.part(torch.int32, 1)
        """On the device: the number of Gaussians to insert, int32 [1]; another writes it."""
        self._short, self._was_short = block.part(torch.int32, 3)
        self._ratios, on_host = block.part(torch.int32, _RATIO_WORDS)
        self._found = BrightnessRatios.from_buffer(on_host)
        thin = _grid_size(size, ExposureTuning.stride)
        self._compared = thin[0] * thin[1]
        self._pixel_ratios = torch.empty(3 * self._compared * kind.with_colors, device=device)
        depth = torch.empty(0 if kind.with_labels else size, device=device)
        if kind.with_labels:
            depth, self._depth = block.part(torch.float32, *size)
            self._ids, self._shares = block.part(torch.int32, *grid), block.part(torch.float32, *grid)
            self._pixels = _grid_pixels(size, LABEL_STRIDE, device)
            self._terms = CudaPixelTerms.empty(len(self._pixels), _MOST_TERMS, rasterizer.library, device)
            self._votes = CudaVoteLabels(device, rasterizer.library)
            self._labels = SeenLabelJob(
                terms=self._terms.native(), pixels=address(self._pixels), ids=address(self._ids[0]),
                shares=address(self._shares[0]), min_weight=_LEAST_WEIGHT,
            )  # fmt: skip
        self.explained = torch.empty(size, device=device), depth
        """Alpha and depth in metres, float32 [H, W], of what the map explains."""
        self._job = self._new_job()

    def _new_job(self) -> KeyframeLookJob:
        """What all looks have in common."""
        (height, width), t, alpha = self.kind.size, ExposureTuning, self.explained[0]
        job = KeyframeLookJob(
            overflowed=address(self._rasterizer.last_overflowed), was_short=address(self._short),
            explained_alpha=address(alpha), explained_depth=address(self.explained[1]), height=height, width=width,
            device=alpha.device.index or 0, ratio_stride=t.stride, label_stride=LABEL_STRIDE, least_alpha=t.min_alpha,
            largest_depth_error=t.max_depth_error, dark=t.dark, bright=t.bright,
        )  # fmt: skip
        if self.kind.with_colors:
            job.pixel_ratios, job.ratios = address(self._pixel_ratios), address(self._ratios)
        if self.kind.with_labels:
            job.shares = address(self._shares[0])
        return job

    def see(
        self, gaussians: GaussianMap, view: RenderBuffers, images: CudaKeyframeImages, depth_unit: float,
        valid: torch.Tensor | None, selection: Selection,
    ) -> None:  # fmt: skip
        """Starts to look at what was rendered last, `view`, and then to choose what it lacks.

        Args:
            images: of the keyframe.
            depth_unit: of their depth, metres.
            valid: bool [H, W] on the device, where the keyframe shows something: elsewhere there is nothing to explain;
                None: everywhere.
            selection: of pixels that the view, as `explained`, does not explain; not started.
        """
        job, labels, rasterizer = self._job, None, self._rasterizer
        rendering = rasterizer.last_rendering.native
        job.stream = rendering.stream
        if self.kind.with_labels:
            self._labels.votes, self._labels.terms.stream = self._votes.job(gaussians), job.stream
            labels = ctypes.byref(self._labels)
        assert view.depth is not None
        job.image, job.depth, job.alpha = view.image.data_ptr(), view.depth.data_ptr(), view.alpha.data_ptr()
        job.measured_color, job.measured_depth = images.color.data_ptr(), images.depth.data_ptr()
        job.valid, job.units_per_metre = address(valid), 1 / depth_unit
        looks = ctypes.byref(rendering), labels, ctypes.byref(job), ctypes.byref(selection.job)
        rasterizer.library.call("see_map", *looks)

    # --- on the host -------------------------------------------------------------------------------------------------

    def fetch(self) -> tuple[int, bool]:
        """The number of Gaussians to insert, and whether the rendering lacks a part of what is in view; the host waits
        for them and for all that follows, which is good until the next `fetch`."""
        self._fetch()
        return int(self._total[0]), bool(self._was_short[0])

    def exposure(self) -> np.ndarray | None:
        """Of the keyframe against the map, as `SeenAgain.measure`."""
        if not is_enough(min(self._found.used), self._compared):
            return None
        return exposure_of(self._found.medians)

    def labels(self) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Objects, int32 [h, w], and their shares at every `LABEL_STRIDE`-th row and column, and depth [H, W]."""
        return self._ids[1], self._shares[1], self._depth



def _grid_size(size: tuple[int, int], stride: int) -> tuple[int, int]:
    return -(-size[0] // stride), -(-size[1] // stride)


def _grid_pixels(size: tuple[int, int], stride: int, device: torch.device) -> torch.Tensor:
    """Every `stride`-th pixel of every `stride`-th row, flat indices, int32 [P]."""
    pixels = torch.arange(size[0] * size[1], dtype=torch.int32, device=device).view(size)
    return pixels[::stride, ::stride].reshape(-1)
