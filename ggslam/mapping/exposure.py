# SPDX-License-Identifier: Apache-2.0
"""Exposure of one keyframe: an affine map of the rendered colour, corrected = gain * rendered + offset per channel."""

from __future__ import annotations

from typing import Annotated

import numpy as np

from ggslam.errors import RenderError
from ggslam.mapping.settings import ExposureSettings
from ggslam.rendering.exposure import identity_exposure
from ggslam.system.array_forms import Form
from ggslam.system.savable import savable

_IDENTITY = identity_exposure()


@savable(formerly="ggslam.mapping.cpu.exposure.ExposureAdam")
class ExposureAdam:
    """Adam (Kingma and Ba 2015) on gain and offset of one keyframe.

    It descends loss + regularization / 2 |exposure - anchor|^2: without the second term map and exposures could
    drift together, all keyframes darker and the map brighter, at no cost in the loss. The anchor is the identity, or
    what was measured when the keyframe was made, from where it starts: a step is at most 0.002 long and a keyframe is
    trained on some ten times, so that a change by half would never be reached. `measured` waits to become the anchor.
    """

    settings: ExposureSettings
    beta1: float
    beta2: float
    anchor: Annotated[np.ndarray, Form("f8", 3, 2, finite=True)]
    measured: Annotated[np.ndarray, Form("f8", 3, 2, finite=True)]
    first: Annotated[np.ndarray, Form("f8", 3, 2, finite=True)]
    second: Annotated[np.ndarray, Form("f8", 3, 2, finite=True)]
    steps: int

    def __init__(self, settings: ExposureSettings, beta1: float = 0.9, beta2: float = 0.99) -> None:
        self.settings, self.beta1, self.beta2 = settings, beta1, beta2
        self.anchor = identity_exposure()
        self.measured = identity_exposure()
        self.first, self.second, self.steps = np.zeros((3, 2)), np.zeros((3, 2)), 0

    @property
    def is_anchored(self) -> bool:
        """Whether the anchor is another than the identity."""
        return bool((self.anchor != _IDENTITY).any())

    def step(self, exposure: np.ndarray, gradient: np.ndarray, rate_factor: float = 1.0) -> np.ndarray:
        """The exposure after one step, float64 [3, 2].

        A gradient that is not finite is passed over: one broken view must not spoil the moments for good.

        Args:
            exposure: gain and offset per channel [3, 2].
            gradient: of the loss with respect to it [3, 2].
            rate_factor: multiplies the step size.

        Raises:
            RenderError: another shape.
        """
        for name, array in (("exposure", exposure), ("gradient", gradient)):
            if np.shape(array) != (3, 2):
                raise RenderError(f"{name}: expected [3, 2], found {list(np.shape(array))}")
        if not np.isfinite(gradient).all():
            return exposure
        gradient = gradient + self.settings.regularization * (exposure - self.anchor)
        self.steps += 1
        self.first += (1 - self.beta1) * (gradient - self.first)
        self.second += (1 - self.beta2) * (gradient**2 - self.second)
        first = self.first / (1 - self.beta1**self.steps)
        second = self.second / (1 - self.beta2**self.steps)
        return exposure - rate_factor * self.settings.rate * first / (np.sqrt(second) + 1e-12)
