# SPDX-License-Identifier: Apache-2.0
"""Decides whether to accept an alignment of a frame, and which of two, by overlap, grey values and features."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from ggslam.features.orb import FeatureView
from ggslam.geometry.moved_depth import shift_between
from ggslam.scene.camera import Camera
from ggslam.system.tuning import Tuning
from ggslam.tracking.feature_hold import hold_to_features
from ggslam.tracking.gicp import AlignmentResult, AlignmentStatus
from ggslam.tracking.motion import CameraMotion
from ggslam.tracking.points import PointSource
from ggslam.tracking.seen_before import share_seen_before
from ggslam.tracking.settings import DepthNoise, RecoverySettings
from ggslam.tracking.shared_features import SharedFeatures, SharedFeatureTuning


class JudgeTuning(Tuning):
    """When an alignment is believed."""

    alike_share = 0.01
    """Starts that shift the image by less than this share of its width are the same."""
    min_seen = 0.5
    """Smallest share of a frame that earlier views must show before its overlap is judged against that share."""
    near_m = 2.0
    """Depth, in metres, at which image shifts are judged in deeper scenes: their nearer parts shift most."""


@dataclass
class PoseJudge:
    """Judges the alignments of one frame. Features are matched when they are first asked for.

    Attributes:
        view: the frame.
        motion: of the camera before it.
        camera: of both.
        settings: see there.
        depth_m: at which image shifts are judged, metres: the frame's median depth, if that is less than
            `JudgeTuning.near_m`.
    """

    view: FeatureView
    motion: CameraMotion
    camera: Camera
    settings: RecoverySettings
    depth_m: float

    @cached_property
    def features(self) -> SharedFeatures:
        """Features that the frame shares with the last located ones."""
        return SharedFeatures(self.view, self.motion.views, self.camera, self.settings.features)

    # --- starts ------------------------------------------------------------------------------------------------------

    def first_start(self) -> tuple[np.ndarray, bool]:
        """Where the first alignment starts [4, 4], and whether coarsely: at constant velocity, or where that moves the
        image far, at what the features vouch for."""
        guess = self.motion.predict()
        if self.is_wide(guess):
            for _, pose in self.features.starts():
                if self.features.vouch(pose):
                    return pose, False
        return guess, True

    def other_starts(self) -> Iterator[tuple[str, np.ndarray, bool]]:
        """Other starts than constant velocity, the likeliest first: a name, a pose [4, 4], and whether it is coarse.
        Feature matches are good to a centimetre or two; the coarse level would slide off along a bare wall."""
        tried, turned = [self.motion.predict()], self.motion.T_world_camera @ self.motion.settle_turn()
        starts = [(name, pose, False) for name, pose in self.features.starts()]
        starts.append(("last pose", self.motion.T_world_camera, True))
        if self.is_wide(turned):
            starts.append(("shift of the image", turned, True))
        for name, pose, coarse in starts:
            shifts = [shift_between(pose, other, self.camera, self.depth_m) for other in tried]
            if not any(shift / self.camera.width < JudgeTuning.alike_share for shift in shifts):
                tried.append(pose)
                yield name, pose, coarse

    def is_wide(self, T_world_camera: np.ndarray) -> bool:
        """Whether the image shifts far from the last pose to this one [4, 4]."""
        shift = shift_between(T_world_camera, self.motion.T_world_camera, self.camera, self.depth_m)
        return shift / self.camera.width > self.settings.wide_share

    # --- witnesses ---------------------------------------------------------------------------------------------------

    def is_convincing(self, found: AlignmentResult) -> bool:
        """Whether so much of the frame lies on the map that nothing else is tried."""
        return found.status is not AlignmentStatus.LOST and found.overlap >= self.settings.convincing_overlap

    def explains_greys(self, found: AlignmentResult) -> bool:
        """Whether the images agree at the pose found; true if none were compared."""
        return found.photometric_share == 0 or found.photometric_residual <= self.settings.convincing_residual

    def is_vouched(self, found: AlignmentResult) -> bool:
        """Whether features, if they were asked, vouch for a pose."""
        if found.status is AlignmentStatus.LOST or "features" not in self.__dict__:
            return False
        return self.features.vouch(found.T_world_camera)

    def is_far_off(self, found: AlignmentResult) -> bool:
        """Whether a pose after a wide step, where alignments have several minima, is not where features have it."""
        if not self.is_wide(found.T_world_camera):
            return False
        if found.degenerate and self.features.could_vouch:
            return not self.features.vouch(found.T_world_camera)
        return bool(self.features.contradict(found.T_world_camera))

    def is_acceptable(self, found: AlignmentResult, points: PointSource) -> bool:
        """Whether to believe a pose at all. Some overlap can be had anywhere (a floor is a floor), so that a pose short
        of the convincing overlap, or after being lost, must be witnessed by grey values or features."""
        if found.status is AlignmentStatus.LOST:
            return False
        if self.is_vouched(found):
            return True
        if found.overlap < self.settings.min_overlap:
            return False
        if self.motion.lost:
            return self._is_witnessed(found)
        if self.is_convincing(found) or self._is_witnessed(found, tolerance=2):
            return True
        return not found.degenerate and self._matches_what_was_seen(found, points)

    def jump(self, T_world_camera: np.ndarray) -> str:
        """Why the path jumps at a pose [4, 4], as far as features were asked; empty if it does not."""
        if "features" not in self.__dict__:
            return ""
        return self.features.contradict(T_world_camera, SharedFeatureTuning.jump_slack)

    def _matches_what_was_seen(self, found: AlignmentResult, points: PointSource) -> bool:
        """Whether the overlap is convincing for so much as the last views show of the frame: a fast turn leaves
        little, and its blurred image bears no witness."""
        seen = share_seen_before(points.read(), found.T_world_camera, self.motion.views, self.camera)
        if seen < JudgeTuning.min_seen or found.overlap < self.settings.convincing_overlap * seen:
            return False
        return not self.jump(found.T_world_camera)

    def _is_witnessed(self, found: AlignmentResult, tolerance: float = 1) -> bool:
        """Whether there is some overlap and the images agree over enough of the frame."""
        if found.status is AlignmentStatus.LOST or found.overlap < self.settings.min_overlap:
            return False
        seen = found.photometric_share >= self.settings.min_share
        return seen and found.photometric_residual <= tolerance * self.settings.convincing_residual

    # --- one against another -----------------------------------------------------------------------------------------

    def hold(
        self, found: AlignmentResult, T_start: np.ndarray, points: PointSource, noise: DepthNoise
    ) -> AlignmentResult:
        """See `hold_to_features`."""
        return hold_to_features(found, T_start, self.features, points, noise, self.settings.convincing_overlap)

    def is_better(self, candidate: AlignmentResult, best: AlignmentResult) -> bool:
        """Whether an alignment of the same points beats another.

        The features that the frame shares with the last ones tell poses apart that geometry and grey values alone do
        not. Where they see no difference: with grey values the joint cost decides, for sliding along a bare wall
        keeps all the overlap; without them more overlap is better, and a loose fit costs a little.
        """
        if candidate.status is AlignmentStatus.LOST or best.status is AlignmentStatus.LOST:
            return candidate.status is not AlignmentStatus.LOST
        preferred = self.features.prefer(candidate.T_world_camera, best.T_world_camera)
        if preferred is not None:
            return preferred
        if candidate.photometric_share > 0 and best.photometric_share > 0:
            return candidate.cost < best.cost
        return candidate.overlap - 2.0 * candidate.rmse > best.overlap - 2.0 * best.rmse
