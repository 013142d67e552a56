# SPDX-License-Identifier: Apache-2.0
"""Movers are told from one another and followed, with exact truth."""

from __future__ import annotations

from functools import cache

import numpy as np
import pytest
from box_scene import box_pose, camera_pose, error, render, view_of

from ggslam.movers.mover_table import FoundMover, MoverSight
from ggslam.movers.tracks import MoverTracks
from ggslam.scene.poses import inverse

BEGINS, FOUND, ENDS, LAST = 12, 16, 32, 44


def way(n: int) -> np.ndarray:
    """Rests, goes 30 cm to the right and turns by 40 degrees, rests."""
    done = np.clip((n - BEGINS) / (ENDS - BEGINS), 0, 1)
    return box_pose(0.3 * done, np.radians(40) * done, -0.1 * np.sin(np.pi * done))


@cache
def follow(ids: bool, noise: float = 0.0) -> list[FoundMover]:
    """What is known after a box was carried; that it moves is found four frames late."""
    tracks = MoverTracks()
    for n in range(LAST):
        frame = render(n, [(way(n), 7)], ids, noise)
        things = (frame.depth < 2.5).astype(np.int32) if FOUND <= n <= ENDS else None
        tracks.look(view_of(frame), things)
    return tracks.describe()


def world(sight: MoverSight) -> np.ndarray:
    """T_world_mover."""
    return camera_pose(sight.frame) @ sight.T_camera_mover


@pytest.mark.parametrize("noise", [0.0, 0.002])
def test_a_carried_box_keeps_its_id_and_its_displacement_is_known(noise: float) -> None:
    (mover,) = follow(ids=True, noise=noise)
    assert (mover.number, mover.instance, mover.kind, mover.found) == (7, 7, "rigid", FOUND)
    assert mover.before is not None and mover.after is not None
    T_new_old = world(mover.after) @ inverse(world(mover.before))
    metres, degrees = error(T_new_old, way(LAST) @ inverse(way(0)))
    assert metres < 0.01 and degrees < 3
    assert 0 < mover.scatter_m < 0.02


def test_it_is_known_to_have_moved_before_it_was_found() -> None:
    (mover,) = follow(ids=True)
    frames = [sight.frame for sight in mover.sights]
    assert abs(frames[0] - BEGINS) <= 2 and abs(frames[-1] - ENDS) <= 2
    assert frames == list(range(frames[0], frames[-1] + 1))


def test_its_pose_is_known_in_every_frame_and_its_box_holds_it() -> None:
    (mover,) = follow(ids=True)
    assert mover.before is not None
    for sight in mover.sights:
        metres, degrees = error(world(sight) @ inverse(world(mover.before)), way(sight.frame) @ inverse(way(0)))
        assert metres < 0.01 and degrees < 3
        assert (sight.high - sight.low > 0.1).all() and (sight.high - sight.low < 0.5).all()
    assert len(mover.points) > 300 and mover.points.shape == mover.colors.shape


def test_without_masks_it_is_one_mover_too() -> None:
    (mover,) = follow(ids=False)
    assert mover.instance is None and mover.number == 1 and mover.kind == "rigid"
    assert mover.sights[0].frame == FOUND  # nothing tells of it in earlier frames
    first, last = (world(mover.sights[k]) for k in (0, -1))
    metres, degrees = error(last @ inverse(first), way(mover.sights[-1].frame) @ inverse(way(FOUND)))
    assert metres < 0.02 and degrees < 5


def test_what_changes_its_shape_is_not_rigid() -> None:
    tracks = MoverTracks()
    for n in range(30):
        swing = 0.25 * np.sin(n / 3)
        parts = [(box_pose(0.02 * n - 0.3, swing, -0.2), 7), (box_pose(0.02 * n - 0.3 - swing, -3 * swing, 0.15), 7)]
        frame = render(n, parts)
        tracks.look(view_of(frame), (frame.depth < 2.5).astype(np.int32) if n > 2 else None)
    (mover,) = tracks.describe()
    assert mover.kind == "not rigid" and mover.before is None and mover.after is None


def test_two_that_move_are_two() -> None:
    tracks = MoverTracks()
    for n in range(24):
        frame = render(n, [(box_pose(-0.4, 0.03 * n), 3), (box_pose(0.4, 0.0, 0.01 * n), 4)])
        assert frame.mask is not None
        tracks.look(view_of(frame), np.where(frame.mask > 1, frame.mask, 0).astype(np.int32) if n > 4 else None)
    assert [mover.number for mover in tracks.describe()] == [3, 4]


def test_nothing_is_followed_where_nothing_moves() -> None:
    tracks = MoverTracks()

    def forbidden() -> None:
        raise AssertionError("masks are read only where something moves")

    for n in range(20):
        view = view_of(render(n, [(box_pose(0, 0), 7)]))
        view.load_mask = forbidden
        tracks.look(view, None)
    assert tracks.describe() == [] and len(tracks.recent) <= 16


def test_a_correction_of_the_world_moves_what_is_followed() -> None:
    tracks, T = MoverTracks(), box_pose(0.5, 0.3)
    for n in range(FOUND + 4):
        frame = render(n, [(way(n), 7)])
        tracks.look(view_of(frame), (frame.depth < 2.5).astype(np.int32) if n >= FOUND else None)
    before = tracks.tracks[0].tracker.T_world_mover.copy()
    tracks.move(T)
    np.testing.assert_allclose(tracks.tracks[0].tracker.T_world_mover, T @ before)
