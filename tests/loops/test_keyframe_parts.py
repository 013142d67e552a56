# SPDX-License-Identifier: Apache-2.0
"""Parts of a recording in the books and in the pose graph."""

from __future__ import annotations

import numpy as np
import pytest

from ggslam.loops.parts import KeyframeParts
from ggslam.loops.pose_graph import PoseGraph
from ggslam.scene.poses import inverse, se3_exp, separation

pytest.importorskip("gtsam")

SURE = np.diag([1 / 0.0002**2] * 3 + [1 / np.radians(0.005) ** 2] * 3)
LOOP = np.diag([1 / 0.001**2] * 3 + [1 / np.radians(0.03) ** 2] * 3)
BEGIN, END = 20, 50


def test_parts_are_begun_grown_joined_and_named() -> None:
    parts = KeyframeParts()
    for before in (-1, 0, 1):
        parts.add(before)
    parts.begin()
    parts.add(3)
    parts.add(2)  # the camera was found in the first part
    parts.begin()
    assert parts.of == [0, 0, 0, 3, 3, 0, 6] and parts.begun == [0, 3, 6] and parts.all() == [0, 3, 6]
    assert parts.together(2, 5) and not parts.together(4, 5) and parts.members(4) == {3, 4}
    parts.join(6, 4)
    assert parts.of == [0, 0, 0, 3, 3, 0, 3] and parts.name(parts.members(6)) == "parts 2 and 3"
    parts.join(3, 1)
    assert parts.all() == [0] and parts.name(range(7)) == "parts 1, 2 and 3" and parts.name([0]) == "part 1"


def walk() -> np.ndarray:
    """50 poses along a bend of 7 m."""
    poses = [np.eye(4)]
    for _ in range(END - 1):
        poses.append(poses[-1] @ se3_exp(np.array([0, 0.002, 0.14, 0, 0.06, 0])))
    return np.array(poses)


def graph_in_two_parts(truth: np.ndarray, T_elsewhere: np.ndarray, noise: float = 0.0) -> PoseGraph:
    """From the 20th node on everything lies elsewhere, moved by [4, 4]."""
    random, graph = np.random.default_rng(1), PoseGraph()
    for k, T in enumerate(truth):
        moved = T_elsewhere @ T if k >= BEGIN else T
        error = se3_exp(random.normal(0, noise, 6)) if noise else np.eye(4)
        step = inverse(truth[k - 1]) @ T @ error if k else np.eye(4)
        if k and k != BEGIN:
            moved = graph.poses[-1] @ step
        graph.add_node(moved)
        if k:
            graph.add_odometry(k - 1, k, inverse(graph.poses[k - 1]) @ moved, SURE, unknown=k == BEGIN)
    return graph


@pytest.mark.parametrize("degrees", [0, 90, 179])
def test_loops_place_a_part_wherever_it_was(degrees: float) -> None:
    """A hundred metres away and turned: each node is back to a fiftieth of a millimetre, and the first part stays."""
    truth = walk()
    T_elsewhere = se3_exp(np.array([0, 0, 0, *np.radians(degrees) * np.array([0.6, 0, 0.8])]))
    T_elsewhere[:3, 3] = 3, -100, 2
    graph = graph_in_two_parts(truth, T_elsewhere)
    for i, j in ((3, 40), (4, 42)):
        graph.add_loop(i, j, inverse(truth[i]) @ truth[j], LOOP)
    start = [truth[k] if k in range(BEGIN, END) else T for k, T in enumerate(graph.poses)]  # as the loop closer does
    result = graph.optimise(start=start)
    assert result.accepted == (0, 1)
    moved = [separation(a, b) for a, b in zip(result.poses, truth, strict=True)]
    assert max(m for m, _ in moved) < 2e-5 and max(d for _, d in moved) < 1e-3


def test_a_false_loop_between_parts_is_outvoted() -> None:
    truth = walk()
    T_elsewhere = se3_exp(np.array([0, -100.0, 0, 0, 0.4, 0]))
    graph = graph_in_two_parts(truth, T_elsewhere, noise=1e-4)
    for i, j in ((3, 40), (4, 42), (6, 44)):
        graph.add_loop(i, j, inverse(truth[i]) @ truth[j], LOOP)
    wrong = inverse(truth[5]) @ truth[43]
    wrong[:3, 3] += 0.5, 0, 0.5
    false = graph.add_loop(5, 43, wrong, LOOP)
    back = inverse(T_elsewhere)
    result = graph.optimise(start=[back @ T if BEGIN <= k < END else T for k, T in enumerate(graph.poses)])
    assert list(result.rejected) == [false] and result.accepted == (0, 1, 2)
    assert max(separation(a, b)[0] for a, b in zip(result.poses, truth, strict=True)) < 0.03


def test_what_is_not_confirmed_moves_nothing() -> None:
    """One loop alone agrees with itself: without anything known of the way, nothing contradicts it."""
    truth = walk()
    graph = graph_in_two_parts(truth, se3_exp(np.array([0, -100.0, 0, 0, 0.4, 0])))
    before = np.array(graph.poses)
    waiting = graph.add_loop(3, 40, inverse(truth[3]) @ truth[40], LOOP)
    own = graph.add_loop(22, 45, inverse(truth[22]) @ truth[45], LOOP)
    wrong = inverse(truth[21]) @ truth[46]
    wrong[:3, 3] += 0.4, 0, 0
    false = graph.add_loop(21, 46, wrong, LOOP)  # what drift allows within a part is known as well as anywhere
    result = graph.optimise([waiting])
    assert result.accepted == (own,) and result.rejected.pop(waiting) == "not confirmed yet"
    assert list(result.rejected) == [false] and "beyond drift: " in result.rejected[false]
    assert np.abs(result.poses - before).max() < 1e-6
