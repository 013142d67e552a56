# SPDX-License-Identifier: Apache-2.0
"""REP 105 in a run that closes loops: the camera has no jump in `odom`, and `map` -> `odom` takes the corrections."""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
import pytest
from serve_tools import KeptOutlet, chain

from ggslam.jobs.serve import channels as c
from ggslam.jobs.serve.live_contents import LiveContents
from ggslam.jobs.serve.live_serving import LIVE
from ggslam.jobs.serve.publishing import MapPublisher
from ggslam.loops.activity import ActivitySettings
from ggslam.messages.contents import Transforms
from ggslam.scene.frame import Frame
from ggslam.scene.poses import inverse, se3_exp, separation
from ggslam.sequences import open_sequence
from ggslam.slam.config import load_config
from ggslam.slam.loop_settings import LoopSettings
from ggslam.slam.result import SlamResult
from ggslam.slam.slam import Slam
from ggslam.tracking.points import extract_points
from ggslam.tracking.settings import DepthNoise
from ggslam.tracking.tracker import TrackingResult, TrackingStatus

CHEAP = [
    "mapping.iterations_per_frame=1", "mapping.first_frame_iterations=20", "identity.enabled=false",
    "keyframes.max_gap=1", "refine_iterations=0", "mapping.pose_refinement.enabled=false",
]  # fmt: skip
FORGETFUL = LoopSettings(activity=ActivitySettings(forget_after=0.05, near=0.15, batch=1, spread=0))
"""Whatever the camera has not seen for a step is put aside."""
ORDER = (*range(0, 24, 2), *range(22, -1, -2))
"""Frames of the room: there and back again."""
DRIFT = se3_exp(np.array([0.15, 0.06, -0.09, 0.0, np.radians(4), 0.0]) / len(ORDER))
"""Of a step: 18 cm and 4 degrees in all."""


@dataclass
class Played:
    """A run that closed loops.

    Attributes:
        trees: frames as told, one tree a frame and one as it came out.
        steps: of the camera as tracked, from each frame to the next [4, 4].
        known: pose of each frame [4, 4] as far as it was known when it was told.
        corrections: by frame, what closed loops did to the world about the camera [4, 4].
        result: of the run.
    """

    trees: list[Transforms] = field(default_factory=list)
    steps: list[np.ndarray] = field(default_factory=list)
    known: list[np.ndarray] = field(default_factory=list)
    corrections: dict[int, np.ndarray] = field(default_factory=dict)
    result: SlamResult | None = None


def let_drift(slam: Slam, steps: list[np.ndarray]) -> None:
    """The tracker goes by steps [4, 4], whatever it sees, from where corrections have put it."""
    tracker = slam.tracker
    tracker.noise = DepthNoise()

    def track(frame: Frame) -> TrackingResult:
        points = extract_points(frame.depth, slam.camera, tracker.settings.points, DepthNoise(), slam.context)
        if not frame.index:
            return TrackingResult(np.eye(4), TrackingStatus.FIRST, 1.0, 0.0, "", points)
        motion = tracker.state.motion
        motion.T_world_camera = motion.T_world_camera @ steps[frame.index - 1]
        return TrackingResult(motion.T_world_camera.copy(), TrackingStatus.OK, 0.8, 0.0, "", points)

    tracker.track = track  # type: ignore[method-assign]


def play(slam: Slam, frames: list[Frame], contents: LiveContents) -> Played:
    """Runs whole steps there and back again, and follows them."""
    T_true = [frames[i].T_world_camera for i in ORDER]
    played = Played(steps=[inverse(a) @ b @ DRIFT for a, b in zip(T_true[:-1], T_true[1:], strict=True)])
    let_drift(slam, played.steps)
    for number, i in enumerate(ORDER):
        frame, before = dataclasses.replace(frames[i], index=number, timestamp=number / 30), len(slam.corrections.moves)
        report = slam.step(frame)
        contents.follow(slam, frame, report)
        played.known.append(slam.pose_of(report.frame))
        if moves := slam.corrections.moves[before:]:
            (played.corrections[number],) = moves
    played.result = slam.finish()
    contents.finish(played.result)
    return played


@pytest.fixture(scope="module")
def played(room: Path) -> Played:
    """Drifts by 18 cm and closes its loops."""
    frames = list(open_sequence(room).stream())
    config = dataclasses.replace(load_config(None, CHEAP), loops=FORGETFUL)
    outlet = KeptOutlet()
    publisher = MapPublisher([(outlet, True)], LIVE)
    played = play(Slam(frames[0].camera, config, has_masks=False), frames, LiveContents(publisher))
    assert publisher.wait_idle(10.0)
    publisher.close()
    played.trees = [content for content in outlet.of(c.TF.name) if isinstance(content, Transforms)]
    assert played.result is not None and len(played.trees) == len(ORDER) + 1
    events = [event.kind for event in played.result.loop_events]
    assert events.count("closed") == len(played.corrections) > 0, events
    return played


def test_the_camera_has_no_jump_in_odom(played: Played) -> None:
    odom = [chain(tree, c.ODOM, c.CAMERA) @ c.T_CAMERA_OPTICAL for tree in played.trees]
    np.testing.assert_array_equal(odom[-1], odom[-2])  # the end corrects the map alone
    for before, after, step in zip(odom[:-2], odom[1:-1], played.steps, strict=True):
        assert separation(before, after)[0] <= separation(np.eye(4), step)[0] + 1e-3
        np.testing.assert_allclose(inverse(before) @ after, step, rtol=0, atol=1e-7)


def test_map_to_odom_takes_the_whole_correction(played: Played) -> None:
    """With the frame that closes a loop; between closed loops it stands still."""
    offsets = [chain(tree, c.MAP, c.ODOM) for tree in played.trees[:-1]]
    moved = {k: offsets[k] @ inverse(offsets[k - 1]) for k in range(1, len(ORDER))}
    for k, T_new_old in moved.items():
        np.testing.assert_allclose(T_new_old, played.corrections.get(k, np.eye(4)), rtol=0, atol=1e-7)
    assert max(separation(offsets[k - 1], offsets[k])[0] for k in played.corrections) > 0.03


def test_the_chain_is_the_trajectory(played: Played) -> None:
    assert played.result is not None
    for tree, T in zip(played.trees, [*played.known, played.result.trajectory()[-1]], strict=True):
        told = chain(tree, c.MAP, c.ODOM, c.CAMERA) @ c.T_CAMERA_OPTICAL
        np.testing.assert_allclose(told, T, rtol=0, atol=1e-9)
