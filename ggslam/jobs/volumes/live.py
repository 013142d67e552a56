# SPDX-License-Identifier: Apache-2.0
"""Volumes that grow while a run goes on."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator

import numpy as np

from ggslam.driving.body import Body, CameraBody
from ggslam.jobs.volumes.no_returns import NoReturns
from ggslam.mapping.keyframe import Keyframe
from ggslam.scene.frame import Frame
from ggslam.slam.result import SlamResult, StepReport
from ggslam.slam.rig_slam import RigSlam
from ggslam.slam.slam import Slam
from ggslam.tracking.tracker import TrackingStatus
from ggslam.volumes.maps import VolumeMaps
from ggslam.volumes.posed_view import PosedView


class LiveVolumes:
    """Fuses frames as a `Slam` locates them, and follows its loop closures.

    Args:
        maps: to fuse into.
        saw: receives every frame that was fused, and its T_world_camera.
        objects: whether object ids are voted for.
        fit_voxel: whether voxels, unless set, follow the size of the scene.
        body: of the robot, which is left out of depth; None: nothing is.
    """

    def __init__(
        self, maps: VolumeMaps, saw: Callable[[Frame, np.ndarray], None], objects: bool = True,
        fit_voxel: bool = True, body: Body | None = None,
    ) -> None:  # fmt: skip
        self.maps = maps
        self._body, self._seen_body = body, None if body is None else CameraBody(body)
        self._saw, self._objects, self._fit_voxel = saw, objects, fit_voxel
        self._corrections = 0
        self._no_returns = NoReturns()
        self._current: Callable[[np.ndarray], np.ndarray] | None = None

    def __call__(self, slam: Slam, frame: Frame, report: StepReport) -> None:
        """A frame went through `slam.step`, or its real-time counterpart."""
        frame = self._without_body(slam, frame)
        if slam.mapper.identity is not None:
            self._current = slam.mapper.identity.current
        start = time.perf_counter()
        if len(slam.corrections) > self._corrections:
            self._corrections = len(slam.corrections)
            self.maps.rebuild(self._views(slam.mapper.keyframes))
        if report.frame.status == TrackingStatus.LOST.value:
            return
        if not self.maps.times.rows:
            self.maps.fit(slam.scale, self._fit_voxel)
        T = slam.pose_of(report.frame)
        newest = slam.mapper.keyframes[-len(slam.cameras) :] if self._objects else []
        labels = next((keyframe.mask for keyframe in newest if keyframe.frame_index == frame.index), None)
        self.maps.add(frame, T, labels, report.seconds + time.perf_counter() - start)
        self._no_returns.note(frame, slam.mapper.keyframes)
        self._saw(frame, T)

    def _without_body(self, slam: Slam, frame: Frame) -> Frame:
        if self._seen_body is None:
            return frame
        if self._body is not None and isinstance(slam, RigSlam):
            self._seen_body, self._body = CameraBody(self._body, slam.rig.T_first_camera), None
        return self._seen_body.without(frame)

    def follow_parts(self, result: SlamResult) -> bool:
        """At the end: fuses the keyframes anew if the recording fell into parts, some of which were left out or joined
        since the last frame. Returns whether there were several parts."""
        kinds = {event.kind for event in result.loop_events}
        if "left out" in kinds or any(e.kind == "joined" and e.frame < 0 for e in result.loop_events):
            self.maps.rebuild(self._views(result.keyframes))
        return "new part" in kinds

    def settle(self, known_ids: list[int]) -> None:
        """At the end: what became one object later is one, and what is not among `known_ids` is none."""
        if self._current is None:
            return
        ids = self._current(np.arange(65536, dtype=np.uint16))
        known = np.zeros(65536, bool)
        known[known_ids] = True
        self.maps.relabel(np.where(known[ids], ids, 0).astype(np.uint16))

    def _views(self, keyframes: list[Keyframe]) -> Iterator[PosedView]:
        for keyframe in list(keyframes):
            depth, labels = self._no_returns.depth_of(keyframe), keyframe.mask if self._objects else None
            if self._seen_body is not None:
                hidden = self._seen_body.hidden_pixels(depth, keyframe.camera, keyframe.camera_number)
                depth = np.where(hidden, np.float32(0), depth)
            yield PosedView(depth, keyframe.camera, keyframe.T_world_camera, keyframe.color, labels)
