# SPDX-License-Identifier: Apache-2.0
"""Which pixels of a keyframe's mask identity learning looks at: `ggslam.mapping.cpu.pixel_pool` on an NVIDIA GPU, by
kernels that are only started here."""

from __future__ import annotations

import ctypes

import torch

from ggslam.abi.cuda import PixelPoolJob
from ggslam.cuda.library import CudaLibrary
from ggslam.cuda.memory import GrowingMemory
from ggslam.errors import RenderError
from ggslam.mapping.identity_settings import IdentitySettings
from ggslam.mapping.pixel_pool import PixelPool


class PixelDrawer:
    """Draws pixels of masks with the distribution of `draw_pool`, one by one. Where no labelled pixel lies at a
    boundary, all are drawn anywhere.

    Args:
        device: where masks are.
        library: the compiled kernels.
        seed: of the draw.
    """

    def __init__(self, device: torch.device, library: CudaLibrary, seed: int) -> None:
        self._device, self._library = device, library
        self.generator = torch.Generator(device).manual_seed(seed)
        """What other random numbers come from."""
        self._memory, self._draws = GrowingMemory(device), 0
        self.seed = int(self.generator.initial_seed())
        """Of the pixels."""

    def next_draw(self) -> int:
        """The number of the next draw of pixels: with the seed it tells which."""
        self._draws += 1
        return self._draws

    def draw(
        self, mask: torch.Tensor, alias: torch.Tensor, wanted: int, settings: IdentitySettings
    ) -> PixelPool[torch.Tensor]:
        """Draws labelled pixels, as `draw_pool`; unlabelled ones where nothing is labelled.

        Args:
            mask: uint16 [H, W] on the device; 0 is never drawn while there is anything else.
            alias: int32 [65536] on the device, what ids have become.
            wanted: how many; a pixel may come twice.

        Raises:
            RenderError: not such a mask.
        """
        fits = mask.dtype == torch.uint16 and mask.ndim == 2 and mask.numel() and mask.device == self._device
        if not fits or not mask.is_contiguous():
            raise RenderError(
                f"mask: expected a contiguous torch.uint16 [H, W] on {self._device}, found {mask.dtype} "
                f"{list(mask.shape)} on {mask.device}"
            )
        pixels = torch.empty(wanted, dtype=torch.int32, device=self._device)
        weights = torch.empty(wanted, dtype=torch.float32, device=self._device)
        job = PixelPoolJob(
            mask=mask.data_ptr(), alias=alias.data_ptr(), pixels=pixels.data_ptr(), vote_weights=weights.data_ptr(),
            stream=self._library.stream(self._device), balance=settings.balance, boundary=settings.boundary,
            seed=self.seed, draw=self.next_draw(), device=self._device.index or 0, height=mask.shape[0],
            width=mask.shape[1], drawn=wanted,
        )  # fmt: skip
        room = self._library.functions.ggslam_cuda_pixel_pool_bytes(ctypes.byref(job))
        job.workspace = self._memory.block("pool", room).data_ptr()
        self._library.call("draw_pixels", ctypes.byref(job))
        return PixelPool(pixels, weights)
