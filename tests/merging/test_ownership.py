# SPDX-License-Identifier: Apache-2.0
"""A place belongs to the run that measured it best."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import numpy as np

from ggslam.merging.ownership import Ownership


def measured(*walls: tuple[float, float, float, int]) -> Any:
    """A run that measured a wall from x to x at a depth, with so many points a keyframe; the cameras stand at z = 0."""
    random = np.random.default_rng(0)
    points = [
        np.stack([random.uniform(a, b, n), random.uniform(-0.5, 0.5, n), np.full(n, z)], 1).astype(np.float32)
        for a, b, z, n in walls
    ]
    return SimpleNamespace(points=points)


def owners(runs: list[Any], points: list[list[float]]) -> list[int]:
    poses = [np.tile(np.eye(4), (len(run.points), 1, 1)) for run in runs]
    return Ownership(runs, poses, 0.1).of(np.array(points, float)).tolist()


def test_what_one_run_alone_saw_is_its_own() -> None:
    runs = [measured((-2, 0.2, 2.0, 4000)), measured((-0.2, 2, 2.0, 4000))]
    assert owners(runs, [[-1.5, 0, 2.0], [1.5, 0, 2.0]]) == [0, 1]


def test_what_both_saw_is_of_the_one_that_saw_it_from_nearer_or_more_often() -> None:
    far, often = measured((-1, 1, 2.0, 1000)), measured((-1, 1, 2.0, 1000), (-1, 1, 2.0, 1000))
    assert owners([far, often], [[0, 0, 2.0]]) == [1]
    assert owners([often, far], [[0, 0, 2.0]]) == [0]
    near, forward = measured((-1, 1, 1.0, 1000)), np.eye(4)  # the same wall, from a camera one metre nearer
    forward[2, 3] = 1.0
    found = Ownership([far, near], [np.eye(4)[None], forward[None]], 0.1).of(np.array([[0, 0, 2.0]]))
    assert found.tolist() == [1]


def test_what_nobody_measured_goes_with_the_nearest_that_somebody_did() -> None:
    runs = [measured((-2, 0, 2.0, 4000)), measured((0, 2, 2.0, 4000))]
    assert owners(runs, [[-1.5, 0, 3.0], [1.5, 0.9, 2.6]]) == [0, 1]


def test_without_points_all_is_the_first_runs() -> None:
    assert owners([measured(), measured()], [[0, 0, 1]]) == [0]
