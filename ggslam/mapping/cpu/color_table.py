# SPDX-License-Identifier: Apache-2.0
"""Objects as colours: each id has a fixed one, a Gaussian learns that of its object, and the nearest colour tells it.

As in SGS-SLAM (Li et al., 2024): semantic colours are rendered like colours and compared with the mask's in L1. Here
they are the first three channels of the identity vector, less the grey of what has no object. The nearest of the
colours and that grey is then a linear classifier, so that whatever reads identity vectors reads these, too: with d the
difference of a class's colour from grey, |f - d|^2 is least where 2 d f - |d|^2 is greatest, and 0 for grey.
"""

from __future__ import annotations

from typing import Final

import numpy as np

from ggslam.mapping.cpu.class_table import CpuClassTable
from ggslam.scene.id_colors import id_palette
from ggslam.scene.identity import IdentityClassifier, IdentityVectorTuning
from ggslam.system.savable import savable
from ggslam.system.tuning import Tuning

COLOR_CHANNELS: Final = 3
"""Channels of the identity vector that hold a colour."""


class ColorTableTuning(Tuning):
    """The classifier of colours."""

    sharpness = 200.0
    """Logit per squared distance in colour, whose channels are 0 to 1."""


@savable(check="check")
class ColorTable(CpuClassTable):
    """A class table whose rows say which colour is nearest, and are not trained."""

    def add(self, object_ids: np.ndarray) -> None:
        super().add(object_ids)
        codes, sharpness = self.codes(self._numbers.ids), ColorTableTuning.sharpness
        rows = self._rows[: self.count]
        rows[:, :-1] = 2 * sharpness * codes
        rows[:, -1] = IdentityVectorTuning.nothing_logit - sharpness * (codes**2).sum(1)

    def resume(self, classifier: IdentityClassifier) -> None:
        self.add(classifier.class_ids)

    def codes(self, object_ids: np.ndarray) -> np.ndarray:
        palette = id_palette()
        codes = np.zeros((len(object_ids), self._channels), np.float32)
        codes[:, :COLOR_CHANNELS] = (palette[object_ids].astype(np.float32) - palette[0]) / 255
        return codes * (self._numbers.of(object_ids) >= 0)[:, None]

    def step(self, classes: np.ndarray, gradient: np.ndarray, rate: float) -> None:
        """Nothing: colours stay."""


def color_loss(features: np.ndarray, codes: np.ndarray) -> tuple[float, np.ndarray]:
    """Mean absolute difference of rendered colours from those of their objects, and its gradient.

    Args:
        features: rendered vectors, float32 [P, F].
        codes: of the objects, float32 [P, F].

    Returns:
        The mean, and its gradient by the features, float32 [P, F].
    """
    difference = features[:, :COLOR_CHANNELS] - codes[:, :COLOR_CHANNELS]
    gradient = np.zeros_like(features)
    gradient[:, :COLOR_CHANNELS] = np.sign(difference) / max(1, difference.size)
    return float(np.abs(difference).mean()) if difference.size else 0.0, gradient
