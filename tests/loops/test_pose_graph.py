# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

import builtins

import numpy as np
import pytest

from ggslam.errors import MissingDependency
from ggslam.evaluation.trajectory import score_trajectory
from ggslam.loops.condensed import gtsam_covariance
from ggslam.loops.pose_graph import PoseGraph
from ggslam.loops.settings import GraphSettings
from ggslam.loops.uncertainty import adjoint, information_in_frame
from ggslam.scene.poses import inverse, se3_exp, se3_log

gtsam = pytest.importorskip("gtsam")

SURE = np.diag([1 / 0.0002**2] * 3 + [1 / np.radians(0.005) ** 2] * 3)
"""What G-ICP says of a motion: far too sure."""
SURE_LOOP = np.diag([1 / 0.001**2] * 3 + [1 / np.radians(0.03) ** 2] * 3)


def circuit(keyframes: int, rounds: float, radius: float = 3.2) -> np.ndarray:
    """Round after round (20 m each), looking ahead."""
    poses = []
    for angle in np.linspace(0, 2 * np.pi * rounds, keyframes, endpoint=False):
        T = se3_exp(np.array([0, 0, 0, 0, -angle, 0]))
        T[:3, 3] = radius * np.cos(angle), 0.05 * np.sin(3 * angle), radius * np.sin(angle)
        poses.append(T)
    return np.array(poses)


class DriftingRun:
    """A circuit with odometry that drifts: noise in every motion, and a bias along the path that noise forgets."""

    def __init__(self, seed: int, keyframes: int = 200, rounds: float = 1.3, settings: GraphSettings | None = None):
        self.random = np.random.default_rng(seed)
        self.truth, self.graph = circuit(keyframes, rounds), PoseGraph(settings)
        bias = np.concatenate([self.random.normal(0, 0.004, 3), np.radians(self.random.normal(0, 0.03, 3))])
        T = self.truth[0]
        self.graph.add_node(T)
        for k in range(1, keyframes):
            motion = inverse(self.truth[k - 1]) @ self.truth[k]
            motion = motion @ se3_exp(bias * np.linalg.norm(motion[:3, 3]) + self.noise(0.0008, 0.03))
            T = T @ motion
            self.graph.add_node(T)
            self.graph.add_odometry(k - 1, k, motion, SURE)
        self.odometry = np.array(self.graph.poses)
        where = self.truth[:, :3, 3]
        near = np.linalg.norm(where[:, None] - where[None], axis=2) < 0.4
        self.meetings = [(i, j) for i, j in zip(*np.nonzero(near), strict=True) if j - i > 20]

    def noise(self, metres: float, degrees: float) -> np.ndarray:
        return np.concatenate([self.random.normal(0, metres, 3), np.radians(self.random.normal(0, degrees, 3))])

    def add_true(self, count: int) -> list[int]:
        picks = self.random.choice(len(self.meetings), count, replace=False)
        pairs = [self.meetings[k] for k in picks]
        return [
            self.graph.add_loop(
                i, j, inverse(self.truth[i]) @ self.truth[j] @ se3_exp(self.noise(0.005, 0.2)), SURE_LOOP
            )
            for i, j in pairs
        ]

    def add_false(self, i: int, j: int, shift: np.ndarray) -> int:
        T = np.eye(4)
        T[:3, 3] = shift
        return self.graph.add_loop(i, j, T @ inverse(self.truth[i]) @ self.truth[j], SURE_LOOP)

    def ate(self, poses: np.ndarray) -> float:
        scores = score_trajectory(poses, self.truth)
        assert scores is not None
        return scores.ate_rmse_m


def direction(random: np.random.Generator) -> np.ndarray:
    v = random.normal(size=3)
    return v / np.linalg.norm(v)


@pytest.mark.parametrize("seed", range(5))
def test_true_closures_are_believed_and_false_ones_change_nothing(seed: int) -> None:
    run, clean = DriftingRun(seed), DriftingRun(seed)
    true = run.add_true(8)
    assert clean.add_true(8) == true
    false = []
    for _ in range(3):
        i, j = sorted(run.random.choice(len(run.truth), 2, replace=False).tolist())
        false.append(run.add_false(i, max(j, i + 25) % len(run.truth), direction(run.random)))
    result, wanted = run.graph.optimise(), clean.graph.optimise()
    assert result.accepted == tuple(true) == wanted.accepted
    assert sorted(result.rejected) == false
    assert run.ate(result.poses) < 0.75 * run.ate(run.odometry)
    assert run.ate(result.poses) == pytest.approx(clean.ate(wanted.poses), abs=1e-4)
    assert result.error_after < result.error_before


def test_closures_that_err_in_unison_are_rejected() -> None:
    run = DriftingRun(0)
    shift = direction(run.random)
    for i, j in run.meetings[::40][:5]:
        run.add_false(i, j, shift)
    result = run.graph.optimise()
    assert result.accepted == ()
    assert "0.98 m" in result.rejected[0] and "beyond drift" in result.rejected[0]
    np.testing.assert_allclose(result.poses, run.odometry, atol=1e-9)


def test_drift_of_ten_centimetres_over_twenty_metres_is_no_reason_to_reject() -> None:
    truth = circuit(150, 1.0)
    for shift, believed in ((0.1, True), (1.0, False)):
        graph = PoseGraph()
        graph.add_node(truth[0])
        for k in range(1, len(truth)):
            graph.add_node(truth[k])
            graph.add_odometry(k - 1, k, inverse(truth[k - 1]) @ truth[k], SURE)
        moved = truth[-1].copy()
        moved[0, 3] += shift
        graph.add_loop(0, len(truth) - 1, inverse(truth[0]) @ moved, SURE_LOOP)
        result = graph.optimise()
        assert (result.accepted == (0,)) is believed
        end = result.poses[-1][:3, 3] - truth[-1][:3, 3]
        assert np.linalg.norm(end) == pytest.approx(shift if believed else 0.0, abs=0.15 * shift)


def test_a_rejected_closure_gets_another_chance() -> None:
    """Two closures against each other within drift: others decide later which is right."""
    run = DriftingRun(3)
    (i, j), second = run.meetings[0], run.meetings[30]
    wrong = run.add_false(i, j, np.array([0.0, 0.0, 0.12]))
    assert run.graph.optimise().accepted == (wrong,)
    right = [
        run.graph.add_loop(a, b, inverse(run.truth[a]) @ run.truth[b], SURE_LOOP) for a, b in (run.meetings[5], second)
    ]
    right.append(run.graph.add_loop(i, j, inverse(run.truth[i]) @ run.truth[j], SURE_LOOP))
    result = run.graph.optimise()
    assert set(right) <= set(result.accepted) and wrong in result.rejected
    assert "disagrees" in result.rejected[wrong]


def test_three_thousand_keyframes() -> None:
    run = DriftingRun(1, keyframes=3000, rounds=20.0)
    true = run.add_true(60)
    false = [run.add_false(10 * k, 1500 + 7 * k, 3 * direction(run.random)) for k in range(3)]
    result = run.graph.optimise()
    assert set(false) == set(result.rejected)
    assert result.accepted == tuple(true)
    assert run.ate(result.poses) < 0.3 * run.ate(run.odometry)


def test_condensed_graph_agrees_with_the_whole_graph() -> None:
    """The same problem with every node and factor, given to gtsam."""
    run = DriftingRun(5)
    run.add_true(4)
    graph, values = gtsam.NonlinearFactorGraph(), gtsam.Values()
    tree = run.graph._tree
    first = gtsam.Pose3(run.odometry[0])
    graph.add(gtsam.PriorFactorPose3(0, first, gtsam.noiseModel.Isotropic.Sigma(6, 1e-3)))
    links = [(tree.parents[k], k, inverse(run.odometry[k - 1]) @ run.odometry[k], tree.steps[k]) for k in range(1, 200)]
    links += [(loop.i, loop.j, loop.T_i_j, loop.covariance) for loop in run.graph.loops]
    for k, T in enumerate(run.odometry):
        values.insert(k, gtsam.Pose3(T))
    for i, j, T, covariance in links:
        noise = gtsam.noiseModel.Gaussian.Covariance(gtsam_covariance(covariance, T))
        graph.add(gtsam.BetweenFactorPose3(int(i), int(j), gtsam.Pose3(T), noise))
    whole = gtsam.LevenbergMarquardtOptimizer(graph, values, gtsam.LevenbergMarquardtParams()).optimize()
    expected = np.array([whole.atPose3(k).translation() for k in range(200)])
    found = run.graph.optimise()
    moved = np.linalg.norm(expected - run.odometry[:, :3, 3], axis=1).max()
    assert moved > 0.03
    assert np.linalg.norm(found.poses[:, :3, 3] - expected, axis=1).max() < 0.03 * moved
    assert found.error_after == pytest.approx(graph.error(whole), rel=0.05)


def test_odometry_may_branch() -> None:
    """After being lost a camera is tied to the keyframe it was found at."""
    graph = PoseGraph()
    steps = [np.eye(4), se3_exp(np.array([1.0, 0, 0, 0, 0, 0])), se3_exp(np.array([0, 1.0, 0, 0, 0.1, 0]))]
    graph.add_node(steps[0])
    for parent, node, T in ((0, 1, steps[1]), (0, 2, steps[2]), (2, 3, steps[1])):
        graph.add_node(graph.poses[parent] @ T)
        graph.add_odometry(parent, node, T, SURE)
    T = inverse(graph.poses[1]) @ graph.poses[3]
    before = np.array(graph.poses)
    T[2, 3] += 0.02
    graph.add_loop(1, 3, T, SURE_LOOP)
    result = graph.optimise()
    assert result.accepted == (0,)
    closed = inverse(result.poses[1]) @ result.poses[3]
    assert np.linalg.norm(se3_log(closed @ inverse(T))) < 0.01
    assert np.linalg.norm(result.poses[2] - before[2]) > 1e-4
    np.testing.assert_allclose(result.poses[0], before[0], atol=1e-9)


def test_covariance_reaches_gtsam_in_its_own_convention() -> None:
    """gtsam's error of a sample is the same Mahalanobis length that our left twist has."""
    random = np.random.default_rng(0)
    A = random.normal(size=(6, 6))
    covariance = 1e-4 * (A @ A.T + np.eye(6))
    T = se3_exp(np.array([0.5, -1.0, 2.0, 0.4, -0.8, 0.3]))
    factor = gtsam.BetweenFactorPose3(
        0, 1, gtsam.Pose3(T), gtsam.noiseModel.Gaussian.Covariance(gtsam_covariance(covariance, T))
    )
    for twist in 1e-4 * random.normal(size=(5, 6)):
        values = gtsam.Values()
        values.insert(0, gtsam.Pose3())
        values.insert(1, gtsam.Pose3(se3_exp(twist) @ T))
        assert 2 * factor.error(values) == pytest.approx(twist @ np.linalg.solve(covariance, twist), rel=1e-3)


def test_information_changes_frame_with_the_twist() -> None:
    random = np.random.default_rng(1)
    T_world_i, T_world_j = (se3_exp(random.normal(size=6)) for _ in range(2))
    information = np.diag(random.uniform(1, 9, 6))
    twist = 1e-5 * random.normal(size=6)
    T_i_j = inverse(T_world_i) @ T_world_j
    moved = se3_log(inverse(T_world_i) @ se3_exp(twist) @ T_world_j @ inverse(T_i_j))
    np.testing.assert_allclose(adjoint(inverse(T_world_i)) @ twist, moved, atol=1e-9)
    in_i = information_in_frame(information, inverse(T_world_i))
    assert moved @ in_i @ moved == pytest.approx(twist @ information @ twist, rel=1e-4)


def test_unseen_directions_do_not_break_the_graph() -> None:
    flat = np.diag([1e6, 0.0, 1e6, 1e6, 1e6, 0.0])
    graph = PoseGraph()
    T = se3_exp(np.array([0.1, 0, 0, 0, 0, 0]))
    graph.add_node(np.eye(4))
    for k in range(1, 5):
        graph.add_node(graph.poses[-1] @ T)
        graph.add_odometry(k - 1, k, T, flat)
    shifted = inverse(graph.poses[0]) @ graph.poses[4]
    shifted[1, 3] += 2.0
    graph.add_loop(0, 4, shifted, SURE_LOOP)
    result = graph.optimise()
    assert result.accepted == (0,)
    assert result.poses[4][1, 3] == pytest.approx(2.0, abs=0.05)
    assert result.poses[2][1, 3] == pytest.approx(1.0, abs=0.1)


def test_misuse_is_told() -> None:
    graph = PoseGraph()
    graph.add_node(np.eye(4))
    assert len(graph.optimise().poses) == 1
    graph.add_node(np.eye(4))
    with pytest.raises(ValueError, match=r"node 1\b"):
        graph.add_node(np.eye(4))
    with pytest.raises(ValueError, match=r"node 1\b"):
        graph.optimise()
    with pytest.raises(ValueError, match=r"\b1\b.*\b1\b"):
        graph.add_odometry(1, 1, np.eye(4), SURE)
    graph.add_odometry(0, 1, np.eye(4), SURE)
    with pytest.raises(ValueError, match="none yet"):
        graph.add_odometry(0, 1, np.eye(4), SURE)
    with pytest.raises(ValueError, match=r"\b0\b.*\b7\b"):
        graph.add_loop(0, 7, np.eye(4), SURE)


def test_missing_gtsam_is_told(monkeypatch: pytest.MonkeyPatch) -> None:
    real = builtins.__import__

    def without_gtsam(name: str, *args: object, **kwargs: object) -> object:
        if name == "gtsam":
            raise ImportError(name)
        return real(name, *args, **kwargs)

    graph = PoseGraph()
    graph.add_node(np.eye(4))
    monkeypatch.setattr(builtins, "__import__", without_gtsam)
    with pytest.raises(MissingDependency, match="gtsam"):
        graph.optimise()
