# SPDX-License-Identifier: Apache-2.0
"""One pose graph over the keyframes of several runs."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from ggslam.loops.pose_graph import SURE_INFORMATION, PoseGraph
from ggslam.merging.common_ground import CommonGround
from ggslam.merging.known_run import KnownRun
from ggslam.merging.settings import MergeSettings
from ggslam.scene.poses import inverse

_NOTHING_KNOWN = np.zeros((6, 6))
"""Information of how two runs lie to each other before links tell it."""
Pair = tuple[int, int]
"""Numbers of two runs, the earlier one first."""


@dataclass(frozen=True)
class JudgedLink:
    """What became of a link between two runs.

    Attributes:
        runs: numbers of the two runs.
        old, new: keyframes of them.
        believed: whether the poses follow it.
        reason: why not; of one that is believed what was seen.
    """

    runs: Pair
    old: int
    new: int
    believed: bool
    reason: str


@dataclass(frozen=True)
class JointPoses:
    """Where the keyframes of all runs are in one world, the first run's.

    Attributes:
        T_new_old: of each run, float64 [K, 4, 4], what brings the world about each keyframe there.
        links: what became of each.
        seconds: that the graph took.
    """

    T_new_old: list[np.ndarray]
    links: list[JudgedLink]
    seconds: float

    def of(self, runs: list[KnownRun]) -> list[np.ndarray]:
        """T_world_camera of the keyframes in each run's places in the common world, float64 [K, 4, 4]."""
        return [T @ run.poses for T, run in zip(self.T_new_old, runs, strict=True)]


def attachment_order(count: int, grounds: Mapping[Pair, CommonGround], needed: int) -> list[Pair]:
    """How runs hang together: (a run that is in, one that joins by it), the surest first, beginning with run 0. Runs
    that share too little with all that are in are missing.

    Args:
        count: of runs.
        grounds: between pairs of runs, the earlier one first.
        needed: links that have to agree.
    """
    joined, order = {0}, list[Pair]()
    while len(joined) < count:
        ways = [
            (len(ground.agreeing), -a, -b) for (a, b), ground in grounds.items()
            if (a in joined) != (b in joined) and len(ground.agreeing) >= needed
        ]  # fmt: skip
        if not ways:
            break
        _, a, b = max(ways)
        known, new = (-a, -b) if -a in joined else (-b, -a)
        joined.add(new)
        order.append((known, new))
    return order


def solve_joint_graph(
    runs: list[KnownRun], grounds: Mapping[Pair, CommonGround], order: list[Pair], needed: int, settings: MergeSettings
) -> JointPoses:
    """Poses of all keyframes that agree with every run's own odometry and with the links between them.

    Each run is a chain of odometry. The first keyframe of the second and of later ones hangs on the first run by a
    motion of which nothing is known, so that links alone tell where it lies, and they bend every chain as far as its
    drift allows. Links that do not agree with most are left out before, and graduated non-convexity judges the rest.

    Args:
        runs: the first one's first keyframe stays where it is.
        grounds: links by pair of runs.
        order: as `attachment_order` gave it, with all runs.
        needed: links between two runs that have to agree.
        settings: see there.

    Raises:
        MissingDependency: gtsam is not installed.
    """
    T_first_run = _first_guess(runs, grounds, order)
    graph, starts = PoseGraph(settings.graph), list[int]()
    for number, run in enumerate(runs):
        starts.append(len(graph.poses))
        _add_chain(graph, T_first_run[number] @ run.poses)
        for old, new in run.closures:
            T = inverse(run.poses[old]) @ run.poses[new]
            graph.add_loop(starts[-1] + old, starts[-1] + new, T, SURE_INFORMATION)
    first, added = len(graph.loops), list[tuple[Pair, int]]()
    for pair, ground in grounds.items():
        for k in ground.agreeing if len(ground.agreeing) >= needed else ():
            link = ground.links[k]
            graph.add_loop(starts[pair[0]] + link.old, starts[pair[1]] + link.new, link.T_old_new, link.information)
            added.append((pair, k))
    result = graph.optimise()
    rejected = {added[k - first]: reason for k, reason in result.rejected.items() if k >= first}
    ends = [*starts[1:], len(result.poses)]
    moved = [result.poses[a:b] @ inverse(run.poses) for run, a, b in zip(runs, starts, ends, strict=True)]
    return JointPoses(moved, _judge_links(grounds, rejected, needed), result.seconds)


def _first_guess(runs: list[KnownRun], grounds: Mapping[Pair, CommonGround], order: list[Pair]) -> list[np.ndarray]:
    """T_first_run [4, 4] of each run by the link that most others agree with."""
    T_first_run = {0: np.eye(4)}
    for known, new in order:
        a, b = min(known, new), max(known, new)
        link = grounds[a, b].links[grounds[a, b].agreeing[0]]
        T_a_b = runs[a].poses[link.old] @ link.T_old_new @ inverse(runs[b].poses[link.new])
        T_first_run[new] = T_first_run[known] @ (T_a_b if known == a else inverse(T_a_b))
    return [T_first_run[number] for number in range(len(runs))]


def _add_chain(graph: PoseGraph, poses: np.ndarray) -> None:
    for k, T in enumerate(poses):
        node = graph.add_node(T)
        if k:
            graph.add_odometry(node - 1, node, inverse(poses[k - 1]) @ T, SURE_INFORMATION)
        elif node:
            graph.add_odometry(0, node, inverse(graph.poses[0]) @ T, _NOTHING_KNOWN)


def _judge_links(
    grounds: Mapping[Pair, CommonGround], rejected: Mapping[tuple[Pair, int], str], needed: int
) -> list[JudgedLink]:
    links = []
    for pair, ground in grounds.items():
        for k, link in enumerate(ground.links):
            refusal = rejected.get((pair, k), "")
            if len(ground.agreeing) < needed:
                refusal = f"no more than {len(ground.agreeing)} links of these runs agree"
            elif k not in ground.agreeing:
                refusal = "it does not agree with the others"
            reason = refusal or f"{link.inliers} features, {link.overlap:.0%} of the voxels"
            links.append(JudgedLink(pair, link.old, link.new, not refusal, reason))
    return links
