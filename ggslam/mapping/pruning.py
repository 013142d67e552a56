# SPDX-License-Identifier: Apache-2.0
"""Removal of Gaussians that do no good."""

from __future__ import annotations

import math

import torch

from ggslam.mapping.settings import PruningSettings
from ggslam.scene.gaussian_map import GaussianMap


def prune(gaussians: GaussianMap, settings: PruningSettings) -> int:
    """Drops transparent, huge and non-finite Gaussians; returns how many.

    Transparency also catches floaters: a Gaussian in front of the surface hides what is measured behind it, so the
    colour and depth losses drive its opacity down in every keyframe that looks through it.
    """
    logit = math.log(settings.min_opacity / (1 - settings.min_opacity))
    largest = gaussians.log_scales.amax(1)
    good = (gaussians.opacity_logits > logit) & (largest < math.log(settings.max_scale_m))
    good &= torch.isfinite(gaussians.means).all(1)
    return gaussians.keep(good)
