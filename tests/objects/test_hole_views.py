# SPDX-License-Identifier: Apache-2.0
"""Where surface may be that a removed object hid: exact views of a box before a wall."""

from __future__ import annotations

import numpy as np
import pytest

from ggslam.objects.hole_views import CameraView, HoleView, could_be_hidden, is_open
from ggslam.scene.camera import Camera

CAMERA = Camera(40, 30, 30.0, 30.0, 19.5, 14.5)
BOX = np.zeros((30, 40), bool)
BOX[10:20, 15:25] = True
WALL_M, BOX_M = 3.0, 2.0


def hole_view(now: np.ndarray) -> HoleView:
    """From the origin along z: a box before a wall was removed; without it the view shows `now`."""
    before = np.where(BOX, np.float32(BOX_M), np.float32(WALL_M))
    return HoleView(CameraView(CAMERA, np.eye(4)), BOX, before, now.astype(np.float32), np.zeros((30, 40, 3)))


NOTHING_BEHIND = np.where(BOX, 0, WALL_M)
WALL_BEHIND = np.full((30, 40), WALL_M)
SHELF_BEHIND = np.where(BOX, 2.3, WALL_M)


@pytest.mark.parametrize(
    ("point", "now", "expected"),
    [
        ([0.0, 0.0, 2.5], NOTHING_BEHIND, True),  # the box hid it, and nothing hides it now
        ([0.0, 0.0, 2.5], WALL_BEHIND, True),
        ([0.0, 0.0, 2.5], SHELF_BEHIND, False),  # it would not show: a shelf is before it
        ([0.0, 0.0, 1.5], NOTHING_BEHIND, False),  # the view looked through it at the box
        ([1.0, 0.0, 2.0], NOTHING_BEHIND, False),  # ...and beside the box at the wall
        ([1.2, 0.0, 3.0], NOTHING_BEHIND, False),  # the wall was seen all the time
        ([9.0, 0.0, 2.5], NOTHING_BEHIND, False),  # in no view
    ],
)  # fmt: skip
def test_surface_may_be_where_nobody_looked(point: list[float], now: np.ndarray, expected: bool) -> None:
    assert could_be_hidden(np.array([point]), [hole_view(now)]).tolist() == [expected]


@pytest.mark.parametrize(
    ("z", "now", "expected"),
    [(2.5, NOTHING_BEHIND, True), (2.5, WALL_BEHIND, True), (3.0, WALL_BEHIND, False), (2.5, SHELF_BEHIND, False)],
)
def test_a_hole_is_open_where_nothing_closes_it(z: float, now: np.ndarray, expected: bool) -> None:
    assert is_open(np.array([[0.0, 0.0, z]]), [hole_view(now)]).tolist() == [expected]
    assert not is_open(np.array([[1.0, 0.0, z]]), [hole_view(now)]).any(), "the object hid nothing there"
