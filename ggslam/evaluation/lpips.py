# SPDX-License-Identifier: Apache-2.0
"""LPIPS v0.1 with AlexNet: a distance between images that follows human judgement (0 = same, lower is better).

R. Zhang et al., "The Unreasonable Effectiveness of Deep Features as a Perceptual Metric", CVPR 2018.
"""

from __future__ import annotations

from pathlib import Path
from typing import Final

import numpy as np
import torch
import torch.nn.functional as F

from ggslam.errors import InputError
from ggslam.evaluation.lpips_weights import find_weights, read_weights

SMALLEST_SIDE: Final = 31
"""Pixels of the smallest side of an image: AlexNet leaves nothing of smaller ones."""

_SHIFT: Final = (-0.030, -0.088, -0.188)
"""ImageNet's mean colour for images in [-1, 1], as in the reference code."""
_SCALE: Final = (0.458, 0.448, 0.450)
"""ImageNet's standard deviations, as in the reference code."""
_STRIDE_PADDING: Final = ((4, 2), (1, 2), (1, 1), (1, 1), (1, 1))
"""Stride and padding of AlexNet's convolutions."""
_POOLED_BEFORE: Final = (1, 2)
"""Convolutions whose input is max-pooled (3x3, stride 2)."""


class Lpips:
    """The metric, ready to be called; holds 10 MB of weights.

        lpips = Lpips()
        distance = lpips(rendered, photo)

    Args:
        weights: file of the weights; see `ggslam.evaluation.lpips_weights.find_weights` for where else they are sought.
        device: where to compute.

    Raises:
        MissingDependency: no weights; the message says how to get them.
        FormatError: the file has other contents than expected.
    """

    def __init__(self, weights: str | Path | None = None, device: torch.device | str = "cpu") -> None:
        arrays = read_weights(find_weights(weights))
        self.device = torch.device(device)

        def tensor(array: np.ndarray) -> torch.Tensor:
            return torch.from_numpy(np.ascontiguousarray(array)).to(self.device)

        layers = [arrays["AlexNet_0"][f"Conv_{i}"] for i in range(5)]
        self._kernels = [tensor(layer["kernel"].transpose(3, 2, 0, 1)) for layer in layers]  # [out, in, h, w]
        self._biases = [tensor(layer["bias"]) for layer in layers]
        self._heads = [tensor(arrays[f"NetLinLayer_{i}"]["Conv_0"]["kernel"].reshape(1, -1, 1, 1)) for i in range(5)]
        self._shift = torch.tensor(_SHIFT, device=self.device).view(1, 3, 1, 1)
        self._scale = torch.tensor(_SCALE, device=self.device).view(1, 3, 1, 1)

    @torch.inference_mode()
    def __call__(self, image: np.ndarray, reference: np.ndarray) -> float:
        """Distance of two RGB images [H, W, 3], each uint8 or floating point in [0, 1].

        Raises:
            InputError: shapes differ, or an image is smaller than 31 pixels.
        """
        if image.shape != reference.shape or image.ndim != 3 or image.shape[2] != 3:
            raise InputError(f"LPIPS needs two images [H, W, 3] of one size, found {image.shape}, {reference.shape}")
        if min(image.shape[:2]) < SMALLEST_SIDE:
            raise InputError(f"LPIPS needs images of at least {SMALLEST_SIDE} pixels, found {image.shape[:2]}")
        both = torch.stack([_to_signed(image), _to_signed(reference)]).permute(0, 3, 1, 2).to(self.device)
        x = (both - self._shift) / self._scale
        total = 0.0
        for layer in range(5):
            if layer in _POOLED_BEFORE:
                x = F.max_pool2d(x, 3, 2)
            stride, padding = _STRIDE_PADDING[layer]
            x = F.relu(F.conv2d(x, self._kernels[layer], self._biases[layer], stride, padding))
            unit = x / (x.square().sum(1, keepdim=True).sqrt() + 1e-10)
            total += float(((unit[0] - unit[1]).square() * self._heads[layer][0]).sum(0).mean())
        return total


def _to_signed(image: np.ndarray) -> torch.Tensor:
    """Image as float32 in [-1, 1]."""
    x = torch.tensor(np.ascontiguousarray(image))
    return x.float() / 127.5 - 1.0 if x.dtype == torch.uint8 else x.float() * 2.0 - 1.0
