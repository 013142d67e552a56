# SPDX-License-Identifier: Apache-2.0
"""What mapper and object masks exchange about a new keyframe."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field

import numpy as np

from ggslam.mapping.keyframe import Keyframe


@dataclass(frozen=True)
class MapLabels:
    """What the map shows from a new keyframe's pose before anything is inserted there.

    Attributes:
        ids: uint16 [H, W], object with the largest rendering weight by votes, 0 = none.
        confidence: float32 [H, W], its share of the pixel's weight, 0 where nothing is rendered.
        depth: float32 [H, W], metres, 0 = nothing.
    """

    ids: np.ndarray
    confidence: np.ndarray
    depth: np.ndarray

    @staticmethod
    def from_grid(ids: np.ndarray, share: np.ndarray, depth: np.ndarray, stride: int) -> MapLabels:
        """From ids and their shares on every `stride`-th pixel and row, [h, w]; depth [H, W]."""
        height, width = depth.shape

        def enlarge(image: np.ndarray) -> np.ndarray:
            return image.repeat(stride, 0).repeat(stride, 1)[:height, :width]

        return MapLabels(enlarge(np.where(share > 0, ids, 0).astype(np.uint16)), enlarge(share), depth)


@dataclass(frozen=True)
class KeyframeLabels:
    """The objects of a keyframe.

    Attributes:
        mask: uint16 [H, W], 0 = unlabelled; None: nothing is known.
        merges: (kept, dropped) objects that turned out to be one.
        splits: (whole, part): where the mask has the part, the map still shows the whole.
        forgotten: objects that were none.
    """

    mask: np.ndarray | None = None
    merges: list[tuple[int, int]] = field(default_factory=list)
    splits: list[tuple[int, int]] = field(default_factory=list)
    forgotten: list[int] = field(default_factory=list)


Labeller = Callable[[Keyframe, "Callable[[], MapLabels] | None"], KeyframeLabels]
"""Gives a new keyframe's objects. The second argument shows the map from there; None while the map is empty. Called
once, during insertion."""
