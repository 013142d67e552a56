# SPDX-License-Identifier: Apache-2.0
"""The tracker that aligns edges and planes of depth images, with G-ICP to fall back on."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace

import numpy as np

from ggslam.features.orb import FeatureView, pose_from_matches
from ggslam.native.loader import NativeContext
from ggslam.scene.camera import Camera
from ggslam.scene.frame import Frame
from ggslam.system.savable import savable
from ggslam.tracking.edges_planes.alignment import FeatureAlignment
from ggslam.tracking.edges_planes.engine import DeviceFeatures
from ggslam.tracking.edges_planes.extraction import Scan
from ggslam.tracking.edges_planes.local_map import LocalFeatureMap
from ggslam.tracking.edges_planes.scans import DepthImageFeatures
from ggslam.tracking.edges_planes.settings import FeatureTrackerSettings
from ggslam.tracking.gicp import AlignmentResult, GicpTarget
from ggslam.tracking.gicp_tracker import GicpTracker
from ggslam.tracking.motion import CameraMotion
from ggslam.tracking.noise import estimate_noise
from ggslam.tracking.observability import about_point
from ggslam.tracking.points import DeferredPoints, FramePoints, PointSource, extract_points
from ggslam.tracking.settings import DepthNoise, TrackerSettings
from ggslam.tracking.tracker import Tracker, TrackerState, TrackingResult, TrackingStatus


@savable()
@dataclass(frozen=True)
class FeatureCounts:
    """Numbers of features of a frame.

    Attributes:
        planes, edges: number of features.
        outer_iterations, inner_iterations: matchings and steps.
    """

    planes: int = 0
    edges: int = 0
    outer_iterations: int = 0
    inner_iterations: int = 0


@savable(not_saved="features _extractor _device_engine")
class FeatureTracker(Tracker):
    """Constant velocity, then edges and planes against a local map of their own, within a budget of time.

    What it needs of the world it gathers itself, so that it goes on whether or not a target is set. With a target, and
    unless the settings forbid, G-ICP takes over where edges and planes do not convince, where they leave a direction
    of motion open, and to find the way back after being lost: only it has grey values to witness a pose.

    Args:
        camera: of all frames.
        settings: of G-ICP, of the points of keyframes, and of the depth noise.
        features: of this front-end.
        context: threads of the compiled core to work on.
        T_world_camera: pose of the first frame.
        engine: does the work on a device; None: torch and the compiled core do.
    """

    def __init__(
        self,
        camera: Camera,
        settings: TrackerSettings | None = None,
        features: FeatureTrackerSettings | None = None,
        context: NativeContext | None = None,
        T_world_camera: np.ndarray | None = None,
        engine: DeviceFeatures | None = None,
    ) -> None:
        super().__init__(TrackerState.begin(camera, settings, context, T_world_camera))
        self._gicp = GicpTracker.with_state(self.state, None if engine is None else engine.gicp_engine)
        self.features = features or FeatureTrackerSettings()
        self.local_map = LocalFeatureMap(self.features, engine)
        self.counts = FeatureCounts()
        """Of the newest frame."""
        self._device_engine = engine
        self._extractor = engine or DepthImageFeatures(camera, self.features.extraction, self.features.device)

    @property
    def device_engine(self) -> DeviceFeatures | None:
        """Does the work on a device; None: there is none."""
        return self._device_engine

    def track(self, frame: Frame) -> TrackingResult:
        """See `Tracker.track`."""
        motion = self.state.motion
        self.local_map.clock.start()
        if self.noise is None:
            self.noise = estimate_noise(frame.depth, self.camera)
        scan = self._extractor.extract(frame.depth, self.noise or DepthNoise())
        view = FeatureView(frame.color, frame.depth, motion.T_world_camera)
        if self.local_map.is_empty:
            self.counts = FeatureCounts(scan.plane_count, scan.edge_count)
            if motion.lost:
                return self._start_in_target(frame, scan)
            return self._begin_map(view, self._points(frame, scan), scan)
        self.noise = self.noise or DepthNoise()
        found = self.local_map.align(scan, motion.predict())
        self.counts = FeatureCounts(
            scan.plane_count, scan.edge_count, found.outer_iterations, found.inner_iterations
        )
        points = self._points(frame, scan)
        convincing = self.local_map.is_convincing(found)
        if not convincing and found.usable and not motion.lost:
            self.local_map.clock.lift()  # to be late is better than to be lost
            found = self.local_map.align(scan, found.T_map_sensor)
            convincing = self.local_map.is_convincing(found)
        if self._may_ask_gicp() and (not convincing or motion.lost or len(found.weak_directions)):
            return self._ask_gicp(frame, scan, found, convincing)
        reason = ""
        if not convincing:
            found, reason = self._search(view, scan, found)
        if not reason and not convincing:
            return self._give_up(points, found)
        return self._accept(view, points, scan, found, reason)

    def move(self, T_new_old: np.ndarray) -> None:
        """Moves the tracker's own pose and its local map with it, after a correction of the world [4, 4]."""
        super().move(T_new_old)
        self.local_map.move(T_new_old)

    def relocate(self, view: FeatureView, points: PointSource, found: AlignmentResult, source: str) -> TrackingResult:
        """As `Tracker.relocate`; the local map begins anew there."""
        result = super().relocate(view, points, found, source)
        self._begin_again(view, result.T_world_camera)
        return result

    def track_from(self, frame: Frame, motion: CameraMotion, target: GicpTarget) -> TrackingResult:
        """As `Tracker.track_from`, by G-ICP; the local map begins anew there."""
        result = self._gicp.track_from(frame, motion, target)
        if result.status is not TrackingStatus.LOST:
            self._begin_again(self.state.motion.views[0], result.T_world_camera)
        return result

    def begin_part(self, view: FeatureView, points: PointSource, T_world_camera: np.ndarray) -> TrackingResult:
        """As `Tracker.begin_part`; the local map begins anew there."""
        result = super().begin_part(view, points, T_world_camera)
        self._begin_again(view, result.T_world_camera)
        return result

    # --- parts -------------------------------------------------------------------------------------------------------

    def _begin_again(self, view: FeatureView, T_world_camera: np.ndarray) -> None:
        """The local map is that of one view at a pose [4, 4]."""
        self.local_map.clear()
        self.local_map.add(self._extractor.extract(view.depth, self.noise or DepthNoise()), T_world_camera)

    def _points(self, frame: Frame, scan: Scan) -> DeferredPoints:
        """The frame's points, for who reads them: by the compiled core, as that may be another thread than the one that
        a device serves."""
        return DeferredPoints(lambda: self._extract_points(frame), scan.median_depth)

    def _extract_points(self, frame: Frame) -> FramePoints:
        return extract_points(frame.depth, self.camera, self.settings.points, self.noise or DepthNoise(), self.context)

    def _start_in_target(self, frame: Frame, scan: Scan) -> TrackingResult:
        """Nothing of its own to hold on to, but a map that someone else made: see `start_lost`."""
        result = self._gicp.track(frame)
        if result.status is not TrackingStatus.LOST:
            self.local_map.add(scan, result.T_world_camera)
        return result

    def _begin_map(self, view: FeatureView, points: PointSource, scan: Scan) -> TrackingResult:
        result = self._begin(view, points)
        if result.status is not TrackingStatus.LOST:
            self.local_map.add(scan, result.T_world_camera)
        return result

    def _search(self, view: FeatureView, scan: Scan, found: FeatureAlignment) -> tuple[FeatureAlignment, str]:
        """The first convincing alignment from other starts, and which start it was; without one the alignment given,
        and no name. The budget does not count here."""
        self.local_map.clock.lift()
        for name, guess in self._starts(view):
            candidate = self.local_map.align(scan, guess)
            if self.local_map.is_convincing(candidate):
                return candidate, name
        return found, ""

    def _starts(self, view: FeatureView) -> Iterator[tuple[str, np.ndarray]]:
        yield "last pose", self.state.motion.T_world_camera
        for number, earlier in enumerate(self.state.motion.views):
            pose = pose_from_matches(view, earlier, self.camera, self.settings.recovery.features)
            if pose is not None:
                yield f"features of view {number}", pose.T_world_camera

    def _accept(
        self, view: FeatureView, points: PointSource, scan: Scan, found: FeatureAlignment, reason: str
    ) -> TrackingResult:
        T = found.T_map_sensor
        self.state.motion.follow(view, T)
        self.state.motion.remember(view, points, self.settings)
        self.local_map.update(scan, T, found.overlap)
        status = TrackingStatus.DEGENERATE if len(found.weak_directions) else TrackingStatus.OK
        status = TrackingStatus.RECOVERED if reason else status
        return _result(found, T.copy(), status, reason, points)

    def _give_up(self, points: PointSource, found: FeatureAlignment) -> TrackingResult:
        self.state.motion.lose()
        limit = self.features.align.convincing_overlap
        reason = f"{found.overlap:.0%} of {self.counts.planes} planes lie on the local map, {limit:.0%} needed"
        if not found.usable:
            needed = self.features.align.min_matches
            reason = (
                f"too few of {self.counts.planes} planes and {self.counts.edges} edges match the local map, "
                f"{needed} needed"
            )
        pose = self.state.motion.T_world_camera.copy()
        return _result(found, pose, TrackingStatus.LOST, reason, points)

    def _may_ask_gicp(self) -> bool:
        return self.features.gicp_fallback and self.target is not None

    def _ask_gicp(self, frame: Frame, scan: Scan, found: FeatureAlignment, convincing: bool) -> TrackingResult:
        """The frame as G-ICP sees it. After being lost the local map begins anew: the camera may be elsewhere."""
        was_lost = self.state.motion.lost
        result = self._gicp.track(frame)
        if result.status is TrackingStatus.LOST:
            return result
        if was_lost:
            self.local_map.clear()
            self.local_map.add(scan, result.T_world_camera)
        else:
            self.local_map.update(scan, result.T_world_camera, found.overlap)
        if convincing or result.status is TrackingStatus.RECOVERED:
            return result
        reason = f"G-ICP, as {found.overlap:.0%} of {self.counts.planes} planes lie on the local map"
        return replace(result, status=TrackingStatus.RECOVERED, reason=reason)


def _result(
    found: FeatureAlignment, T_world_camera: np.ndarray, status: TrackingStatus, reason: str, points: PointSource
) -> TrackingResult:
    """The alignment as trackers report it; its information is about the sensor, that of results about the origin."""
    information = about_point(found.information, found.T_map_sensor[:3, 3])
    return TrackingResult(T_world_camera, status, found.overlap, found.rmse, reason, points, information)
