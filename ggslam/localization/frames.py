# SPDX-License-Identifier: Apache-2.0
"""Locates RGB-D frames in a stored map: the tracker of SLAM with a stored target, and stored places."""

from __future__ import annotations

from dataclasses import field, replace

import numpy as np

from ggslam.features.orb import FeatureView
from ggslam.localization.localizer import ANY_NORMAL, FrontEndResult, LocalizationStatus
from ggslam.localization.places import StoredPlaces, StoredView
from ggslam.localization.surface import Surface
from ggslam.loops.settings import VerificationSettings
from ggslam.loops.uncertainty import information_in_frame
from ggslam.loops.verification import LocalMap, verify
from ggslam.native.loader import NativeContext
from ggslam.scene.camera import Camera
from ggslam.scene.frame import Frame
from ggslam.scene.poses import inverse, transform_points, translation
from ggslam.system.settings import setting, settings_class
from ggslam.tracking.gicp import AlignmentResult, GicpTarget, align
from ggslam.tracking.gicp_tracker import GicpTracker
from ggslam.tracking.noise import estimate_noise
from ggslam.tracking.points import FramePoints, PointSource, extract_points
from ggslam.tracking.settings import DepthNoise, TrackerSettings
from ggslam.tracking.tracker import TrackingResult, TrackingStatus

_OUTCOMES = {
    TrackingStatus.FIRST: LocalizationStatus.LOST,
    TrackingStatus.OK: LocalizationStatus.OK,
    TrackingStatus.DEGENERATE: LocalizationStatus.DEGENERATE,
    TrackingStatus.RECOVERED: LocalizationStatus.FOUND,
    TrackingStatus.DOUBTED: LocalizationStatus.FOUND,
    TrackingStatus.LOST: LocalizationStatus.LOST,
}


@settings_class(frozen=True)
class LookUpSettings:
    """How a frame is looked up among the places of a map."""

    candidates: int = setting(5, 1, 1000)
    """Views that are tried, the likeliest first."""
    reach: float = setting(4.0, 0.01, 1e6, "m")
    """Points of the map this far from a view are compared with the frame's."""
    verification: VerificationSettings = field(default_factory=VerificationSettings)


class FrameTracker:
    """Locates frames; see `GicpTracker`.

    Args:
        camera: of all frames.
        settings: of the tracker.
        context: threads.
        T_world_camera: of the first frame; None: it is looked up.
        places: of the map; None: frames that are lost are not looked up.
        look_up: see `LookUpSettings`.
    """

    def __init__(
        self, camera: Camera, settings: TrackerSettings, context: NativeContext, T_world_camera: np.ndarray | None,
        places: StoredPlaces | None = None, look_up: LookUpSettings | None = None,
    ) -> None:  # fmt: skip
        self.tracker = GicpTracker(camera, settings, context, T_world_camera)
        self._places = places
        self._look_up = look_up or LookUpSettings()
        self._tracked: tuple[Frame, PointSource] | None = None

    def track(self, item: Frame, surface: Surface, target: GicpTarget) -> FrontEndResult:
        """See `FrontEnd`."""
        self._aim(surface, target)
        found = self.tracker.track(item)
        self._tracked = item, found.points
        return _as_tracked(found)

    def look_up(self, item: Frame, surface: Surface) -> FrontEndResult | None:
        """See `FrontEnd`."""
        if not self._places:
            return None
        points = self._points_of(item)
        if len(points) < self.tracker.settings.align.min_matches:
            return None
        view = FeatureView(item.color, item.depth, np.eye(4))
        place = self._places.describe(view)
        for match, known in self._places.query(place, self._look_up.candidates):
            alignment = self._verify(surface, LocalMap(place.landmarks, points.points), points, known)
            if alignment is None or surface.target is None:
                continue
            self._aim(surface, surface.target)
            return _as_tracked(self.tracker.relocate(view, points, alignment, f"looks like view {match.number // 2}"))
        return None

    def _aim(self, surface: Surface, target: GicpTarget) -> None:
        self.tracker.set_target(target)
        settings = self.tracker.settings
        if not surface.has_sides and settings.align.min_normal_dot > ANY_NORMAL:
            self.tracker.settings = replace(settings, align=replace(settings.align, min_normal_dot=ANY_NORMAL))

    def _points_of(self, frame: Frame) -> FramePoints:
        """The frame's points, as just tracked, or extracted now."""
        if self._tracked is not None and self._tracked[0] is frame:
            return self._tracked[1].read()
        tracker = self.tracker
        if tracker.noise is None:
            tracker.noise = estimate_noise(frame.depth, tracker.camera)
        noise = tracker.noise or DepthNoise()
        return extract_points(frame.depth, tracker.camera, tracker.settings.points, noise, tracker.context)

    def _verify(
        self, surface: Surface, new: LocalMap, points: FramePoints, known: StoredView
    ) -> AlignmentResult | None:
        """The frame's alignment to the map around a view, if it really is there."""
        T_world_view = known.T_world_camera
        surface.move_to(T_world_view[:3, 3])
        target = surface.target
        if target is None:
            return None
        T_view_world, last = inverse(T_world_view), None
        noise = self.tracker.noise or DepthNoise()

        def align_at(T_view_new: np.ndarray) -> AlignmentResult:
            nonlocal last
            tracker = self.tracker
            guess = T_world_view @ T_view_new
            last = align(points, target, guess, tracker.settings.align, noise, tracker.context)
            # About the camera, which is near the view: the world's origin may be far.
            about_camera = T_view_world @ translation(last.T_world_camera[:3, 3])
            information = information_in_frame(last.camera_information, about_camera)
            return replace(last, T_world_camera=T_view_world @ last.T_world_camera, information=information)

        voxels = target.voxels()["means"] + target.origin
        near = voxels[np.linalg.norm(voxels - T_world_view[:3, 3], axis=1) <= self._look_up.reach]
        old = LocalMap(known.place.landmarks, transform_points(near, T_view_world))
        found = verify(old, new, self.tracker.camera, noise.sigma, align_at, self._look_up.verification)
        return last if found.accepted else None


def _as_tracked(found: TrackingResult) -> FrontEndResult:
    return FrontEndResult(found.T_world_camera, _OUTCOMES[found.status], found.overlap, found.rmse_m, found.reason)
