# SPDX-License-Identifier: Apache-2.0
"""Counts how often an object could have been detected. One that a segmenter found seldom, although its place was nearly
always in view, is noise."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np

from ggslam.mapping.keyframe import FROM_EARLIER_RUN, Keyframe
from ggslam.sight.margin import Margin
from ggslam.sight.view import View

_MARGIN = Margin().times(2.5)
"""Wider than between two surfaces: the Gaussian in the middle of an object may lie inside it, behind its surface."""


def typical_points(means: np.ndarray, labels: np.ndarray) -> dict[int, np.ndarray]:
    """For each object the centre of the Gaussian in the middle of its own, float32 [3].

    Args:
        means: of all Gaussians, [N, 3].
        labels: their objects, [N]; 0 is none.
    """
    rows = np.flatnonzero(labels)
    rows = rows[np.argsort(labels[rows], kind="stable")]
    ids, starts = np.unique(labels[rows], return_index=True)
    found = {}
    for object_id, own in zip(ids.tolist(), np.split(rows, starts)[1:], strict=True):
        points = means[own]
        away = points - np.median(points, 0)
        found[object_id] = points[np.einsum("ij,ij->i", away, away).argmin()]
    return found


def count_chances(
    points: Mapping[int, np.ndarray], since: Mapping[int, int], keyframes: Sequence[Keyframe]
) -> dict[int, int]:
    """For each object the number of segmented keyframes of this recording that show its typical point.

    Args:
        points: typical points by id, world frame.
        since: first frame by id in which each object was found; what it is a part of may have been found before.
        keyframes: with masks or without.
    """
    seen = np.zeros(len(points), int)
    world = np.array(list(points.values()), float).reshape(-1, 3)
    begin = np.array([since.get(i, 0) for i in points], int)
    for keyframe in keyframes:
        if keyframe.mask is None or keyframe.frame_index == FROM_EARLIER_RUN or not len(world):
            continue
        view = View.of(keyframe.depth_m(), keyframe.camera, keyframe.T_world_camera, _MARGIN)
        seen += view.classify_points(world).same & (keyframe.frame_index >= begin)
    return dict(zip(points, seen.tolist(), strict=True))
