# SPDX-License-Identifier: Apache-2.0
"""Compares the views of the map that a run started from with the run's own keyframes, and removes what is gone.

A run in another one's map trains on that one's keyframes, too. Where they show what is not there any more they bring
it back again and again, and the tracker is aligned to it.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np

from ggslam.mapping.keyframe import FROM_EARLIER_RUN, Keyframe
from ggslam.movers.outdated import (
    EarlierView,
    OutdatedParts,
    coarse_factor,
    compare_both_ways,
)
from ggslam.native.loader import NativeContext
from ggslam.scene.frame import Frame
from ggslam.scene.poses import inverse, transform_points, turning_angle
from ggslam.sight.margin import Margin
from ggslam.sight.places import CoarseView
from ggslam.slam.filters.frame_filter import FilterContext, FrameFilter, InRigs
from ggslam.slam.filters.movers import SURE
from ggslam.slam.map_removal import MapRemoval
from ggslam.system.array_forms import Pose
from ggslam.system.plurals import quantity
from ggslam.system.savable import savable
from ggslam.system.tuning import Tuning
from ggslam.tracking.settings import DepthNoise
from ggslam.tracking.tracker import TrackingResult


class EarlierViewTuning(Tuning):
    """Comparison of an earlier run's views with the keyframes of this one."""

    apart_m = 0.05
    """Keyframes closer than this, in metres, count once: they share the error of their pose..."""
    apart_deg = 4.0
    """...if they are also turned by less than this, in degrees."""
    max_through = 0.5
    """Largest share of compared places that a keyframe may look through. Beyond it, its pose is not trusted."""
    samples = 5
    """Places of an earlier view along each image axis that tell whether a keyframe can see the same scene."""


@savable(not_saved="context")
@dataclass
class EarlierViews(FrameFilter):
    """What a run's own keyframes say of those of the map it began with.

    Attributes:
        context: that evidence is computed in.
        views: of the earlier keyframes that were compared, by number.
        counted: T_world_camera [4, 4] of the keyframes whose evidence counts.
        gaussians: how many left the map.
        noise: of the depth camera, as far as it is known.
    """

    order = 50
    in_rigs = InRigs.SHARED

    context: NativeContext
    views: dict[int, EarlierView] = field(default_factory=dict)
    counted: list[Pose] = field(default_factory=list)
    gaussians: int = 0
    noise: DepthNoise | None = None

    @classmethod
    def make(cls, made_of: FilterContext) -> EarlierViews:
        """One that has compared nothing yet."""
        return cls(made_of.context)

    def judge(
        self, frame: Frame, result: TrackingResult, noise: DepthNoise | None
    ) -> tuple[Frame, TrackingResult]:  # fmt: skip
        """The same; the noise is known from now on."""
        self.noise = noise or self.noise
        return frame, result

    def before_insertion(self, removal: MapRemoval, newest: Frame, tracking: TrackingResult) -> None:
        """Removes what the map that the run began with shows, and the newest frame and others before look through."""
        found = self.look(removal.keyframes, newest, tracking)
        if found:
            self.gaussians += removal.drop_outdated(found)

    def look(
        self, keyframes: Sequence[Keyframe], newest: Frame, tracking: TrackingResult
    ) -> list[tuple[Keyframe, OutdatedParts]]:  # fmt: skip
        """What turns out to be outdated with a frame that is about to become a keyframe.

        Args:
            keyframes: of the run so far.
            newest: the frame, without what moves in it.
            tracking: where it is; one that is not surely located says nothing.
        """
        noise, context = self.noise, self.context
        T_world_newest = tracking.T_world_camera
        if tracking.status not in SURE or noise is None or not self._is_new(T_world_newest):
            return []
        earlier = [k for k in keyframes if k.frame_index == FROM_EARLIER_RUN and k.depth.size]
        near = self._near(earlier, newest, T_world_newest)
        if not near:
            return []
        margin = Margin.of(noise)
        view = CoarseView.of(newest.depth, newest.camera, coarse_factor(newest.camera), T_world_newest, margin, context)
        for k in near:
            if k.index not in self.views:
                coarse = CoarseView.of(k.depth_m(), k.camera, coarse_factor(k.camera), np.eye(4), margin, context)
                self.views[k.index] = EarlierView.of(coarse)
        placed = [self.views[k.index].at(k.T_world_camera) for k in near]
        evidence, come = compare_both_ways(placed, view, margin, context)
        through, same = sum(int(e.passed.sum()) for e in evidence), sum(int(e.same.sum()) for e in evidence)
        if through > EarlierViewTuning.max_through * (through + same):
            return []
        self.counted.append(T_world_newest.copy())
        for k, at, says, before in zip(near, placed, evidence, come, strict=True):
            self.views[k.index].count(at, says, view, before)
        found = [(k, self._find_outdated(k)) for k in near if self.views[k.index].fresh]
        return [(k, parts) for k, parts in found if parts is not None]

    def loop_closed(self) -> None:
        """Forgets evidence: what was said with keyframes where they are no more does not count."""
        self.counted.clear()
        for view in self.views.values():
            view.forget()

    def notes(self, frames: int) -> list[str]:
        """What the user should know."""
        if not self.gaussians:
            return []
        return [f"left out of the map it began with: {quantity(self.gaussians, 'Gaussian')} that the run looks through"]

    def check(self) -> bool:
        """Whether all arrays have the shapes of their views."""
        return all(v.view.fits(v.through, v.same, v.before, v.gone, v.hidden) for v in self.views.values())

    def _find_outdated(self, keyframe: Keyframe) -> OutdatedParts | None:
        return self.views[keyframe.index].find_outdated(keyframe.mask, keyframe.depth.shape)

    def _is_new(self, T_world_camera: np.ndarray) -> bool:
        """Whether the pose differs from all that count."""
        for T in self.counted:
            shift = float(np.linalg.norm(T[:3, 3] - T_world_camera[:3, 3]))
            if (
                shift < EarlierViewTuning.apart_m
                and np.degrees(turning_angle(T, T_world_camera)) < EarlierViewTuning.apart_deg
            ):
                return False
        return True

    def _near(self, earlier: Sequence[Keyframe], newest: Frame, T_world_newest: np.ndarray) -> list[Keyframe]:
        """Those keyframes that may show what the newest frame sees."""
        T_newest_world, found = inverse(T_world_newest), []
        for keyframe in earlier:
            rows = np.linspace(0, keyframe.depth.shape[0] - 1, EarlierViewTuning.samples).astype(int)
            columns = np.linspace(0, keyframe.depth.shape[1] - 1, EarlierViewTuning.samples).astype(int)
            grid = np.ix_(rows, columns)
            depth = keyframe.depth[grid].astype(np.float32) * keyframe.depth_unit
            points = (keyframe.camera.rays()[grid] * depth[..., None]).reshape(-1, 3).astype(float)
            points = points[points[:, 2] > 0]
            seen = newest.camera.project(transform_points(points, T_newest_world @ keyframe.T_world_camera))[2]
            if seen.any():
                found.append(keyframe)
        return found
