# SPDX-License-Identifier: Apache-2.0
"""Which pixels of a keyframe's mask identity learning looks at: `ggslam.mapping.cpu.pixel_pool` on an NVIDIA GPU, by
kernels that are only started here."""

from __future__ import annotations

import ctypes

import torch

from ggslam.abi.cuda import PixelPoolJob
from ggslam.cuda.library import CudaLibrary
from ggslam.errors import RenderError
from ggslam.mapping.identity import IDS
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
        """What random numbers come from."""
        self._counts = torch.empty(2, IDS, dtype=torch.int32, device=device)
        self._per_pixel = torch.empty(2, IDS, dtype=torch.float64, device=device)

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
        odds = torch.empty(mask.numel(), dtype=torch.int64, device=self._device)
        pixels = torch.empty(wanted, dtype=torch.int32, device=self._device)
        weights = torch.empty(wanted, dtype=torch.float32, device=self._device)
        random = torch.rand(wanted, generator=self.generator, dtype=torch.float64, device=self._device)
        job = PixelPoolJob(
            mask=mask.data_ptr(), alias=alias.data_ptr(), counts=self._counts.data_ptr(),
            per_pixel=self._per_pixel.data_ptr(), odds=odds.data_ptr(), random=random.data_ptr(),
            pixels=pixels.data_ptr(), vote_weights=weights.data_ptr(), stream=self._library.stream(self._device),
            balance=settings.balance, boundary=settings.boundary, device=self._device.index or 0,
            height=mask.shape[0], width=mask.shape[1], drawn=wanted,
        )  # fmt: skip
        self._library.call("pixel_odds", ctypes.byref(job))
        sums = odds.cumsum(0)
        job.sums = sums.data_ptr()
        self._library.call("draw_pixels", ctypes.byref(job))
        return PixelPool(pixels, weights / weights.mean().clamp_min(1e-30))
