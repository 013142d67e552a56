# SPDX-License-Identifier: Apache-2.0
"""Protects Gaussians that the given keyframes hardly see from training on these keyframes.

A Gaussian behind a surface or beside an image still contributes a thousandth. The optimizer steps as far for a
thousandth as for a whole pixel, so that within a few hundred steps such Gaussians take any colour; other views, which
are not trained on, see it.
"""

from __future__ import annotations

from collections.abc import Iterable

import numpy as np
import torch

from ggslam.mapping.keyframe import Keyframe
from ggslam.scene.gaussian_map import GaussianMap
from ggslam.sight.margin import Margin, MarginTuning
from ggslam.sight.view import View

_KEPT = ("means", "quaternions", "log_scales", "opacity_logits", "sh", "features")


def find_seen(gaussians: GaussianMap, keyframes: Iterable[Keyframe], sigma: float) -> np.ndarray:
    """Whether a keyframe sees a Gaussian, bool [N]: its middle falls into the image, with nothing measured before it.

    Args:
        gaussians: the map, on the CPU.
        keyframes: with images.
        sigma: standard deviation of depth, metres.
    """
    means, margin = (
        gaussians.means.detach().numpy().astype(np.float64),
        Margin(sigmas=MarginTuning.sigmas, constant=sigma),
    )
    left, found = np.arange(len(means)), np.zeros(len(means), bool)
    for keyframe in keyframes:
        view = View.of(keyframe.depth_m(), keyframe.camera, keyframe.T_world_camera, margin)
        answers = view.classify_points(means[left])
        seen = answers.inside & ~answers.behind
        found[left[seen]] = True
        left = left[~seen]
    return found


class UnseenGaussians:
    """Remembers those that no keyframe sees.

    Args:
        gaussians, keyframes, sigma: see `find_seen`.
    """

    def __init__(self, gaussians: GaussianMap, keyframes: Iterable[Keyframe], sigma: float) -> None:
        self._map, self._order = gaussians, gaussians.order
        self._rows = torch.from_numpy(np.flatnonzero(~find_seen(gaussians, keyframes, sigma)))
        self._values = {name: getattr(gaussians, name)[self._rows].clone() for name in _KEPT}

    def __len__(self) -> int:
        return len(self._rows)

    def restore(self) -> None:
        """Brings them back as they were; none may have been removed or put elsewhere since."""
        assert self._map.order == self._order
        for name, values in self._values.items():
            getattr(self._map, name)[self._rows] = values
