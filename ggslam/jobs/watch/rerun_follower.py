# SPDX-License-Identifier: Apache-2.0
"""Follows a run and sends it to rerun: poses, images and numbers of every frame, the map now and then."""

from __future__ import annotations

import numpy as np

from ggslam.reporting.rerun_log import RerunLog
from ggslam.scene.frame import Frame
from ggslam.scene.gaussian_map import GaussianMap
from ggslam.slam.result import SlamResult, StepReport
from ggslam.slam.slam import Slam
from ggslam.system.tuning import Tuning
from ggslam.tracking.tracker import TrackingStatus


class RerunTuning(Tuning):
    """How much is sent to rerun."""

    max_points = 30_000
    """Gaussians that are sent at a time, drawn evenly from all."""
    keyframes_per_map = 5
    """The map is sent every n-th keyframe."""
    max_positions = 1000
    """Most positions of the path."""


class LiveLog:
    """A follower of a run, see `ggslam.jobs.run.pipeline.execute`.

    Args:
        log: where to.
    """

    def __init__(self, log: RerunLog) -> None:
        self._log = log
        self._keyframes = 0
        self._positions: list[np.ndarray] = []
        self._moving: set[int] = set()

    def __call__(self, slam: Slam, frame: Frame, report: StepReport) -> None:
        """Sends what a step brought."""
        if not self._positions and not self._keyframes:
            self._log.camera(slam.camera)
        self._log.moment(frame.index, frame.timestamp)
        self._log.image(frame.color)
        self._log.scalars({
            "overlap": report.frame.overlap, "loss": report.loss, "psnr": report.psnr,
            "gaussians": report.gaussians, "step_ms": 1e3 * report.seconds,
        })  # fmt: skip
        if report.frame.status != TrackingStatus.LOST.value:
            pose = slam.pose_of(report.frame)
            self._positions.append(pose[:3, 3])
            self._log.pose(pose)
            self._send_movers(slam, frame.index, pose)
        if report.is_keyframe:
            self._log.depth(frame.depth)
            self._send_path()
            if self._keyframes % RerunTuning.keyframes_per_map == 0:
                self._send_map(slam.map)
            self._keyframes += 1

    def finish(self, result: SlamResult) -> None:
        """Sends path and map as they came out.

        Args:
            result: of the run. Of a map that is on disk what was sent last remains.
        """
        poses = result.trajectory()
        self._positions = list(poses[np.isfinite(poses).all((1, 2))][:, :3, 3])
        self._send_path()
        if len(result.gaussians):
            self._send_map(result.gaussians)

    def close(self) -> None:
        """Nothing more comes."""
        self._log.close()

    def _send_movers(self, slam: Slam, frame: int, T_world_camera: np.ndarray) -> None:
        """Boxes of what moves in the frame; of what does no longer none."""
        seen = {track.number: track.sights[-1] for track in slam.movers.tracks.tracks if track.sights}
        moving = {number: sight for number, sight in seen.items() if sight.frame == frame}
        for number, sight in moving.items():
            T_mover_box = np.eye(4)
            T_mover_box[:3, 3] = (sight.low + sight.high) / 2
            self._log.box(number, T_world_camera @ sight.T_camera_mover @ T_mover_box, sight.high - sight.low)
        for number in self._moving - set(moving):
            self._log.drop_box(number)
        self._moving = set(moving)

    def _send_path(self) -> None:
        stride = max(1, len(self._positions) // RerunTuning.max_positions)
        self._log.path(np.array(self._positions[::stride] + self._positions[-1:]))

    def _send_map(self, gaussians: GaussianMap) -> None:
        """In a real-time run the mapper works on the map meanwhile: arrays are cut to one length."""
        stride = max(1, -(-gaussians.count // RerunTuning.max_points))
        arrays = [a[::stride].cpu().numpy().copy() for a in (gaussians.means, gaussians.rgb, gaussians.scales)]
        count = min(map(len, arrays))
        means, rgb, scales = (a[:count] for a in arrays)
        colors = (255 * np.clip(rgb, 0, 1) + 0.5).astype(np.uint8)
        radii = np.median(scales, axis=1) * np.sqrt(stride)  # fewer, so larger, that surfaces stay closed
        self._log.points(means, colors, radii)
