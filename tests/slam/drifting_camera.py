# SPDX-License-Identifier: Apache-2.0
"""A camera that goes through a room and back again, tracked with drift."""

from __future__ import annotations

import dataclasses

import numpy as np

from ggslam.scene.frame import Frame
from ggslam.scene.poses import inverse, se3_exp
from ggslam.slam.schedules import NewKeyframe
from ggslam.slam.slam import Slam
from ggslam.tracking.points import extract_points
from ggslam.tracking.settings import DepthNoise
from ggslam.tracking.tracker import TrackingResult, TrackingStatus


def walk_with_drift(slam: Slam, frames: list[Frame], drift: np.ndarray, keyframes: int = 24) -> np.ndarray:
    """Takes a run there and back; every second frame is a keyframe.

    Args:
        slam: a new run, which looks for loops.
        frames: of the room.
        drift: twist [6] of the whole way.
        keyframes: after which it ends.

    Returns:
        The true poses of the whole way, [24, 4, 4].
    """
    slam.tracker.noise = DepthNoise()
    order = [*range(0, 24, 2), *range(22, -1, -2)]
    truth = [inverse(frames[0].T_world_camera) @ frames[i].T_world_camera for i in order]
    step = se3_exp(drift / len(order))
    assert slam.loops is not None
    for k, i in enumerate(order[:keyframes]):
        slam.follow_corrections()
        T = slam.loops.poses[-1] @ inverse(truth[k - 1]) @ truth[k] @ step if k else np.eye(4)
        points = extract_points(frames[i].depth, slam.camera, slam.config.tracking.points, DepthNoise(), slam.context)
        tracking = TrackingResult(T, TrackingStatus.OK, 1.0, 0.0, "", points)
        slam.map_keyframe(NewKeyframe(dataclasses.replace(frames[i], index=k), tracking, slam.moves_followed))
        slam.mapper.run(2)
    return np.array(truth)
