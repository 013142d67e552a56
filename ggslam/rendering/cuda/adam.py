# SPDX-License-Identifier: Apache-2.0
"""The arguments of the optimizer that is fused into the CUDA rasterizer's backward pass."""

from __future__ import annotations

import math
from collections.abc import Mapping

import torch

from ggslam.abi.arrays import address
from ggslam.abi.core import AdamArrays
from ggslam.abi.cuda import AdamStep
from ggslam.errors import RenderError
from ggslam.rendering.adam import ADAM_GROUPS, AdamSettings
from ggslam.rendering.cuda.finished import MapState
from ggslam.rendering.types import PARAMETERS
from ggslam.scene.gaussian_map import GaussianMap


class AdamSteps:
    """Makes the steps' arguments, anew only as far as the map or the settings are others than at the last step."""

    def __init__(self) -> None:
        self._step = AdamStep()
        self._optimizer: AdamSettings | None = None
        self._map: MapState | None = None

    def make(self, gaussians: GaussianMap, optimizer: AdamSettings, device: torch.device) -> AdamStep:
        """The step on a map's arrays, which the caller keeps alive; valid until the next call.

        Raises:
            RenderError: the map has no moments, or its arrays are elsewhere than on `device`.
        """
        if not gaussians.with_moments:
            raise RenderError("backward_step: the map was made without moments")
        state = MapState.of(gaussians)
        if state != self._map:
            found = gaussians.storage["updates"].device
            if found != device:
                raise RenderError(f"backward_step: expected a map on {device}, found one on {found}")
            self._point_to(gaussians)
            self._map = state
        if optimizer is not self._optimizer:
            _set_numbers(self._step, optimizer)
            self._optimizer = optimizer
        return self._step

    def _point_to(self, gaussians: GaussianMap) -> None:
        storage = gaussians.storage
        self._step.updates = address(storage["updates"])
        for name in PARAMETERS:
            setattr(self._step, name, adam_arrays(storage, name))


def adam_arrays(storage: Mapping[str, torch.Tensor], name: str) -> AdamArrays:
    """A parameter of a map with moments, and these, in the map's `storage`."""
    first, second = storage[f"{name}.first"], storage[f"{name}.second"]
    return AdamArrays(storage[name].data_ptr(), first.data_ptr(), second.data_ptr())


def _set_numbers(step: AdamStep, optimizer: AdamSettings) -> None:
    def logarithm(factor: float) -> float:
        return math.log(factor) if factor > 0 else -math.inf

    def bits(groups: tuple[str, ...]) -> int:
        return sum(1 << bit for bit, name in enumerate(ADAM_GROUPS) if name in groups)

    step.rates[:] = [float(optimizer.learning_rates.get(name, 0.0)) for name in ADAM_GROUPS]
    step.decayed_groups, step.falling_groups = bits(optimizer.decayed_groups), bits(optimizer.falling_groups)
    step.fall_rate, step.fall_floor = 1 / optimizer.fall_updates, optimizer.fall_floor
    step.log_decay, step.decay_floor = logarithm(optimizer.decay), optimizer.decay_floor
    step.beta1, step.log_beta1 = optimizer.beta1, logarithm(optimizer.beta1)
    step.beta2, step.log_beta2 = optimizer.beta2, logarithm(optimizer.beta2)
    step.epsilon = optimizer.epsilon
