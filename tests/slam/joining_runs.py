# SPDX-License-Identifier: Apache-2.0
"""Runs whose keyframes join beside the next frames, as on a GPU, with the map on the CPU."""

from __future__ import annotations

import dataclasses
from contextlib import nullcontext
from pathlib import Path

import numpy as np

from ggslam.loops.activity import ActivitySettings
from ggslam.scene.frame import Frame
from ggslam.scene.poses import inverse, se3_exp
from ggslam.sequences import open_sequence
from ggslam.slam.config import load_config
from ggslam.slam.loop_settings import LoopSettings
from ggslam.slam.schedules import BesideTraining
from ggslam.slam.slam import Slam
from ggslam.tracking.points import extract_points
from ggslam.tracking.settings import DepthNoise
from ggslam.tracking.tracker import TrackingResult, TrackingStatus

CHEAP = ["mapping.iterations_per_frame=1", "mapping.first_frame_iterations=4", "identity.enabled=false",
         "evaluation.held_out_every=0", "refine_iterations=2"]  # fmt: skip


def start(frames: list[Frame], *settings: str, loops: LoopSettings | None = None) -> Slam:
    config = load_config(None, [*CHEAP, *settings])
    if loops is not None:
        config = dataclasses.replace(config, loops=loops)
    slam = Slam(frames[0].camera, config, has_masks=False)
    slam.schedule = BesideTraining(nullcontext())
    return slam


class DriftingCamera:
    """Gives a run's tracker the true motion with drift."""

    def __init__(self, slam: Slam, frames: list[Frame], drift: np.ndarray) -> None:
        self.slam, self.step, self.T = slam, se3_exp(drift / len(frames)), np.eye(4)
        self.before: Frame | None = None
        slam.tracker.track = self.track  # type: ignore[method-assign]
        slam.tracker.move = self.move  # type: ignore[method-assign]

    def track(self, frame: Frame) -> TrackingResult:
        if self.before is not None:
            assert self.before.T_world_camera is not None
            self.T = self.T @ inverse(self.before.T_world_camera) @ frame.T_world_camera @ self.step
        self.before, slam = frame, self.slam
        slam.tracker.noise = DepthNoise()
        points = extract_points(frame.depth, slam.camera, slam.config.tracking.points, DepthNoise(), slam.context)
        return TrackingResult(self.T.copy(), TrackingStatus.OK, 1.0, 0.0, "", points)

    def move(self, T_new_old: np.ndarray) -> None:
        self.T = T_new_old @ self.T


def there_and_back(room: Path, gap: int) -> tuple[Slam, DriftingCamera, list[Frame]]:
    """A run, its camera, and frames of a walk through the room and back, to be fed to it: drift parts both ends, and a
    loop is closed.

    Args:
        room: the recording.
        gap: frames from one keyframe to the next.
    """
    frames = list(open_sequence(room).stream())
    stride = 2 // gap
    order = [*range(0, 24, stride), *range(22, -1, -stride)]
    forgetful = LoopSettings(activity=ActivitySettings(forget_after=0.05, near=0.15, batch=1, spread=0))
    walk = [dataclasses.replace(frames[i], index=k) for k, i in enumerate(order)]
    slam = start(walk, f"keyframes.max_gap={gap}", "movers.enabled=false", loops=forgetful)
    return slam, DriftingCamera(slam, walk, np.array([0.15, 0.06, -0.09, 0.0, np.radians(4), 0.0])), walk
