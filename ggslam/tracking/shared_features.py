# SPDX-License-Identifier: Apache-2.0
"""Features that a frame shares with the last located frames. They check a pose without local minima.

Geometry has several: a frame half a step along a shelf overlaps as well as where it is. Grey values are compared
within some pixels of the true place alone. Matched features lie where they have to, or they do not.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator

import numpy as np

from ggslam.features.orb import FeaturePose, FeatureSettings, FeatureView, ViewMatches, match_views
from ggslam.scene.camera import Camera
from ggslam.system.tuning import Tuning


class SharedFeatureTuning(Tuning):
    """When features confirm or contradict a pose."""

    contradicted_below = 0.4
    """Share of the features shared with the last located frame, and of those explained by another pose, below which a
    pose is contradicted."""
    jump_slack = 3.0
    """Distance of a feature, in limits, that contradicts a pose also in a fast turn, when colour and depth are out of
    step."""
    confirmed_share = 0.5
    """Smallest share of the features shared with a view that a confirmed pose explains."""
    confirmed_factor = 3
    """Fewest features that a confirmed pose explains, in multiples of those that make a pose..."""
    confirmed_cells = 4
    """...in at least this many parts of the image, so that one moving thing confirms nothing."""
    cells = 4
    """Parts of the image along each axis."""
    clearly_fewer = 0.7
    """A pose is clearly worse if it explains less than this share of the features that another explains."""


class SharedFeatures:
    """Features shared with earlier views. A view is matched only when the ones before it did not suffice.

    Args:
        view: the frame.
        earlier: located frames, the latest first.
        camera: of all.
        settings: of features and their matches.
    """

    def __init__(
        self, view: FeatureView, earlier: list[FeatureView], camera: Camera, settings: FeatureSettings
    ) -> None:
        self._view, self._earlier, self._camera, self._settings = view, earlier, camera, settings
        self._matches: dict[int, ViewMatches] = {}
        self._poses: dict[int, FeaturePose | None] = {}

    def starts(self) -> Iterator[tuple[str, np.ndarray]]:
        """What most of the matches with each view agree on: a name and a pose [4, 4]."""
        for number in range(len(self._earlier)):
            pose = self._pose(number)
            if pose is not None:
                yield f"features of view {number}", pose.T_world_camera

    def _match(self, number: int) -> ViewMatches:
        """What is shared with an earlier view."""
        if number not in self._matches:
            self._matches[number] = match_views(self._view, self._earlier[number], self._camera, self._settings)
        return self._matches[number]

    def _all(self) -> Iterator[ViewMatches]:
        return (self._match(number) for number in range(len(self._earlier)))

    def _pose(self, number: int) -> FeaturePose | None:
        """What most of the matches with an earlier view agree on."""
        if number not in self._poses:
            self._poses[number] = self._match(number).pose(self._camera, self._settings)
        return self._poses[number]

    def contradict(self, T_world_camera: np.ndarray, slack: float = 1.0) -> str:
        """Why a pose [4, 4] cannot be right: another one explains far more of what the view shares with the last one.
        Empty if it can, or if too little is shared to tell; `slack` widens the limit within which it explains them."""
        if not self._earlier:
            return ""
        shared, needed = self._match(0), 2 * self._settings.min_inliers
        found = shared.count_explained(T_world_camera, self._camera, self._settings, slack)
        if len(shared) < needed or found >= SharedFeatureTuning.contradicted_below * len(shared):
            return ""
        best = self._pose(0)
        if best is None or best.inliers < needed or found >= SharedFeatureTuning.contradicted_below * best.inliers:
            return ""
        return (
            f"{found} of {len(shared)} features shared with the last frame lie where this pose has them, "
            f"{best.inliers} with another"
        )

    def vouch(self, T_world_camera: np.ndarray) -> bool:
        """Whether a pose [4, 4] is right without further witnesses: most of what the view shares with an earlier one,
        all over the image, lies where this pose has it."""
        return any(self._vouches(shared, T_world_camera) for shared in self._all())

    @property
    def could_vouch(self) -> bool:
        """Whether enough is shared with the last view to vouch for a pose."""
        return (
            bool(self._earlier)
            and len(self._match(0)) >= SharedFeatureTuning.confirmed_factor * self._settings.min_inliers
        )

    def _vouches(self, shared: ViewMatches, T_world_camera: np.ndarray) -> bool:
        explained = shared.which_agree(T_world_camera, self._camera, self._settings)
        needed = max(
            SharedFeatureTuning.confirmed_factor * self._settings.min_inliers,
            SharedFeatureTuning.confirmed_share * len(shared),
        )
        if explained.sum() < needed:
            return False
        size = (self._camera.width, self._camera.height)
        cells = np.floor(shared.pixels[explained] / size * SharedFeatureTuning.cells).clip(
            0, SharedFeatureTuning.cells - 1
        ) @ (SharedFeatureTuning.cells, 1)
        return len(np.unique(cells)) >= SharedFeatureTuning.confirmed_cells

    def keeps(self, T_world_camera: np.ndarray, T_start: np.ndarray, share: float) -> bool:
        """Whether a pose [4, 4] explains a share of what its start does, of what was matched so far."""
        known = self._matches.values()
        return self._count(known, T_world_camera) >= share * self._count(known, T_start)

    def _count(self, matches: Iterable[ViewMatches], T_world_camera: np.ndarray) -> int:
        return sum(shared.count_explained(T_world_camera, self._camera, self._settings) for shared in matches)

    def prefer(self, T_one: np.ndarray, T_other: np.ndarray) -> bool | None:
        """Whether one pose [4, 4] explains clearly more of the features than another; None: there is no clear
        difference."""
        one, other = self._count(self._all(), T_one), self._count(self._all(), T_other)
        if max(one, other) < self._settings.min_inliers or min(one, other) >= SharedFeatureTuning.clearly_fewer * max(
            one, other
        ):
            return None
        return one > other
