# SPDX-License-Identifier: Apache-2.0
"""Detects what is fixed to the camera (a tool, a bonnet) and masks it. Otherwise every keyframe would map it in front
of everything else."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field, replace
from typing import Annotated

import cv2
import numpy as np

from ggslam.geometry.image_parts import parts_with_seeds
from ggslam.scene.camera import Camera
from ggslam.scene.frame import Frame
from ggslam.scene.poses import separation
from ggslam.sight.fixed_to_camera import count_comparisons, shrink_depth
from ggslam.slam.filters.frame_filter import FrameFilter
from ggslam.slam.map_removal import MapRemoval
from ggslam.system.array_forms import DepthImage, Form, Mask, Pose
from ggslam.system.medians import median
from ggslam.system.savable import savable
from ggslam.system.tuning import Tuning
from ggslam.tracking.settings import DepthNoise
from ggslam.tracking.tracker import TrackingResult, TrackingStatus


class FixtureTuning(Tuning):
    """When something in the image counts as fixed to the camera."""

    columns = 80
    """Approximate width, in pixels, of the images that are compared."""
    earlier_views = 3
    """Earlier views that each view is compared with."""
    max_views = 16
    """Views after which the search ends."""
    apart_share = 0.05
    """Smallest distance between two views, as a share of the median depth."""
    apart_deg = 4.0
    """Smallest angle between two views, in degrees, where they are closer than that."""
    min_comparisons = 6
    """Fewest comparisons of views in which a pixel must keep its depth."""
    min_still_share = 0.3
    """Smallest share of all comparisons in which a pixel must keep its depth."""
    still_per_world = 3
    """Comparisons that find a pixel fixed for each one that finds it part of the world, at least."""
    seed_views = 2
    """Views that must look through the place where a seed pixel would lie in the world."""
    min_seed_share = 0.05
    """Smallest share of seeds among the pixels of one fixture."""
    max_depth_m = 5.0
    """Largest depth of a fixture, in metres. Depth that stays the same beyond it is a network's guess."""
    min_image_share = 0.005
    """Smallest fixture, and smallest growth of one, as a share of the image."""
    flying_pixel_factor = 1.5
    """Depth below this many times the distance of the fixture is its flying pixels, in all of the image..."""
    max_scene_share = 0.5
    """...if the fixture is closer than this share of the median distance of the scene."""


@savable()
@dataclass
class CameraFixtures(FrameFilter):
    """Detects fixtures in the first located frames that are apart from one another.

    Attributes:
        mask: bool [H, W], what is fixed to the camera; None: nothing, as far as is known.
        nearest: metres; nearer depth is of it, too, wherever it is in the image.
        changes: how many times `mask` has changed.
        views: frames that were compared.
        comparisons: of one of them with another.
        counts: int32 [3, h, w], comparisons that say of a pixel that it is fixed, still, of the world, see
            `count_comparisons`.
        latest: depth as compared, and pose, of the latest views.
    """

    order = 30

    mask: Mask | None = None
    nearest: float = 0.0
    changes: int = 0
    views: int = 0
    comparisons: int = 0
    counts: Annotated[np.ndarray, Form("i4", 3, None, None)] | None = None
    latest: list[tuple[Annotated[np.ndarray, Form("f4", None, None)], Pose]] = field(default_factory=list)
    _depth: DepthImage | None = None
    """Of the frame at hand, as the camera gave it."""
    _left_out: int = 0
    """Of `changes`, those that the map knows of."""

    def notes(self, frames: int) -> list[str]:
        """What the user should know."""
        if self.mask is None:
            return []
        return [f"{self.mask.mean():.0%} of every image is fixed to the camera (a tool, a holder): it is not mapped"]

    def clean(self, frame: Frame) -> Frame:
        """The frame without what is fixed to the camera: itself if that is nothing."""
        self._depth = frame.depth
        if self.mask is None:
            return frame
        valid = ~self.mask if frame.valid is None else frame.valid & ~self.mask
        fixed = self.mask | (frame.depth < self.nearest)
        return replace(frame, depth=np.where(fixed, np.float32(0), frame.depth), valid=valid)

    def judge(
        self, frame: Frame, result: TrackingResult, noise: DepthNoise | None
    ) -> tuple[Frame, TrackingResult]:  # fmt: skip
        """The same; what the frame shows may be compared with later ones."""
        self.follow(frame.camera, None if result.status is TrackingStatus.LOST else result.T_world_camera)
        return frame, result

    def after_insertion(self, removal: MapRemoval, newest: Frame) -> None:
        """Removes what has turned out to be fixed to the camera."""
        if self.mask is None or (self.changes == self._left_out and not newest.depth[self.mask].any()):
            return
        self._left_out = self.changes
        if not removal.is_paged:
            removal.drop_pixels(self.mask, self.nearest)

    def follow(self, camera: Camera, T_world_camera: np.ndarray | None) -> None:
        """The frame that `clean` was asked about last was located at a pose [4, 4], or not (None)."""
        depth, self._depth = self._depth, None
        if T_world_camera is None:
            self.latest = []
        elif depth is not None and self.views < FixtureTuning.max_views:
            self._look(depth, camera, T_world_camera)

    def _look(self, depth: np.ndarray, camera: Camera, T_world_camera: np.ndarray) -> None:
        factor = max(1, round(camera.width / FixtureTuning.columns))
        if self.latest:
            moved, turned = separation(self.latest[-1][1], T_world_camera)
            known = depth[:: 2 * factor, :: 2 * factor]
            known = known[known > 0]
            if not len(known):
                return
            if moved < FixtureTuning.apart_share * median(known) and turned < FixtureTuning.apart_deg:
                return
        small, smaller = shrink_depth(depth, camera, factor)
        if self.counts is None:
            self.counts = np.zeros((3, *small.shape), np.int32)
        count_comparisons(small, T_world_camera, self.latest, smaller, self.counts)
        self.comparisons += 2 * len(self.latest)
        self.latest, self.views = (
            [*self.latest[1 - FixtureTuning.earlier_views :], (small, T_world_camera.copy())],
            self.views + 1,
        )
        if self.comparisons >= FixtureTuning.min_comparisons:
            self._judge(camera, factor, small)
        if self.views == FixtureTuning.max_views:
            self.latest = []

    def _judge(self, camera: Camera, factor: int, depth: np.ndarray) -> None:
        assert self.counts is not None
        fixed, still, world = self.counts
        candidates = (still >= max(FixtureTuning.min_comparisons, FixtureTuning.min_still_share * self.comparisons)) & (
            still >= FixtureTuning.still_per_world * world
        )
        candidates &= depth < FixtureTuning.max_depth_m
        fewest = FixtureTuning.min_image_share * candidates.size
        if np.add.reduce(candidates, axis=None) < fewest:
            return
        found = parts_with_seeds(
            candidates & (fixed >= FixtureTuning.seed_views), candidates, FixtureTuning.min_seed_share
        )
        if np.add.reduce(found, axis=None) < fewest:
            return
        grown = cv2.dilate(found.astype(np.uint8), np.ones((3, 3), np.uint8))
        large = cv2.resize(grown, (grown.shape[1] * factor, grown.shape[0] * factor), interpolation=cv2.INTER_NEAREST)
        right, below = camera.width - large.shape[1], camera.height - large.shape[0]
        mask = np.pad(large, ((0, below), (0, right)), mode="edge") > 0
        mask = mask if self.mask is None else mask | self.mask
        if self.mask is None or (mask & ~self.mask).mean() > FixtureTuning.min_image_share:
            self.mask, self.changes = mask, self.changes + 1
            own, scene = depth[found & (depth > 0)], depth[~found & (depth > 0)]
            if len(own) and len(scene):
                distance = float(np.percentile(own, 90))
                self.nearest = (
                    FixtureTuning.flying_pixel_factor * distance
                    if distance < FixtureTuning.max_scene_share * median(scene)
                    else 0.0
                )


def find_fixtures(frames: Iterable[Frame], poses: Mapping[int, np.ndarray]) -> CameraFixtures:
    """What is fixed to the camera of a recording.

    Args:
        frames: of it, in their order.
        poses: T_world_camera [4, 4] of them, by `Frame.index`.
    """
    fixtures = CameraFixtures()
    for frame in frames:
        if fixtures.views == FixtureTuning.max_views:
            break
        fixtures.clean(frame)
        fixtures.follow(frame.camera, poses.get(frame.index))
    return fixtures
