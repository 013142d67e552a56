# SPDX-License-Identifier: Apache-2.0
"""Features that a frame shares with the last located ones: a witness of its pose that knows no wrong minimum.

Geometry has several: a frame half a step along a shelf overlaps as well as where it is. Grey values are compared
within some pixels of the true place alone. Matched features lie where they have to, or they do not.
"""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from ggslam.features.orb import FeatureSettings, FeatureView, ViewMatches, match_views
from ggslam.scene.camera import Camera

CONTRADICTED_BELOW = 0.3
"""A pose that explains less than this share of the features shared with the last located frame is contradicted."""
CLEARLY_FEWER = 0.7
"""Of two poses one is preferred if the other explains less than this share of what it does."""


class SharedFeatures:
    """What a view shares with earlier ones.

    Args:
        view: the frame.
        earlier: located frames, the latest first.
        camera: of all.
        settings: of features and their matches.
    """

    def __init__(
        self, view: FeatureView, earlier: list[FeatureView], camera: Camera, settings: FeatureSettings
    ) -> None:
        self._camera, self._settings = camera, settings
        self.matches: list[ViewMatches] = [match_views(view, known, camera, settings) for known in earlier]
        """With each of the earlier views."""

    def starts(self) -> Iterator[tuple[str, np.ndarray]]:
        """What most of the matches with each view agree on: a name and a pose [4, 4]."""
        for number, shared in enumerate(self.matches):
            pose = shared.pose(self._camera, self._settings)
            if pose is not None:
                yield f"features of view {number}", pose.T_world_camera

    def contradict(self, T_world_camera: np.ndarray) -> str:
        """Why a pose [4, 4] cannot be right; empty if it can, or if too little is shared with the last view to tell."""
        if not self.matches or len(self.matches[0]) < 2 * self._settings.min_inliers:
            return ""
        total, found = len(self.matches[0]), self.matches[0].explained(T_world_camera, self._camera, self._settings)
        if found >= CONTRADICTED_BELOW * total:
            return ""
        return f"{found} of {total} features shared with the last frame lie where this pose has them"

    def prefer(self, T_one: np.ndarray, T_other: np.ndarray) -> bool | None:
        """Whether one pose [4, 4] explains clearly more of the features than another; None: there is no clear
        difference."""
        one, other = (
            sum(shared.explained(T, self._camera, self._settings) for shared in self.matches) for T in (T_one, T_other)
        )
        if max(one, other) < self._settings.min_inliers or min(one, other) >= CLEARLY_FEWER * max(one, other):
            return None
        return one > other
