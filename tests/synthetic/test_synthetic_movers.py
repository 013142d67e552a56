# SPDX-License-Identifier: Apache-2.0
"""What moves in a generated recording moves as it is told, and nothing else changes."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from command_line import ggslam

from ggslam.errors import SequenceError
from ggslam.scene.frame import Frame
from ggslam.scene.poses import inverse, transform_points
from ggslam.sequences import open_sequence
from ggslam.synthetic import write_synthetic_sequence
from ggslam.synthetic.movers import MOVERS, MoverTuning

FRAMES, SIZE = 16, {"width": 96, "height": 72}
MOVER_IDS = {"person", "mug", "sideboard drawer"}


@pytest.fixture(scope="module")
def recordings(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Folder with the recordings `moving` and its twin `still`, without noise."""
    folder = tmp_path_factory.mktemp("movers")
    for name, movers in (("moving", MOVERS), ("still", ())):
        write_synthetic_sequence(folder / name, frames=FRAMES, seed=1, noise=False, movers=movers, **SIZE)
    return folder


def truth_of(folder: Path) -> dict[str, Any]:
    return json.loads((folder / "movers.json").read_text())


def frames_of(folder: Path) -> list[Frame]:
    return list(open_sequence(folder))


def mask_of(frame: Frame) -> np.ndarray:
    mask = frame.load_mask()
    assert mask is not None
    return mask


@pytest.mark.long("two recordings of a room are drawn")
def test_truth_tells_who_moves_when(recordings: Path) -> None:
    truth, frames = truth_of(recordings / "moving"), frames_of(recordings / "moving")
    assert {m["name"] for m in truth["movers"]} == MOVER_IDS
    assert len(truth["frames"]) == FRAMES and not (recordings / "still" / "movers.json").exists()
    for number, mover in enumerate(truth["movers"]):
        told = [frame["movers"][number] for frame in truth["frames"]]
        moving = np.array([one["moving"] for one in told])
        first, last = np.flatnonzero(moving)[[0, -1]]
        assert 1 <= first < last < FRAMES - 1 and not moving[0] and moving[first : last + 1].all()
        poses = np.array([one["T_world"] for one in told])
        assert (poses[:first] == poses[0]).all() and (poses[last:] == poses[-1]).all()
        seen = [int((mask_of(frame) == mover["instance_id"]).sum()) for frame in frames]
        assert seen == [one["visible_px"] for one in told]
        assert np.count_nonzero(np.array(seen)[moving]) >= 3, mover["name"]
        names = open_sequence(recordings / "moving").instance_names
        assert names[mover["instance_id"]] == mover["name"]


@pytest.mark.long("two recordings of a room are drawn")
def test_points_on_movers_go_where_their_poses_say(recordings: Path) -> None:
    truth, frames = truth_of(recordings / "moving"), frames_of(recordings / "moving")
    compared = 0
    for number, mover in enumerate(truth["movers"]):
        if not mover["rigid"]:
            continue
        own = []
        for told, frame in zip(truth["frames"], frames, strict=True):
            chosen = (mask_of(frame) == mover["instance_id"]) & (frame.depth > 0)
            assert frame.T_world_camera is not None
            points = transform_points(frame.camera.back_project(frame.depth)[chosen], frame.T_world_camera)
            own.append(transform_points(points, inverse(np.array(told["movers"][number]["T_world"]))))
        everything = np.concatenate(own)
        # In its own axes it is one and the same small thing, whatever its way through the room.
        extent = everything.max(0) - everything.min(0)
        way = np.ptp([told["movers"][number]["T_world"] for told in truth["frames"]], axis=0)[:3, 3]
        at_rest = own[0].max(0) - own[0].min(0)
        if mover["name"] == "mug":
            assert (extent < 0.13).all() and way.max() > 0.15
        else:  # depth behind the front shows once it is open
            assert extent[0] < at_rest[0] + 0.03 and extent[2] < at_rest[2] + 0.05 and way.max() > 0.2
        compared += 1
    assert compared == 2


@pytest.mark.long("two recordings of a room are drawn")
def test_nothing_else_differs_from_the_twin(recordings: Path) -> None:
    truth = truth_of(recordings / "moving")
    ids = [m["instance_id"] for m in truth["movers"]]
    pairs = zip(frames_of(recordings / "moving"), frames_of(recordings / "still"), truth["frames"], strict=True)
    differing = 0
    for moving, still, told in pairs:
        assert np.array_equal(moving.T_world_camera, still.T_world_camera)
        masks = mask_of(moving), mask_of(still)
        covered = np.isin(masks[0], ids) | np.isin(masks[1], ids)
        assert np.array_equal(masks[0][~covered], masks[1][~covered])
        assert np.array_equal(moving.depth[~covered], still.depth[~covered])
        # Colour is the mean of four rays around the middle of a pixel.
        beside = cv2.dilate(covered.astype(np.uint8), np.ones((3, 3), np.uint8)) > 0
        assert np.array_equal(moving.color[~beside], still.color[~beside])
        if not any(mover["moving"] for mover in told["movers"]) and told["frame"] < FRAMES // 2:
            assert np.array_equal(moving.color, still.color) and np.array_equal(moving.depth, still.depth)
        differing += int((moving.depth != still.depth).sum())
    assert differing > 500


@pytest.mark.long("a recording of a room is drawn twice")
def test_the_command_repeats_bit_for_bit(tmp_path: Path) -> None:
    for name in "ab":
        done = ggslam("synth", tmp_path / name, "--movers", "mug", "--frames", 10, "--width", 32, "--height", 24)
        assert done.returncode == 0, done.stderr
    first, second = (truth_of(tmp_path / name) for name in "ab")
    assert first.pop("recording") == "a" and second.pop("recording") == "b" and first == second
    assert [m["name"] for m in first["movers"]] == ["mug"]
    for path in sorted((tmp_path / "a").rglob("*.png")):
        assert path.read_bytes() == (tmp_path / "b" / path.relative_to(tmp_path / "a")).read_bytes()


@pytest.mark.parametrize(
    ("words", "reason"),
    [(("--movers", "cat"), "expected some of walker, mug, door, found 'cat'"),
     (("--movers", "mug,"), "expected some of walker, mug, door, found ''"),
     (("--movers", "mug", "--rig", "front,back"), "not with --rig"),
     (("--movers", "mug", "--changes", 2), "not at two visits"),
     (("--movers", "mug", "--scene", "loop"), "only the room"),
     (("--movers", "mug", "--frames", MoverTuning.min_frames - 1), f"at least {MoverTuning.min_frames} frames")],
)  # fmt: skip
def test_what_cannot_move_is_refused(tmp_path: Path, words: tuple[object, ...], reason: str) -> None:
    done = ggslam("synth", tmp_path / "room", *words)
    assert done.returncode == 2 and reason in done.stderr and not (tmp_path / "room").exists()
    assert len(done.stderr.strip().splitlines()) == 1


def test_python_refuses_unknown_movers(tmp_path: Path) -> None:
    with pytest.raises(SequenceError, match="expected some of walker, mug, door, found 'dog'"):
        write_synthetic_sequence(tmp_path / "room", movers=["dog"])
