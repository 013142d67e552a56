# SPDX-License-Identifier: Apache-2.0
"""Holds an alignment to matched features where geometry is degenerate or misleading."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from scipy.spatial.transform import Rotation

from ggslam.system.tuning import Tuning
from ggslam.tracking.gicp import AlignmentResult
from ggslam.tracking.observability import PointSpread
from ggslam.tracking.points import PointSource
from ggslam.tracking.settings import DepthNoise
from ggslam.tracking.shared_features import SharedFeatures


class FeatureHoldTuning(Tuning):
    """When matched features overrule an alignment."""

    min_kept = 0.8
    """Smallest share of the features explained by the start that an alignment must explain, too."""


def hold_to_features(
    found: AlignmentResult, T_start: np.ndarray, shared: SharedFeatures, points: PointSource, noise: DepthNoise,
    enough_overlap: float,
) -> AlignmentResult:  # fmt: skip
    """An alignment that began at a pose which features vouch for, without what took it away from them: along the
    directions that geometry does not see, or altogether where that does not help. Its other numbers stay.

    Args:
        found: the alignment.
        T_start: [4, 4], where it began.
        shared: the features.
        points: that were aligned.
        noise: of the depth camera.
        enough_overlap: from which geometry is trusted where it sees all directions of motion.
    """
    if found.overlap >= enough_overlap and not found.degenerate:
        return found  # geometry is finer than features, which blur and a late shutter shift
    if shared.keeps(found.T_world_camera, T_start, FeatureHoldTuning.min_kept):
        return found
    if found.degenerate:
        T = follow_weakly(found, T_start, PointSpread.of(points.read(), noise))
        if shared.keeps(T, T_start, FeatureHoldTuning.min_kept):
            return replace(found, T_world_camera=T)
    return found if found.overlap >= enough_overlap else replace(found, T_world_camera=T_start.copy())


def follow_weakly(found: AlignmentResult, T_other: np.ndarray, spread: PointSpread) -> np.ndarray:
    """The pose [4, 4] of an alignment, moved to another along the directions of motion that geometry does not see.

    Args:
        found: the alignment.
        T_other: the other pose [4, 4], near by.
        spread: of the points that were aligned; `weak_directions` are about their centroid.
    """
    T = found.T_world_camera
    centroid = T[:3, :3] @ spread.centroid + T[:3, 3]
    moved = T_other[:3, :3] @ spread.centroid + T_other[:3, 3] - centroid
    radius = max(spread.radius, 1e-3)
    turned = Rotation.from_matrix(T_other[:3, :3] @ T[:3, :3].T).as_rotvec()
    motion = found.weak_directions.T @ (found.weak_directions @ np.concatenate([moved, radius * turned]))
    followed = np.eye(4)
    followed[:3, :3] = Rotation.from_rotvec(motion[3:] / radius).as_matrix() @ T[:3, :3]
    followed[:3, 3] = centroid + motion[:3] - followed[:3, :3] @ spread.centroid
    return followed
