# SPDX-License-Identifier: Apache-2.0
"""Selects those common places of two runs, or of two parts of one, that agree on the transform between them."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ggslam.loops.condensed import chi_squared_limit
from ggslam.loops.odometry import OdometryTree
from ggslam.loops.pose_graph import SURE_INFORMATION, closure_covariance, odometry_covariance
from ggslam.loops.settings import GraphSettings
from ggslam.loops.uncertainty import covariance_in_frame
from ggslam.scene.poses import inverse, se3_log


@dataclass(frozen=True)
class GroundLink:
    """Two keyframes of two runs that see the same surfaces.

    Attributes:
        old, new: numbers of the keyframes, each in its own run.
        T_old_new: float64 [4, 4], the new keyframe's camera seen from the old one's.
        information: float64 [6, 6], inverse covariance of the left twist (v, w) in the old frame.
        inliers: features that agree.
        overlap: share of the voxels that are filled in both places.
    """

    old: int
    new: int
    T_old_new: np.ndarray
    information: np.ndarray
    inliers: int
    overlap: float


def agreeing_links(
    links: list[GroundLink], old_poses: np.ndarray, new_poses: np.ndarray, settings: GraphSettings
) -> list[int]:
    """Numbers of the links of the largest set that agrees with one of them, as far as drift within either run allows;
    that one first. Wrong links agree with hardly any other.

    Args:
        old_poses, new_poses: T_world_camera of the keyframes, float64 [K, 4, 4] each, each in its own world.
    """
    if not links:
        return []
    old, new = (np.array([getattr(link, name) for link in links]) for name in ("old", "new"))
    T_old_new = np.array([link.T_old_new for link in links])
    own = np.array([closure_covariance(link.T_old_new, link.information, settings) for link in links])
    chains = Chain(old_poses, settings), Chain(new_poses, settings)
    limit = chi_squared_limit(settings.drift_probability)
    best: list[int] = []
    for k in range(len(links)):
        T_old_k = inverse(old_poses[old]) @ old_poses[old[k]]  # [m, 4, 4], from each link's old keyframe to this one's
        T_old_knew = T_old_k @ T_old_new[k]
        expected = T_old_knew @ inverse(new_poses[new[k]]) @ new_poses[new]
        within_old = chains[0].covariance(old, np.full(len(links), old[k]))
        within_new = covariance_in_frame(chains[1].covariance(np.full(len(links), new[k]), new), T_old_knew)
        covariance = within_old + covariance_in_frame(own[k], T_old_k) + within_new
        twists = np.array([se3_log(T @ inverse(E)) for T, E in zip(T_old_new, expected, strict=True)])
        squared = np.einsum("ni,ni->n", twists, np.linalg.solve(covariance + own, twists[..., None])[..., 0])
        squared[k] = 0
        agreeing = np.flatnonzero(squared <= limit).tolist()
        if len(agreeing) > len(best):
            best = [k, *(other for other in agreeing if other != k)]
    return best


class Chain:
    """The keyframes of a run as a chain of odometry with its uncertainty.

    Args:
        poses: T_world_camera, float64 [K, 4, 4].
        settings: how much odometry drifts.
    """

    def __init__(self, poses: np.ndarray, settings: GraphSettings) -> None:
        tree = OdometryTree.root()
        for before, T in enumerate(poses[1:]):
            motion = inverse(poses[before]) @ T
            tree.add(before, motion, odometry_covariance(motion, SURE_INFORMATION, settings))
        self.poses = poses
        self._from_first = np.array(tree.poses)
        self._gathered = np.array(tree.covariances)

    def covariance(self, i: np.ndarray | int, j: np.ndarray | int) -> np.ndarray:
        """Covariance [..., 6, 6] of the motion from keyframe i to j, left twist in frame i."""
        first, last = np.minimum(i, j), np.maximum(i, j)
        return covariance_in_frame(self._gathered[last] - self._gathered[first], inverse(self._from_first[i]))
