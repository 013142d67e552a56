# SPDX-License-Identifier: Apache-2.0
"""The pose graph, reduced to the nodes that closures touch.

Odometry alone is a chain without contradictions. Between the keyframes that closures touch it is taken as one factor,
its covariance being the sum along the chain; what a correction does to the keyframes in between follows from the same
sums. The cost of an optimisation goes with the number of closures, not of keyframes.
"""

from __future__ import annotations

from dataclasses import dataclass
from types import ModuleType

import numpy as np
from scipy.special import gammaincinv  # scipy.stats takes a second to load

from ggslam.loops.odometry import OdometryTree
from ggslam.loops.uncertainty import adjoint, covariance_in_frame
from ggslam.scene.poses import inverse, orthonormalize, se3_exp, se3_log
from ggslam.system.array_forms import Covariance6, Pose
from ggslam.system.savable import savable


@savable()
@dataclass(frozen=True)
class Link:
    """Odometry or a closure: keyframe j seen from i at T_i_j [4, 4]; covariance [6, 6] of a left twist in frame i."""

    i: int
    j: int
    T_i_j: Pose
    covariance: Covariance6


class CondensedGraph:
    """The graph of those nodes alone that closures touch or odometry branches at; chains between them are one factor.

    Args:
        tree: odometry.
        poses: T_world_camera of all nodes.
        loops: closures to be judged.
    """

    def __init__(self, tree: OdometryTree, poses: list[np.ndarray], loops: list[Link]) -> None:
        self.tree, self.loops = tree, loops
        self.kept = self._kept_nodes()
        self.values = {k: poses[k] for k in self.kept}
        self.parents, self.anchors = np.array(tree.parents), np.zeros(len(poses), int)
        for node in range(1, len(poses)):  # the last kept node strictly before it
            parent = tree.parents[node]
            self.anchors[node] = parent if parent in self.values else self.anchors[parent]
        self.reckoned = np.array(tree.poses)
        self.from_anchor = inverse(self.reckoned[self.anchors]) @ self.reckoned
        self.covariances = self._chain_covariances()

    def _kept_nodes(self) -> list[int]:
        kept = {0} | {node for loop in self.loops for node in (loop.i, loop.j)}
        children = np.bincount(np.array(self.tree.parents[1:], int), minlength=len(self.tree.parents))
        return sorted(kept | set(np.flatnonzero(children > 1).tolist()))

    def _chain_covariances(self) -> np.ndarray:
        """Covariance [n, 6, 6] of each node's motion from its anchor, left twist in the anchor's frame."""
        starts = self.parents.copy()
        starts[0] = 0
        T_anchor_start = inverse(self.reckoned[self.anchors]) @ self.reckoned[starts]
        steps = covariance_in_frame(np.array(self.tree.steps), T_anchor_start)
        for node in range(1, len(steps)):
            if self.parents[node] != self.anchors[node]:
                steps[node] += steps[self.parents[node]]
        return steps

    def agreement(self, gtsam: ModuleType, probability: float) -> tuple[np.ndarray, float, np.ndarray]:
        """Which closures agree (bool [m]), the limit of a residual's Mahalanobis length, and the lengths found [m]."""
        limit = chi_squared_limit(probability) ** 0.5
        if not self.loops:
            return np.zeros(0, bool), limit, np.zeros(0)
        graph, values = self._problem(gtsam, np.ones(len(self.loops), bool))
        odometry = graph.size() - len(self.loops)
        parameters = gtsam.GncLMParams()
        parameters.setKnownInliers(list(range(odometry)))
        optimiser = gtsam.GncLMOptimizer(graph, values, parameters)
        optimiser.setInlierCostThresholdsAtProbability(probability)
        found = optimiser.optimize()
        lengths = [(2 * graph.at(odometry + k).error(found)) ** 0.5 for k in range(len(self.loops))]
        return np.asarray(optimiser.getWeights()).reshape(-1)[odometry:] > 0.5, limit, np.array(lengths)

    def optimize(self, gtsam: ModuleType, believed: np.ndarray) -> tuple[float, float]:
        """Moves the kept nodes to agree with the believed closures; returns the error before and after."""
        graph, values = self._problem(gtsam, believed)
        before = graph.error(values)
        found = gtsam.LevenbergMarquardtOptimizer(graph, values, gtsam.LevenbergMarquardtParams()).optimize()
        self.values = {k: orthonormalize(found.atPose3(k).matrix()) for k in self.kept}
        return float(before), float(graph.error(found))

    def all_poses(self) -> np.ndarray:
        """T_world_camera [n, 4, 4] of all nodes, given the kept ones.

        A chain whose end has to move by the twist xi moves in between by the conditional mean C_k C_end^-1 xi, C being
        the covariances along it; chains with a loose end keep their shape.
        """
        corrections = np.zeros((len(self.anchors), 6))
        for k in self.kept[1:]:
            T_anchor_end = inverse(self.values[self.anchors[k]]) @ self.values[k]
            push = np.linalg.solve(self.covariances[k], se3_log(T_anchor_end @ inverse(self.from_anchor[k])))
            node = self.parents[k]
            while node != self.anchors[k]:
                corrections[node] = self.covariances[node] @ push
                node = self.parents[node]
        out = [
            self.values[k] if k in self.values
            else self.values[a] @ se3_exp(corrections[k]) @ self.from_anchor[k]
            for k, a in enumerate(self.anchors)
        ]  # fmt: skip
        return np.array(out)

    def _problem(self, gtsam: ModuleType, chosen: np.ndarray) -> tuple:
        """Graph (the chains, then the chosen closures) and values of gtsam."""
        graph, values = gtsam.NonlinearFactorGraph(), gtsam.Values()
        for k in self.kept:
            values.insert(k, gtsam.Pose3(self.values[k]))
        # The first node holds the whole; any stiffness does, for nothing pulls at it.
        graph.add(gtsam.PriorFactorPose3(0, gtsam.Pose3(self.values[0]), gtsam.noiseModel.Isotropic.Sigma(6, 1e-3)))
        chains = [Link(self.anchors[k], k, self.from_anchor[k], self.covariances[k]) for k in self.kept[1:]]
        for link in chains + [loop for loop, ok in zip(self.loops, chosen, strict=True) if ok]:
            covariance = gtsam_covariance(link.covariance, link.T_i_j)
            noise = gtsam.noiseModel.Gaussian.Covariance(covariance)
            graph.add(gtsam.BetweenFactorPose3(link.i, link.j, gtsam.Pose3(link.T_i_j), noise))
        return graph, values


def chi_squared_limit(probability: float) -> float:
    """What the squared Mahalanobis length of six numbers stays below with this probability."""
    return float(2 * gammaincinv(3.0, probability))


def gtsam_covariance(covariance: np.ndarray, T_i_j: np.ndarray) -> np.ndarray:
    """The covariance [6, 6] of a left twist (v, w) in frame i as gtsam wants it: of a right twist (w, v) in frame j."""
    A = adjoint(inverse(T_i_j))[[3, 4, 5, 0, 1, 2]]
    out = A @ covariance @ A.T
    return 0.5 * (out + out.T)
