# SPDX-License-Identifier: Apache-2.0
"""The visible space of each keyframe: how deep it sees, which cells it sees, and when a cell was last seen."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass

import numpy as np

from ggslam.geometry.frustums import Frustums, depth_reach
from ggslam.mapping.keyframe import Keyframe
from ggslam.scene.camera import Camera
from ggslam.scene.poses import inverse
from ggslam.submaps.paging_settings import PagingSettings
from ggslam.system.tuning import Tuning


class VisibilityTuning(Tuning):
    """How the visibility of cells is computed."""

    keyframes_at_once = 64
    """Keyframes whose visibility is computed in one batch."""
    tiles = (6, 8)
    """Rows and columns of tiles of a view. Each tile has its own depth, beyond which cells are hidden."""


@dataclass(frozen=True)
class ViewReach:
    """A pose T_world_camera [4, 4], and how deep each tile of the image sees from there, metres [rows, columns]."""

    T_world_camera: np.ndarray
    reach: np.ndarray


class KeyframeVisibility:
    """The visible space of each keyframe.

    Args:
        camera: of all keyframes.
        settings: see there.
    """

    def __init__(self, camera: Camera, settings: PagingSettings) -> None:
        self._camera, self._settings = camera, settings
        self.keyframes: Sequence[Keyframe] = ()
        """Those of the map; the mapper's own list."""
        self._reach: list[np.ndarray] = []

    def add(self, T_world_camera: np.ndarray, depth: np.ndarray) -> ViewReach:
        """The next keyframe is about to be inserted at a pose [4, 4].

        Args:
            T_world_camera: where it is.
            depth: what it measured, metres [H, W].
        """
        s = self._settings
        deep = s.view_margin * depth_reach(depth, *VisibilityTuning.tiles) + s.view_spare
        self._reach.append(np.minimum(deep, s.view_range))
        return ViewReach(T_world_camera, self._reach[-1])

    def of(self, numbers: Iterable[int]) -> list[ViewReach]:
        """What these keyframes see from where they are now."""
        return [ViewReach(self.keyframes[number].T_world_camera, self._reach[number]) for number in numbers]

    def newest(self) -> ViewReach:
        """Of the newest keyframe."""
        return self.of([len(self._reach) - 1])[0]

    def frustums(self, views: Sequence[ViewReach]) -> Frustums:
        """The visible spaces."""
        poses = np.stack([inverse(view.T_world_camera) for view in views])
        return Frustums.of(self._camera, poses, np.stack([view.reach for view in views]))

    def batches(self, numbers: Sequence[int]) -> Iterable[tuple[Sequence[int], Frustums]]:
        """So many keyframes at a time as may be asked together, and their visible spaces."""
        for begin in range(0, len(numbers), VisibilityTuning.keyframes_at_once):
            asked = numbers[begin : begin + VisibilityTuning.keyframes_at_once]
            yield asked, self.frustums(self.of(asked))

    def last_seen(self, boxes: tuple[np.ndarray, np.ndarray]) -> np.ndarray:
        """Number of the last keyframe that sees each box (lower and upper corners [M, 3]), int64 [M], -1 for none."""
        last, unseen = np.full(len(boxes[0]), -1), np.arange(len(boxes[0]))
        for end in range(len(self.keyframes), 0, -VisibilityTuning.keyframes_at_once):
            numbers = np.arange(max(0, end - VisibilityTuning.keyframes_at_once), end)
            seen = self.frustums(self.of(numbers.tolist())).touch(boxes[0][unseen], boxes[1][unseen])
            last[unseen] = np.where(seen, numbers[:, None], -1).max(0)
            unseen = unseen[last[unseen] < 0]
            if not len(unseen):
                break
        return last
