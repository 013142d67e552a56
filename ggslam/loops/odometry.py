# SPDX-License-Identifier: Apache-2.0
"""Odometry as dead reckoning, with its growing covariance."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from ggslam.errors import FormatError
from ggslam.loops.uncertainty import covariance_in_frame
from ggslam.scene.poses import inverse, orthonormalize
from ggslam.system.array_forms import Covariance6, Pose
from ggslam.system.savable import savable


@savable(growing="parents poses covariances steps", check="check")
@dataclass
class OdometryTree:
    """Odometry as dead reckoning: every node is linked to an earlier one.

    `poses` are relative to the first node; `covariances` of their left twists in its frame; `steps` the covariance of
    the last motion alone, in the frame of the node it starts from.
    """

    parents: list[int] = field(default_factory=list)
    poses: list[Pose] = field(default_factory=list)
    covariances: list[Covariance6] = field(default_factory=list)
    steps: list[Covariance6] = field(default_factory=list)

    @classmethod
    def root(cls) -> OdometryTree:
        """The first node alone."""
        return cls([-1], [np.eye(4)], [np.zeros((6, 6))], [np.zeros((6, 6))])

    def check(self) -> None:
        """Raises FormatError if nodes do not hang on earlier ones: it may come from a file."""
        count = len(self.poses)
        if not len(self.parents) == len(self.covariances) == len(self.steps) == count:
            raise FormatError("odometry: the numbers of poses and motions disagree")
        if any(not 0 <= parent < node for node, parent in enumerate(self.parents) if node) or self.parents[:1] not in (
            [], [-1],
        ):  # fmt: skip
            raise FormatError("odometry: a keyframe is linked to a later one")

    def __len__(self) -> int:
        return len(self.poses)

    def add(self, parent: int, T_parent_node: np.ndarray, covariance: np.ndarray) -> None:
        """The next node, with the covariance [6, 6] of the left twist of its motion in its parent's frame."""
        self.parents.append(parent)
        T = orthonormalize(self.poses[parent] @ T_parent_node)
        moved = covariance_in_frame(covariance, self.poses[parent])
        self.poses.append(T)
        self.covariances.append(self.covariances[parent] + moved)
        self.steps.append(covariance)

    def common_ancestor(self, i: int, j: int) -> int:
        """The last node that the ways from the first to i and to j share."""
        while i != j:  # a node comes after its parent
            if i > j:
                i = self.parents[i]
            else:
                j = self.parents[j]
        return i

    def covariance_between(self, i: int, j: int) -> np.ndarray:
        """Covariance [6, 6] of the motion T_i_j by odometry alone, left twist in frame i."""
        summed = self.covariances[i] + self.covariances[j] - 2 * self.covariances[self.common_ancestor(i, j)]
        return covariance_in_frame(summed, inverse(self.poses[i]))
