# SPDX-License-Identifier: Apache-2.0
"""A rig tracked as one body and mapped as one place."""

from __future__ import annotations

import dataclasses
import json
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from ggslam.errors import ConfigError
from ggslam.evaluation.trajectory import score_trajectory
from ggslam.scene.frame import Frame
from ggslam.scene.poses import inverse, separation
from ggslam.sequences import open_sequence
from ggslam.sequences.rig import RigSequence, by_instant
from ggslam.slam.config import Config, load_config
from ggslam.slam.filters.frame_filter import FrameFilter
from ggslam.slam.result import SlamResult
from ggslam.slam.rig_slam import RigSlam
from ggslam.slam.saved_state import describe_state, restore_state

FEW = ["mapping.iterations_per_frame=1", "mapping.first_frame_iterations=4", "identity.enabled=false",
       "refine_iterations=0"]  # fmt: skip
Change = Callable[[list[Frame]], list[Frame]]


@pytest.fixture(scope="module")
def sequence(rig: Path) -> RigSequence:
    found = open_sequence(rig)
    assert isinstance(found, RigSequence)
    return found


def config(*more: str) -> Config:
    return load_config(None, [*FEW, *more])


def run(sequence: RigSequence, change: Change = lambda frames: frames, settings: Config | None = None) -> RigSlam:
    slam = RigSlam(sequence.rig, settings or config(), sequence.has_masks)
    for frames in by_instant(sequence.stream(masks="lazy")):
        kept = change(frames)
        if kept:
            slam.step_together(kept)
    return slam


def errors(sequence: RigSequence, result: SlamResult, camera: int) -> float:
    """ATE of the frames of a camera, metres."""
    assert sequence.ground_truth is not None
    own = [k for k, f in enumerate(result.frames) if sequence.place_of(f.frame_index)[1] == camera]
    truth = sequence.ground_truth[[result.frames[k].frame_index for k in own]]
    scores = score_trajectory(result.trajectory()[own], truth)
    assert scores is not None
    return scores.ate_rmse_m


@pytest.fixture(scope="module")
def usual(sequence: RigSequence) -> tuple[RigSlam, SlamResult]:
    slam = run(sequence)
    return slam, slam.finish()


def darken(frame: Frame) -> Frame:
    return dataclasses.replace(frame, color=np.zeros_like(frame.color), depth=np.zeros_like(frame.depth))


def test_both_cameras_are_located_and_mapped(sequence: RigSequence, usual: tuple[RigSlam, SlamResult]) -> None:
    slam, result = usual
    assert len(result.frames) == len(sequence) == 48
    assert {f.status for f in result.frames} <= {"first", "ok", "recovered"}
    assert max(errors(sequence, result, k) for k in range(2)) < 0.01
    cameras = [k.camera_number for k in result.keyframes]
    assert min(cameras.count(0), cameras.count(1)) >= 3
    held_out = {f.index for f in sequence if f.instant in (4, 12, 20)}
    assert not held_out & {k.frame_index for k in result.keyframes}


def test_keyframes_of_an_instant_stay_as_the_rig_has_them(
    sequence: RigSequence, usual: tuple[RigSlam, SlamResult]
) -> None:
    """Training moves poses; those of one instant together, but for the 10 ms that the second camera is later."""
    by_moment: dict[int | None, dict[int, np.ndarray]] = {}
    for keyframe in usual[1].keyframes:
        by_moment.setdefault(keyframe.instant, {})[keyframe.camera_number] = keyframe.T_world_camera
    pairs = [poses for poses in by_moment.values() if len(poses) == 2]
    assert len(pairs) >= 3
    for poses in pairs:
        apart, turned = separation(inverse(poses[0]) @ poses[1], sequence.rig.T_first_camera[1])
        assert apart < 0.03 and turned < 1.5
        for T in poses.values():
            np.testing.assert_allclose(T[:3, :3] @ T[:3, :3].T, np.eye(3), atol=1e-9)


def test_the_later_camera_is_where_it_was_when_it_looked(
    sequence: RigSequence, usual: tuple[RigSlam, SlamResult]
) -> None:
    """Between its image and that of the first camera the rig moves by a centimetre and more."""
    assert sequence.ground_truth is not None
    result, truth = usual[1], sequence.ground_truth
    poses = result.trajectory()
    off, still = [], []
    for k in range(10, 46, 2):
        true = inverse(truth[k]) @ truth[k + 1]
        off.append(separation(inverse(poses[k]) @ poses[k + 1], true)[0])
        still.append(separation(sequence.rig.T_first_camera[1], true)[0])
    assert np.median(off) < 0.3 * np.median(still)


@pytest.mark.parametrize("camera", [0, 1])
def test_a_camera_that_goes_dark_costs_its_views_only(
    sequence: RigSequence, usual: tuple[RigSlam, SlamResult], camera: int
) -> None:
    def change(frames: list[Frame]) -> list[Frame]:
        dark = frames[0].instant is not None and 6 <= frames[0].instant < 16
        return [darken(f) if dark and f.camera_number == camera else f for f in frames]

    result = run(sequence, change).finish()
    assert not any(f.status == "lost" for f in result.frames)
    assert errors(sequence, result, 1 - camera) < max(2 * errors(sequence, usual[1], 1 - camera), 0.005)
    assert errors(sequence, result, camera) < 0.01  # it is carried along
    made = {(k.instant, k.camera_number) for k in result.keyframes}
    assert not any(c == camera and instant is not None and 6 <= instant < 16 for instant, c in made)
    assert any(c == camera and instant is not None and instant >= 16 for instant, c in made)


def test_frames_that_lack_are_no_trouble(sequence: RigSequence) -> None:
    """Each camera lacks some frames, the first one those at the end."""
    def change(frames: list[Frame]) -> list[Frame]:
        at = frames[0].instant or 0
        kept = [f for f in frames if not (f.camera_number == 0 and at >= 18) and not (f.camera_number and 3 <= at < 6)]
        return [] if at == 9 else kept

    result = run(sequence, change).finish()
    assert len(result.frames) == 48 - 6 - 3 - 2
    assert not any(f.status == "lost" for f in result.frames)
    assert max(errors(sequence, result, k) for k in range(2)) < 0.015


def test_all_dark_is_lost_and_found_again(sequence: RigSequence) -> None:
    def change(frames: list[Frame]) -> list[Frame]:
        return [darken(f) for f in frames] if frames[0].instant in (9, 10) else frames

    result = run(sequence, change).finish()
    assert [f.status for f in result.frames].count("lost") == 4
    assert result.frames[-1].status != "lost"
    assert max(errors(sequence, result, k) for k in range(2)) < 0.015


def test_cameras_of_different_sizes(rig: Path, tmp_path: Path) -> None:
    text = (rig / "rig.yaml").read_text().replace("recording: ", f"recording: {rig}/")
    (tmp_path / "rig.yaml").write_text(text.rstrip() + "\n  scale: 0.5\n  time_offset: -0.01\n")
    other = open_sequence(tmp_path)
    assert isinstance(other, RigSequence)
    assert [camera.width for camera in other.rig.cameras] == [128, 64]
    result = run(other).finish()
    assert {k.camera.width for k in result.keyframes} == {128, 64}
    assert max(errors(other, result, k) for k in range(2)) < 0.03  # times are wrong by 10 ms, too


def copied(slam: RigSlam) -> tuple[Any, Sequence[np.ndarray]]:
    tree, arrays = describe_state(slam)
    return json.loads(json.dumps(tree)), [array.copy() for array in arrays]


def test_another_run_goes_on_bit_for_bit(sequence: RigSequence) -> None:
    settings = config("identity.enabled=true", "identity.final_passes=1")
    slams = [RigSlam(sequence.rig, settings, sequence.has_masks) for _ in range(2)]
    for frames in by_instant(sequence.stream(masks="lazy")):
        slams[0].step_together(frames)
        if frames[0].instant == 7:
            restore_state(slams[1], *copied(slams[0]))
        elif frames[0].instant is not None and frames[0].instant > 7:
            slams[1].step_together(frames)
    one, other = (slam.finish() for slam in slams)
    assert one.trajectory().tobytes() == other.trajectory().tobytes()
    assert one.gaussians.means.numpy().tobytes() == other.gaussians.means.numpy().tobytes()
    assert one.places == other.places


@pytest.mark.parametrize("setting", ["realtime_fps=10", "memory_limit_mb=4000", "device=cuda", "tracker=edges_planes"])
def test_what_a_rig_does_not_go_with_is_refused(sequence: RigSequence, setting: str) -> None:
    with pytest.raises(ConfigError, match=f"^{setting.partition('=')[0]}: .*a rig of cameras"):
        RigSlam(sequence.rig, load_config(None, [setting]))


def test_keyframes_of_a_rig_are_not_aligned_one_by_one(sequence: RigSequence) -> None:
    slam = run(sequence)
    slam.tracker.state.residuals.hidden = 100
    before = [keyframe.T_world_camera for keyframe in slam.mapper.keyframes]
    slam.color_poses.align_keyframes()
    assert all(np.array_equal(k.T_world_camera, T) for k, T in zip(slam.mapper.keyframes, before, strict=True))


class Blindfold(FrameFilter):
    """Lets the tracker see no depth of one camera."""

    def expect(self, frame: Frame) -> Frame:
        return dataclasses.replace(frame, depth=np.zeros_like(frame.depth))


def test_the_tracker_aligns_what_each_cameras_filters_let_it_see(sequence: RigSequence) -> None:
    slam = RigSlam(sequence.rig, config(), sequence.has_masks)
    slam.chains[1].filters.append(Blindfold())
    frames = next(iter(by_instant(sequence)))
    located = slam.track([slam.clean(frame) for frame in frames])
    assert [len(result.points) > 0 for result in located.tracked] == [True, False]
    assert all(frame.depth.any() for frame in located.frames)  # the map is made of all depth
