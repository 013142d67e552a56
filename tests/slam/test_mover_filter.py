# SPDX-License-Identifier: Apache-2.0
"""A thing that is carried through a room, and one that is carried off, leave no ghosts in the map."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from box_room import CAMERA, QUICK, RED, picture, red_share

from ggslam.errors import RunFolderError
from ggslam.runs.recordings import read_moving
from ggslam.runs.saving import save_run
from ggslam.scene.frame import Frame
from ggslam.sequences.moving_pixels import MOVERS_FILE
from ggslam.slam.config import load_config
from ggslam.slam.saved_state import describe_state, restore_state
from ggslam.slam.slam import Slam

FRAMES, BEGINS, SPEED = 36, 12, 0.04


def box_at(n: int) -> float:
    """World x of the middle of the box at frame n: it rests, and is carried to the right out of sight."""
    return -0.5 + SPEED * max(0, n - BEGINS)


def frame(n: int) -> Frame:
    return picture(n, 0.004 * n, box_at(n))


def run(enabled: bool, frames: int = FRAMES) -> Slam:
    slam = Slam(CAMERA, load_config(None, [f"movers.enabled={enabled}".lower(), *QUICK]))
    for n in range(frames):
        slam.step(frame(n))
    return slam


@pytest.fixture(scope="module")
def with_search() -> Slam:
    return run(True)


@pytest.mark.long("three short runs")
def test_a_thing_that_is_carried_off_leaves_nothing(with_search: Slam) -> None:
    without = run(False)
    assert red_share(without, 0) > 0.03
    assert red_share(with_search, 0) < red_share(without, 0) / 10
    found = with_search.movers.pixels
    assert found.frames and min(found.frames) > BEGINS
    assert any(keyframe.moving is not None for keyframe in with_search.mapper.keyframes[:2])
    mask = found.mask(BEGINS + 12, (CAMERA.height, CAMERA.width))
    red = (frame(BEGINS + 12).color == RED).all(2)
    assert mask is not None and (mask & red).sum() > 0.95 * red.sum()
    assert "something moves in" in " ".join(with_search.result().notes)


def test_a_run_goes_on_bit_for_bit_while_something_moves() -> None:
    half = BEGINS + 10
    first, again = run(True, half), Slam(CAMERA, load_config(None, ["movers.enabled=true", *QUICK]))
    tree, arrays = describe_state(first)
    restore_state(again, tree, [array.copy() for array in arrays])
    for n in range(half, half + 4):
        first.step(frame(n))
        again.step(frame(n))
    assert first.movers.pixels.frames == again.movers.pixels.frames
    assert len(first.movers.pixels) > 0
    assert np.array_equal(first.map.means.numpy(), again.map.means.numpy())


def test_frames_without_movers_are_passed_on_as_they_are() -> None:
    slam = run(True, 3)
    given = frame(3)
    assert slam.track([given]).frames[0] is given


def test_masks_are_kept_with_the_run(with_search: Slam, tmp_path: Path) -> None:
    folder = save_run(with_search.result(), tmp_path / "run")
    moving = read_moving(folder.path)
    assert moving is not None and moving.frames == with_search.movers.pixels.frames
    (folder.path / MOVERS_FILE).write_bytes(b"PK")
    with pytest.raises(RunFolderError, match=r"movers\.npz"):
        read_moving(folder.path)
