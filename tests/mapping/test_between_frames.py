# SPDX-License-Identifier: Apache-2.0
"""Frames between keyframes are kept and trained on where they help, and say of the scene what they show."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest

from ggslam.errors import FormatError
from ggslam.evaluation.images import psnr
from ggslam.mapping.between_frames import BetweenTuning, code_frame, frame_of_turn
from ggslam.mapping.keyframe import make_keyframe
from ggslam.scene.poses import inverse, se3_exp
from ggslam.sequences import open_sequence
from ggslam.slam.config import load_config
from ggslam.slam.saved_state import describe_state, restore_state
from ggslam.slam.slam import Slam
from ggslam.synthetic import write_synthetic_sequence
from ggslam.system.tuning import overridden

FEW = ["masks.source=none", "mapping.iterations_per_frame=2", "keyframes.max_gap=4", "evaluation.held_out_every=8"]


def run(recording: Path, *settings: str) -> Slam:
    sequence = open_sequence(recording)
    slam = Slam(sequence.camera, load_config(None, [*FEW, *settings]))
    for index in range(len(sequence)):
        slam.step(sequence.frame(index))
    return slam


@pytest.fixture(scope="module")
def exact(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("exact")
    return write_synthetic_sequence(folder, frames=16, width=160, height=120, noise=False)


def test_a_frame_follows_its_keyframe(exact: Path) -> None:
    sequence = open_sequence(exact)
    keyframe = make_keyframe(0, sequence.frame(0), np.eye(4))
    beside = code_frame(sequence.frame(3), 0, se3_exp(np.array([0.1, 0, 0.02, 0, 0.05, 0])))
    moved = se3_exp(np.array([1.0, 2.0, 0.5, 0.3, -0.2, 0.1]))
    keyframe.T_camera_world = inverse(moved)
    view = beside.view(keyframe)
    assert np.allclose(view.T_world_camera, moved @ beside.T_keyframe_camera)
    assert view.index == 0 and view.frame_index == 3 and not view.depth.any()
    assert psnr(view.color / 255, sequence.frame(3).color / 255) > 38
    with pytest.raises(FormatError, match="frames between keyframes"):
        replace(beside, color=beside.color[:0]).view(keyframe)
    with pytest.raises(FormatError, match="frames between keyframes"):
        beside.view(replace(keyframe, camera=replace(keyframe.camera, width=80)))


def test_a_keyframe_and_the_frames_beside_it_take_turns(exact: Path) -> None:
    frames = [code_frame(open_sequence(exact).frame(k), 0, np.eye(4)) for k in range(3)]
    turns = [frame_of_turn(turn, frames) for turn in range(8)]
    assert turns == [None, frames[0], None, frames[1], None, frames[2], None, frames[0]]
    assert frame_of_turn(1, []) is None


def test_frames_that_are_neither_keyframes_nor_held_out_are_kept(exact: Path) -> None:
    slam = run(exact)
    mapper = slam.mapper
    keyframes = {keyframe.frame_index for keyframe in mapper.keyframes}
    assert [kept.frame_index for kept in mapper.between] == [
        n for n in range(16) if n not in keyframes and not slam.config.evaluation.is_held_out(n)
    ]
    for kept, frame in ((kept, slam.frames[kept.frame_index]) for kept in mapper.between):
        assert kept.keyframe == frame.keyframe and np.array_equal(kept.T_keyframe_camera, frame.T_keyframe_camera)
    before, visits, steps = mapper.times.iterations, sum(k.iterations for k in mapper.keyframes), slam.refinement_steps
    slam.finish()
    assert mapper.times.iterations == before + steps
    assert sum(k.iterations for k in mapper.keyframes) == visits + steps  # a frame beside it is a visit of a keyframe


def as_if(slam: Slam, recording: Path, change: Callable[[np.ndarray], np.ndarray]) -> set[int]:
    """Gives every second frame between keyframes other colours; returns their places."""
    mapper, sequence = slam.mapper, open_sequence(recording)
    places = set(range(0, len(mapper.between), 2))
    for place in places:
        kept = mapper.between[place]
        frame = sequence.frame(kept.frame_index)
        changed = replace(frame, color=change(frame.color))
        mapper.between[place] = code_frame(changed, kept.keyframe, kept.T_keyframe_camera)
    return places


@pytest.mark.parametrize("change", ["none", "blurred", "brighter", "darker"])
def test_frames_of_another_exposure_or_without_focus_do_not_train(exact: Path, change: str) -> None:
    changes: dict[str, Callable[[np.ndarray], np.ndarray]] = {
        "none": lambda color: color, "blurred": lambda color: cv2.GaussianBlur(color, (0, 0), 3),
        "brighter": lambda color: np.clip(color * 1.05, 0, 255).astype(np.uint8),
        "darker": lambda color: (color * 0.95).astype(np.uint8),
    }  # fmt: skip
    slam = run(exact)
    mapper, steps = slam.mapper, slam.refinement_steps
    wrong = as_if(slam, exact, changes[change])
    mapper.judge_between()
    assert wrong and mapper.unfit == (set() if change == "none" else wrong)
    trained = [kept for beside in mapper._trained_beside(range(len(mapper.keyframes))).values() for kept in beside]
    assert len(trained) == len(mapper.between) - len(mapper.unfit)
    assert slam.refinement_steps == steps  # as many as before: a run that goes on here makes as many


def test_a_run_that_goes_on_leaves_the_same_out(exact: Path) -> None:
    """Cut off in its refinement, of which a state knows."""
    slam, whole = run(exact), run(exact)
    blur = lambda color: cv2.GaussianBlur(color, (0, 0), 3)  # noqa: E731
    for one in (slam, whole):
        as_if(one, exact, blur)
    whole.finish()

    def stop(done: int, total: int) -> None:
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        slam.finish(stop)
    tree, arrays = describe_state(slam)
    other = Slam(open_sequence(exact).camera, slam.config)
    restore_state(other, tree, [array.copy() for array in arrays])
    assert other.mapper.unfit == slam.mapper.unfit == whole.mapper.unfit != set()
    other.finish()
    assert np.array_equal(other.mapper.map.means.numpy(), whole.mapper.map.means.numpy())


@pytest.mark.parametrize("damage", ["nothing", "cut", "other size", "no number"])
def test_states_with_frames_that_cannot_be_are_refused(exact: Path, damage: str) -> None:
    slam = run(exact)
    mapper, kept = slam.mapper, slam.mapper.between[0]
    small = cv2.imencode(".jpg", np.zeros((60, 80, 3), np.uint8))[1].reshape(-1)
    wrong = {"nothing": kept.color[:0], "cut": kept.color[:30], "other size": small}
    if damage in wrong:
        mapper.between[0] = replace(kept, color=wrong[damage])
    else:
        mapper.unfit = {len(mapper.between)}
    with pytest.raises(FormatError, match="frames between keyframes"):
        mapper.check()


def test_none_are_kept_beside_keyframes_in_which_something_moves(exact: Path) -> None:
    sequence = open_sequence(exact)
    slam = Slam(sequence.camera, load_config(None, FEW))
    slam.step(sequence.frame(0))
    mapper, (keyframe,) = slam.mapper, slam.mapper.keyframes
    mapper.keep_between(sequence.frame(1), 0, np.eye(4))
    assert [kept.frame_index for kept in mapper.between] == [1]
    keyframe.moving = np.zeros(keyframe.color.shape[:2], bool)
    keyframe.moving[40:60, 40:60] = True
    mapper.keep_between(sequence.frame(2), 0, np.eye(4))
    assert [kept.frame_index for kept in mapper.between] == [1]


def test_none_are_kept_without_memory_or_where_depth_is_noisy(exact: Path, tmp_path: Path) -> None:
    with overridden(BetweenTuning, kept_bytes=0):
        assert not run(exact, "refine_iterations=0").mapper.between
    noisy = write_synthetic_sequence(tmp_path / "noisy", frames=6, width=160, height=120)
    assert not run(noisy, "refine_iterations=0").mapper.between
