# SPDX-License-Identifier: Apache-2.0
"""Whether the true poses of several recordings are in one world."""

from __future__ import annotations

from collections.abc import Sequence as ListOf

import numpy as np

from ggslam.evaluation.trajectory import FEWEST_POSES
from ggslam.scene.poses import inverse, separation, transform_points
from ggslam.system.tuning import Tuning


class SameTruthTuning(Tuning):
    """When the true poses of several recordings are in one world."""

    max_distance_m = 0.25
    """Largest mean distance between the true worlds in the common map, in metres; a drifting run is off by less."""
    max_rotation_deg = 6.0
    """Largest rotation between them, in degrees."""


def truth_transforms(estimated: ListOf[np.ndarray], truth: ListOf[np.ndarray | None]) -> list[np.ndarray | None]:
    """What brings the true poses of each recording into the world of the first recording's that has any: the identity
    where they are in it already; None where there are none.

    Args:
        estimated: T_world_camera of each run's frames in the common map, [n, 4, 4] with NaN.
        truth: the recording's own of the same frames; None: unknown.
    """
    found: list[np.ndarray | None] = []
    first: np.ndarray | None = None
    for ours, true in zip(estimated, truth, strict=True):
        T = None if true is None else _world_of_truth(ours, true)
        if T is None or true is None:
            found.append(None)
            continue
        first = T if first is None else first
        found.append(np.eye(4) if _is_one_world(first, T, true) else inverse(first) @ T)
    return found


def _world_of_truth(ours: np.ndarray, true: np.ndarray) -> np.ndarray | None:
    """T_map_truth [4, 4] by the frame that lies in the middle of what all frames say; None if too few are known."""
    known = np.isfinite(ours).all((1, 2)) & np.isfinite(true).all((1, 2))
    if known.sum() < FEWEST_POSES:
        return None
    each = ours[known] @ inverse(true[known])
    places = np.array([transform_points(true[known][:, :3, 3], T) for T in each[:: max(1, len(each) // 50)]])
    off = np.linalg.norm(places - np.median(places, axis=0), axis=2).mean(1)
    return each[:: max(1, len(each) // 50)][int(off.argmin())]


def _is_one_world(T_map_first: np.ndarray, T_map_this: np.ndarray, true: np.ndarray) -> bool:
    known = true[np.isfinite(true).all((1, 2))]
    apart = transform_points(known[:, :3, 3], T_map_first) - transform_points(known[:, :3, 3], T_map_this)
    turned = separation(T_map_first, T_map_this)[1]
    return bool(
        np.linalg.norm(apart, axis=1).mean() < SameTruthTuning.max_distance_m
        and turned < SameTruthTuning.max_rotation_deg
    )
