# SPDX-License-Identifier: Apache-2.0
"""Whether two parts of a run have places in common: whole part against whole part, when the recording has ended.

While it was recorded, a keyframe was compared with older ones alone, and a loop was believed if the next keyframes
found the same. Here pairs from all over the two parts may confirm one another, as where runs are merged.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from ggslam.loops.agreement import GroundLink, agreeing_links
from ggslam.loops.places import PlaceIndex
from ggslam.loops.settings import GraphSettings
from ggslam.scene.camera import Camera
from ggslam.slam.place_comparison import PlaceComparison
from ggslam.tracking.points import disc_points
from ggslam.tracking.surface import MeasuredSurface

QUERIES = 60
"""Keyframes of a part that are looked up in another one at most, spread evenly."""


def find_agreeing_links(
    older: Sequence[int], younger: Sequence[int], poses: Sequence[np.ndarray], places: PlaceIndex,
    surface: MeasuredSurface, comparison: PlaceComparison, camera: Camera, settings: GraphSettings, candidates: int,
) -> list[GroundLink]:  # fmt: skip
    """Pairs of keyframes of two parts that see the same surfaces and agree on how the parts lie to each other, the one
    first that most agree with.

    Args:
        older, younger: numbers of the keyframes of either part, rising.
        poses: T_world_camera of all keyframes, [4, 4] each.
        places: of all keyframes.
        surface: of all keyframes.
        comparison: compares two of them.
        camera: of all keyframes.
        settings: how much tracking drifts within a part.
        candidates: keyframes that are tried for one of the other part.
    """
    links = []
    for k in np.unique(np.linspace(0, len(younger) - 1, min(len(younger), QUERIES)).round().astype(int)).tolist():
        new = younger[k]
        place = places.with_words(places[new])
        points = disc_points(*surface.measured(new), comparison.noise)
        for match in places.query(place, candidates, lambda n: n not in older):
            found, _ = comparison.find(points, place, places, poses, match.number, camera)
            if found.accepted:
                at = older.index(match.number), k
                links.append(GroundLink(*at, found.T_old_new, found.information, found.inliers, found.overlap))
                break
    own = [np.array([poses[n] for n in numbers]) for numbers in (older, younger)]
    return [links[k] for k in agreeing_links(links, own[0], own[1], settings)]
