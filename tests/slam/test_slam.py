# SPDX-License-Identifier: Apache-2.0
"""The loop on frames that a user did not wish for."""

from __future__ import annotations

import dataclasses
from pathlib import Path
from unittest.mock import Mock

import numpy as np
import pytest

from ggslam.errors import SequenceError
from ggslam.mapping.keyframe import FROM_EARLIER_RUN
from ggslam.scene.frame import Frame
from ggslam.sequences import open_sequence
from ggslam.slam.config import load_config
from ggslam.slam.slam import Slam


@pytest.fixture(scope="module")
def frames(room: Path) -> list[Frame]:
    return list(open_sequence(room).stream())[:12]


def new_slam(frames: list[Frame], *overrides: str) -> Slam:
    return Slam(frames[0].camera, load_config(None, ["mapping.iterations_per_frame=1", *overrides]))


def blind(frame: Frame) -> Frame:
    return dataclasses.replace(frame, depth=np.zeros_like(frame.depth))


def test_five_lines_of_python(room: Path) -> None:
    sequence = open_sequence(room, stop=6)
    slam = Slam(sequence.camera)
    for frame in sequence.stream():
        slam.step(frame)
    result = slam.finish()
    assert result.trajectory().shape == (6, 4, 4) and len(result.gaussians) > 1000 and len(result.keyframes) >= 1


@pytest.mark.parametrize(("asked", "steps"), [(-1, 50), (0, 0), (7, 7)])
def test_a_run_ends_with_some_more_steps(frames: list[Frame], asked: int, steps: int) -> None:
    slam = new_slam(frames, f"refine_iterations={asked}")
    for frame in frames:
        slam.step(frame)
    before, told = slam.mapper.times.iterations, []
    assert before == 21 and slam.refinement_steps == steps
    result = slam.finish(lambda done, total: told.append((done, total)))
    assert result.refine_iterations == steps == slam.mapper.times.iterations - before
    assert told[-1:] == ([(steps, steps)] if steps else [])


def test_with_noisy_depth_the_last_iterations_are_two_steps(frames: list[Frame]) -> None:
    for setting, steps in (("mapping.sparse_noise=0.2", 2), ("mapping.sparse_noise=1000", 1)):
        slam = new_slam(frames, setting, "identity.enabled=false", "refine_iterations=5")
        for frame in frames[:3]:
            slam.step(frame)
        assert slam.mapper.times.steps == slam.mapper.times.iterations == 12
        slam.finish()
        assert slam.mapper.times.steps == 12 + steps * 5


def test_the_end_has_more_steps_than_the_frames_had_and_some_for_each_keyframe(frames: list[Frame]) -> None:
    mapper = new_slam(frames).mapper
    assert mapper.last_iterations(0) == 0 and mapper.last_iterations(1000) == 1300
    earlier = 500 * [Mock(frame_index=FROM_EARLIER_RUN)]
    mapper.keyframes = 200 * [Mock(frame_index=3)] + earlier
    assert mapper.last_iterations(0) == 0 and mapper.last_iterations(1000) == 2000
    mapper.is_live = True
    assert mapper.last_iterations(1000) == 400
    mapper.residency = Mock()
    assert mapper.last_iterations(1000) == 700


def test_a_frame_without_depth_is_lost_and_the_next_one_is_found(frames: list[Frame]) -> None:
    slam = new_slam(frames)
    for i, frame in enumerate(frames):
        report = slam.step(blind(frame) if i in (3, 4) else frame)
        assert (report.frame.status == "lost") == (i in (3, 4))
    result = slam.finish()
    poses = result.trajectory()
    assert np.isnan(poses[3:5]).all() and np.isfinite(poses[5:]).all()
    assert "depth" in result.frames[3].reason
    truth = np.linalg.inv(frames[0].T_world_camera) @ frames[-1].T_world_camera
    assert np.linalg.norm(poses[-1, :3, 3] - truth[:3, 3]) < 0.02


def test_frames_without_depth_at_the_beginning_are_passed_over(frames: list[Frame]) -> None:
    slam = new_slam(frames)
    for i, frame in enumerate(frames):
        slam.step(blind(frame) if i < 2 else frame)
    result = slam.finish()
    assert [f.status for f in result.frames[:3]] == ["lost", "lost", "first"]
    assert result.keyframes[0].frame_index == 2
    assert np.isfinite(result.trajectory()[2:]).all()


def test_only_blind_frames_make_no_map(frames: list[Frame]) -> None:
    slam = new_slam(frames)
    for frame in frames[:3]:
        slam.step(blind(frame))
    result = slam.finish()
    assert not result.keyframes and len(result.gaussians) == 0 and np.isnan(result.trajectory()).all()


def test_a_frame_of_another_size_is_refused(frames: list[Frame]) -> None:
    slam = new_slam(frames)
    slam.step(frames[0])
    with pytest.raises(SequenceError, match="10x10"):
        slam.step(dataclasses.replace(frames[1], depth=np.ones((10, 10), np.float32)))


@pytest.mark.parametrize("change", [{"color": np.zeros((120, 160), np.uint8)}, {"color": np.zeros((120, 160, 3))}])
def test_images_of_another_type_are_refused(frames: list[Frame], change: dict) -> None:
    slam = new_slam(frames)
    slam.step(frames[0])
    with pytest.raises(SequenceError, match="colour"):
        slam.step(dataclasses.replace(frames[1], **change))
    bad = frames[1].depth.copy()
    bad[3, 4] = np.nan
    with pytest.raises(SequenceError, match="NaN"):
        slam.step(dataclasses.replace(frames[1], depth=bad))
    slam.step(frames[1])  # the loop goes on
    assert len(slam.finish().trajectory()) == 2


def test_a_jump_to_another_place_is_lost_not_believed(room: Path, frames: list[Frame]) -> None:
    """Mirrored frames fit nowhere: some overlap can be had anywhere, but the images do not agree."""
    slam = new_slam(frames)
    for frame in frames[:4]:
        slam.step(frame)
    for i, frame in enumerate(frames[4:8]):
        turned = dataclasses.replace(
            frame, index=4 + i, color=np.ascontiguousarray(frame.color[:, ::-1]),
            depth=np.ascontiguousarray(frame.depth[:, ::-1]),
        )  # fmt: skip
        assert slam.step(turned).frame.status == "lost"
    assert len(slam.mapper.keyframes) <= 2


def test_spherical_harmonics_are_trained(frames: list[Frame]) -> None:
    slam = new_slam(frames, "sh_degree=2")
    for frame in frames[:6]:
        slam.step(frame)
    gaussians = slam.finish().gaussians
    assert gaussians.sh.shape[1:] == (9, 3) and float(gaussians.sh[:, 1:].abs().max()) > 0


def test_other_poses_of_the_true_start_change_nothing(frames: list[Frame]) -> None:
    """Ground truth is never used: scrambled truth gives the same trajectory."""
    trajectories = []
    for scramble in (False, True):
        slam = new_slam(frames)
        for frame in frames[:6]:
            truth = np.full((4, 4), 7.0) if scramble else frame.T_world_camera
            slam.step(dataclasses.replace(frame, T_world_camera=truth))
        trajectories.append(slam.finish().trajectory())
    assert np.array_equal(*trajectories)
