# SPDX-License-Identifier: Apache-2.0
"""Links between runs: the largest set that agrees, and one graph over all keyframes."""

from __future__ import annotations

import dataclasses
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from ggslam.loops.agreement import GroundLink, agreeing_links
from ggslam.loops.settings import GraphSettings
from ggslam.merging.common_ground import CommonGround
from ggslam.merging.joint_graph import attachment_order, solve_joint_graph
from ggslam.merging.settings import MergeSettings
from ggslam.scene.poses import inverse, se3_exp, separation

pytest.importorskip("gtsam")

SURE = np.diag([1 / 0.001**2] * 3 + [1 / np.radians(0.03) ** 2] * 3)
T_A_B = se3_exp(np.array([3.0, -1.0, 2.0, 0.4, -2.0, 0.7]))
"""How the world of the second run lies in that of the first."""


def walk(keyframes: int, start: float = 0.0) -> np.ndarray:
    """A camera that walks round a room and looks ahead."""
    poses = []
    for k in range(keyframes):
        angle = start + 0.08 * k
        T = se3_exp(np.array([0, 0, 0, 0, -angle, 0]))
        T[:3, 3] = 2 * np.cos(angle), 0.05 * np.sin(3 * angle), 2 * np.sin(angle)
        poses.append(T)
    return np.array(poses)


def drifted(poses: np.ndarray, twist: np.ndarray) -> np.ndarray:
    """The same walk as odometry has it that errs by a twist at each step."""
    out = [poses[0]]
    for before, T in zip(poses, poses[1:], strict=False):
        out.append(out[-1] @ inverse(before) @ T @ se3_exp(twist))
    return np.array(out)


def known(poses: np.ndarray, closures: tuple[tuple[int, int], ...] = ()) -> Any:
    """As much of a run as the graph asks for."""

    class Run(SimpleNamespace):
        def __len__(self) -> int:
            return len(self.poses)

    return Run(poses=poses, closures=list(closures))


def link(first: np.ndarray, second: np.ndarray, i: int, j: int, error: np.ndarray | None = None) -> GroundLink:
    """What is seen of keyframe j of the second run from keyframe i of the first, by true poses in one world."""
    T = inverse(first[i]) @ second[j]
    return GroundLink(i, j, T if error is None else T @ se3_exp(error), SURE, 50, 0.8)


def ground(links: list[GroundLink], first: np.ndarray, second: np.ndarray) -> CommonGround:
    return CommonGround(links, agreeing_links(links, first, second, GraphSettings()))


@pytest.fixture
def random() -> np.random.Generator:
    return np.random.default_rng(3)


def test_wrong_links_do_not_agree_with_right_ones(random: np.random.Generator) -> None:
    first, second = walk(40), walk(40, start=1.6)
    own = inverse(T_A_B) @ second
    right = [link(first, second, 20 + k, k, random.normal(0, 0.003, 6)) for k in range(0, 20, 3)]
    wrong = [link(first, second, 5, 30, np.array([1.5, 0, 0, 0, 0.5, 0])) for _ in range(1)]
    wrong += [link(first, second, 9 + k, 33, random.normal(0, 1.0, 6)) for k in range(5)]
    found = agreeing_links(wrong + right, first, own, GraphSettings())
    assert sorted(found) == list(range(len(wrong), len(wrong) + len(right)))


def test_links_that_drift_explains_agree_and_others_far_along_do_not() -> None:
    """A centimetre between neighbours is too much, ten between keyframes at the ends of a long walk are not."""
    first, second = walk(120), walk(120, start=0.0)
    shift = np.array([0.12, 0, 0, 0, 0, 0])
    near = [link(first, second, 0, 0), link(first, second, 1, 1, shift)]
    far = [link(first, second, 0, 0), link(first, second, 110, 110, shift)]
    assert len(agreeing_links(near, first, second, GraphSettings())) == 1
    assert len(agreeing_links(far, first, second, GraphSettings())) == 2


def test_no_links_agree_with_none() -> None:
    assert agreeing_links([], walk(3), walk(3), GraphSettings()) == []


def test_runs_join_by_the_surest_way_and_those_without_one_are_missing() -> None:
    sure, unsure, too_few = (CommonGround(agreeing=list(range(n))) for n in (9, 4, 2))
    grounds = {(0, 1): unsure, (0, 2): too_few, (1, 2): sure, (0, 3): too_few, (1, 3): too_few, (2, 3): too_few}
    assert attachment_order(4, grounds, needed=3) == [(0, 1), (1, 2)]


def test_the_second_run_comes_into_the_world_of_the_first(random: np.random.Generator) -> None:
    first, second = walk(40), walk(40, start=1.6)
    runs = [known(first), known(inverse(T_A_B) @ second)]
    links = [link(first, second, 20 + k, k, random.normal(0, 0.002, 6)) for k in range(0, 20, 2)]
    grounds = {(0, 1): ground(links, first, runs[1].poses)}
    poses = solve_joint_graph(runs, grounds, [(0, 1)], 3, MergeSettings())
    assert np.allclose(poses.T_new_old[0][0], np.eye(4), atol=1e-6)
    for T, truth, own in zip(poses.T_new_old[1], second, runs[1].poses, strict=True):
        apart, turned = separation(T @ own, truth)
        assert apart < 0.02 and turned < 0.4
    assert all(judged.believed for judged in poses.links)


def test_several_links_correct_drift_within_a_run(random: np.random.Generator) -> None:
    """The second walk is the first one again, tracked with drift of 16 cm. Links along it bend both until they meet:
    nothing tells which of the two has drifted."""
    first = walk(80)
    off = drifted(first, np.array([0, 0.002, 0, 0, 0, 0]))
    runs = [known(first), known(inverse(T_A_B) @ off)]
    links = [link(first, first, k, k, random.normal(0, 0.001, 6)) for k in range(0, 80, 6)]
    grounds = {(0, 1): ground(links, first, runs[1].poses)}
    poses = solve_joint_graph(runs, grounds, [(0, 1)], 3, MergeSettings())
    ours, theirs = (T @ run.poses for T, run in zip(poses.T_new_old, runs, strict=True))
    assert np.linalg.norm((off - first)[:, :3, 3], axis=1).max() > 0.15
    assert np.linalg.norm((theirs - ours)[:, :3, 3], axis=1).max() < 0.015
    assert np.linalg.norm((ours - first)[:, :3, 3], axis=1).max() < 0.1


def test_wrong_links_among_right_ones_are_rejected_with_a_reason(random: np.random.Generator) -> None:
    first, second = walk(40), walk(40, start=1.6)
    own = inverse(T_A_B) @ second
    links = [link(first, second, 20 + k, k, random.normal(0, 0.002, 6)) for k in range(0, 12, 2)]
    links.append(link(first, second, 10, 30, np.array([0.8, 0, 0.3, 0, 0.4, 0])))
    grounds = {(0, 1): ground(links, first, own)}
    poses = solve_joint_graph([known(first), known(own)], grounds, [(0, 1)], 3, MergeSettings())
    assert [judged.believed for judged in poses.links] == [True] * 6 + [False]
    assert "agree" in poses.links[-1].reason
    assert np.linalg.norm((poses.T_new_old[1] @ own - second)[:, :3, 3], axis=1).max() < 0.02


def test_a_third_run_may_hang_on_the_second_alone(random: np.random.Generator) -> None:
    truth = [walk(40), walk(40, start=1.6), walk(40, start=3.2)]
    own = [truth[0], inverse(T_A_B) @ truth[1], T_A_B @ truth[2]]
    grounds = {(0, 2): CommonGround()}
    for a, b in ((0, 1), (1, 2)):
        links = [link(truth[a], truth[b], 20 + k, k, random.normal(0, 0.002, 6)) for k in range(0, 20, 2)]
        grounds[a, b] = ground(links, own[a], own[b])
    order = attachment_order(3, grounds, 3)
    poses = solve_joint_graph([known(p) for p in own], grounds, order, 3, MergeSettings())
    for T, p, true in zip(poses.T_new_old, own, truth, strict=True):
        assert np.linalg.norm((T @ p - true)[:, :3, 3], axis=1).max() < 0.04


def test_too_little_is_said_with_the_best_that_was_found() -> None:
    assert "no keyframe" in CommonGround().verdict(3)
    refused = CommonGround(refusal="4 and 7, was refused: 9 of 60 matches agree", compared=12)
    assert "12 pairs" in refused.verdict(3) and "9 of 60" in refused.verdict(3)
    links = [link(walk(4), walk(4), 0, 0)] * 2
    assert "2 pairs" in dataclasses.replace(refused, links=links, agreeing=[0]).verdict(3)
