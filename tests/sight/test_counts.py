# SPDX-License-Identifier: Apache-2.0
"""Counts over views that come, move and go are those over the views that are left."""

from __future__ import annotations

import numpy as np

from ggslam.scene.camera import Camera
from ggslam.scene.poses import se3_exp
from ggslam.sight.counts import SightCounts
from ggslam.sight.margin import Margin
from ggslam.sight.view import View

CAMERA = Camera(64, 48, 50.0, 50.0, 31.5, 23.5)


def wall_view(k: int, wall_m: float = 3.0) -> View:
    """Of a wall z = `wall_m`, from a place beside that of the view before, turned a little."""
    T = se3_exp(np.array([0.1 * k, 0.0, 0.0, 0.0, 0.03 * k, 0.0]))
    rays = CAMERA.rays().astype(float) @ T[:3, :3].T
    return View.of(((wall_m - T[2, 3]) / rays[..., 2]).astype(np.float32), CAMERA, T, Margin())


def points() -> np.ndarray:
    x, y = np.meshgrid(np.linspace(-1, 1, 9), np.linspace(-0.6, 0.6, 7))
    return np.concatenate([np.stack([x.ravel(), y.ravel(), np.full(63, z)], 1) for z in (2.0, 3.0, 3.5)])


def count(views: list[View]) -> SightCounts:
    counts = SightCounts.none(len(points()))
    for view in views:
        counts.add(view.classify_points(points()))
    return counts


def equal(one: SightCounts, other: SightCounts) -> bool:
    return all(np.array_equal(getattr(one, name), getattr(other, name)) for name in ("through", "same", "behind"))


def test_views_agree_on_a_wall() -> None:
    counts = count([wall_view(k) for k in range(6)])
    before, on, behind = np.split(np.arange(len(points())), 3)
    assert (counts.through[before] == counts.inside[before]).all() and counts.inside[before].min() >= 2
    assert (counts.same[on] == counts.inside[on]).all() and (counts.behind[behind] == counts.inside[behind]).all()
    gone = counts.is_looked_through(3, 2)
    assert gone[before].sum() > 50 and not gone[on].any() and not gone[behind].any()


def test_views_that_are_moved_and_forgotten_leave_nothing_behind() -> None:
    views, T = [wall_view(k) for k in range(6)], se3_exp(np.array([0.05, 0.1, -0.6, 0.0, 0.1, 0.0]))
    counts = count(views)
    moved = views[2].move(T)
    counts.remove(views[2].classify_points(points()))
    counts.add(moved.classify_points(points()))
    assert equal(counts, count([*views[:2], moved, *views[3:]])) and not equal(counts, count(views))
    for view in (*views[:2], moved, *views[3:]):
        counts.remove(view.classify_points(points()))
    assert equal(counts, SightCounts.none(len(points())))


def test_one_view_that_errs_is_not_enough() -> None:
    """Two views see through the wall's place: one more, and they would outvote a single one that shows it."""
    wrong = [wall_view(k, wall_m=5.0) for k in range(3)]
    on = slice(63, 126)
    assert not count([wrong[0], wrong[1]]).is_looked_through(3, 2)[on].any()
    assert count(wrong).is_looked_through(3, 2)[on].sum() > 20
    assert not count([*wrong, wall_view(0), wall_view(1)]).is_looked_through(3, 2)[on].any()
