# SPDX-License-Identifier: Apache-2.0
"""Coarse views of keyframes, which are looked at again whenever another keyframe comes."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from ggslam.mapping.keyframe import Keyframe
from ggslam.native.loader import NativeContext
from ggslam.scene.camera import Camera
from ggslam.sight.margin import Margin
from ggslam.sight.passed_voxels import KeptPlaces
from ggslam.sight.places import CoarseView


class KeyframeViews:
    """Keeps the views of the keyframes that were asked for last: a view changes only with its keyframe's depth."""

    def __init__(self) -> None:
        self._kept: dict[int, tuple[np.ndarray, KeptPlaces]] = {}  # by keyframe, with the depth image that each is of
        self._made_for: tuple[Camera, int, Margin] | None = None

    def of(
        self, keyframes: Sequence[Keyframe], camera: Camera, factor: int, margin: Margin, context: NativeContext
    ) -> list[KeptPlaces]:
        """Their views.

        Args:
            keyframes: with depth of the camera's size.
            camera: that they are taken to be of.
            factor: how many times the views are smaller.
            margin: see there.
            context: that they are computed in.
        """
        if self._made_for != (camera, factor, margin):
            self._kept, self._made_for = {}, (camera, factor, margin)
        before, self._kept = self._kept, {}
        for k in keyframes:
            kept = before.get(k.index)
            if kept is None or kept[0] is not k.depth:
                view = CoarseView.of(k.depth_m(), camera, factor, np.eye(4), margin, context)
                kept = k.depth, KeptPlaces(view)
            self._kept[k.index] = kept
        return [kept for _, kept in self._kept.values()]
