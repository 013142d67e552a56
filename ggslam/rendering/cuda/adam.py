# SPDX-License-Identifier: Apache-2.0
"""The arguments of the optimizer that is fused into the CUDA rasterizer's backward pass."""

from __future__ import annotations

import ctypes
import math

import torch

from ggslam.errors import RenderError
from ggslam.rendering import _native
from ggslam.rendering._native import ADAM_GROUPS, pointer
from ggslam.rendering.adam import AdamSettings
from ggslam.rendering.types import PARAMETERS
from ggslam.scene.gaussian_map import GaussianMap


class AdamStep(ctypes.Structure):
    """Mirror of struct AdamStep in kernels/adam.cuh."""

    _fields_ = [
        *((name, _native.AdamArrays) for name in PARAMETERS),
        ("updates", ctypes.c_void_p),
        ("rates", ctypes.c_float * len(ADAM_GROUPS)),
        ("decayed_groups", ctypes.c_int32),
        *((name, ctypes.c_float) for name in (
            "log_decay", "decay_floor", "beta1", "beta2", "log_beta1", "log_beta2", "epsilon")),
    ]  # fmt: skip


def adam_step(gaussians: GaussianMap, optimizer: AdamSettings, device: torch.device) -> AdamStep:
    """The step on a map's arrays, which the caller keeps alive.

    Raises:
        RenderError: the map has no moments, or its arrays are elsewhere than on `device`.
    """
    if not gaussians.moments:
        raise RenderError("backward_step: the map was made without moments")
    if gaussians.updates.device != device:
        raise RenderError(f"backward_step: expected a map on {device}, found one on {gaussians.updates.device}")

    def logarithm(factor: float) -> float:
        return math.log(factor) if factor > 0 else -math.inf

    step = AdamStep(
        updates=pointer(gaussians.updates),
        decayed_groups=sum(1 << bit for bit, name in enumerate(ADAM_GROUPS) if name in optimizer.decayed_groups),
        log_decay=logarithm(optimizer.decay), decay_floor=optimizer.decay_floor, beta1=optimizer.beta1,
        beta2=optimizer.beta2, log_beta1=logarithm(optimizer.beta1), log_beta2=logarithm(optimizer.beta2),
        epsilon=optimizer.epsilon,
    )  # fmt: skip
    step.rates[:] = [float(optimizer.learning_rates.get(name, 0.0)) for name in ADAM_GROUPS]
    for name, (first, second) in gaussians.moments.items():
        setattr(step, name, _native.AdamArrays(pointer(getattr(gaussians, name)), pointer(first), pointer(second)))
    return step
