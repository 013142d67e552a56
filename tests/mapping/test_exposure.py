# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import pytest
import torch

from ggslam.errors import RenderError
from ggslam.mapping.cpu.losses import CpuImageLoss
from ggslam.mapping.exposure import ExposureAdam, identity_exposure
from ggslam.mapping.losses import LossTarget
from ggslam.mapping.settings import ExposureSettings, LossSettings
from ggslam.native.loader import NativeContext

TRUE = np.array([[0.85, 0.03], [1.1, -0.02], [0.95, 0.05]])


@dataclass
class View:
    image: torch.Tensor
    depth: torch.Tensor
    alpha: torch.Tensor


def fit(settings: ExposureSettings, steps: int = 500) -> np.ndarray:
    """Exposure found from a perfect rendering of a frame that was taken with exposure TRUE."""
    random = np.random.default_rng(0)
    image = random.random((3, 40, 50)).astype(np.float32)
    color = np.clip(255 * (TRUE[:, 0, None, None] * image + TRUE[:, 1, None, None]) + 0.5, 0, 255)
    ones = torch.ones(40, 50)
    target = LossTarget(color.transpose(1, 2, 0).astype(np.uint8), np.full((40, 50), 1000, np.uint16), 1e-3)
    loss, adam, exposure = CpuImageLoss(NativeContext(1)), ExposureAdam(settings), identity_exposure()
    for step in range(steps):
        seen = replace(target, exposure=exposure)
        result = loss.evaluate(View(torch.from_numpy(image), ones, ones), seen, LossSettings())
        exposure = adam.step(exposure, result.exposure_gradient, rate_factor=0.99**step)
    return exposure


def test_finds_the_exposure_of_a_frame() -> None:
    found = fit(ExposureSettings(enabled=True, rate=5e-3, regularization=0.0))
    assert np.abs(found - TRUE).max() < 0.02  # the clipped bright pixels cost a little


def test_regularization_pulls_to_the_identity() -> None:
    settings = [ExposureSettings(enabled=True, rate=5e-3, regularization=strength) for strength in (0.0, 0.5)]
    free, held = (fit(one, 300) for one in settings)
    assert (np.abs(held - identity_exposure()) < np.abs(free - identity_exposure())).all()


def test_without_evidence_it_returns_to_the_identity() -> None:
    adam = ExposureAdam(ExposureSettings(enabled=True, rate=5e-3, regularization=1e-2))
    exposure = identity_exposure() + 0.05
    for step in range(300):
        exposure = adam.step(exposure, np.zeros((3, 2)), rate_factor=0.98**step)
    assert np.abs(exposure - identity_exposure()).max() < 0.01


def test_broken_gradient_changes_nothing() -> None:
    adam = ExposureAdam(ExposureSettings())
    exposure = TRUE.copy()
    assert np.array_equal(adam.step(exposure, np.full((3, 2), np.nan)), TRUE) and adam.steps == 0


@pytest.mark.parametrize("shapes", [((2, 3), (3, 2)), ((3, 2), (6,))])
def test_wrong_shape_is_refused(shapes: tuple) -> None:
    with pytest.raises(RenderError, match=r"\[3, 2\]"):
        ExposureAdam(ExposureSettings()).step(np.zeros(shapes[0]), np.zeros(shapes[1]))
