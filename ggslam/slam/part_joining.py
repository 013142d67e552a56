# SPDX-License-Identifier: Apache-2.0
"""Finds places that parts of a run have in common, by comparing whole parts after the recording has ended.

While it was recorded, a keyframe was compared with older ones alone, and a loop was believed if the next keyframes
found the same. Here pairs from all over two parts may confirm one another, as where runs are merged.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from ggslam.loops.agreement import GroundLink, agreeing_links
from ggslam.loops.condensed import Link
from ggslam.loops.parts import KeyframeParts
from ggslam.loops.places import PlaceIndex
from ggslam.loops.settings import GraphSettings
from ggslam.loops.uncertainty import information_in_frame
from ggslam.scene.camera import Camera
from ggslam.scene.poses import inverse
from ggslam.slam.place_comparison import PlaceComparison
from ggslam.system.tuning import Tuning
from ggslam.tracking.points import disc_points
from ggslam.tracking.surface import MeasuredSurface


class JoinTuning(Tuning):
    """Search for places that parts of a run have in common."""

    max_queries = 200
    """Most keyframes of a part that are looked up, spread evenly over it."""


def find_links(
    parts: KeyframeParts, poses: Sequence[np.ndarray], places: PlaceIndex, surface: MeasuredSurface,
    comparison: PlaceComparison, camera: Camera, candidates: int,
) -> list[GroundLink]:  # fmt: skip
    """Pairs of keyframes of different parts that see the same surfaces. Those of the largest part are not looked up,
    but found.

    Args:
        parts: of the keyframes.
        poses: T_world_camera of the keyframes, [4, 4] each.
        places: of the keyframes.
        surface: of the keyframes.
        comparison: compares two of them.
        camera: of the keyframes.
        candidates: keyframes that are tried for one, the likeliest first.
    """
    largest = Counter(parts.of).most_common(1)[0][0]
    asked = [k for k, part in enumerate(parts.of) if part != largest]
    links = []
    for k in np.unique(
        np.linspace(0, len(asked) - 1, min(len(asked), JoinTuning.max_queries)).round().astype(int)
    ).tolist():
        new, own = asked[k], parts.members(asked[k])
        place = places.with_words(places[new])
        points = disc_points(*surface.points_and_normals(new), comparison.noise)
        for match in places.query(place, candidates, own.__contains__):
            found, _ = comparison.find(points, place, places, poses, match.number, camera)
            if found.accepted:
                inliers, overlap = found.inliers, found.overlap
                links.append(GroundLink(match.number, new, found.T_old_new, found.information, inliers, overlap))
                break
    return links


def links_between(
    links: Sequence[GroundLink], older: set[int], younger: set[int], poses: Sequence[np.ndarray],
    settings: GraphSettings,
) -> list[GroundLink]:  # fmt: skip
    """Those links that join two parts and agree on how these lie to each other, the one first that most agree with.

    Args:
        links: of all parts, whichever of a link's keyframes is the older one.
        older, younger: numbers of the keyframes of either part; `old` of the links returned is of the first.
        poses: T_world_camera of all keyframes, [4, 4] each.
        settings: how much tracking drifts within a part.
    """
    turned = [*links, *map(_turn, links)]
    ours = [link for link in turned if link.old in older and link.new in younger]
    numbers = [sorted(older), sorted(younger)]
    own = [np.array([poses[n] for n in part]) for part in numbers]
    local = [replace(link, old=numbers[0].index(link.old), new=numbers[1].index(link.new)) for link in ours]
    return [ours[k] for k in agreeing_links(local, own[0], own[1], settings)]


def closures_between_others(closure: Link, closures: Sequence[Link], parts: KeyframeParts) -> list[int]:
    """Numbers of the closures between parts that will not be one by this closure either: nothing but one another could
    contradict them."""
    own = {parts.of[closure.i], parts.of[closure.j]}
    ends = [(parts.of[other.i], parts.of[other.j]) for other in closures]
    return [k for k, (i, j) in enumerate(ends) if i != j and {i, j} != own]


def poses_brought_together(
    closure: Link, parts: KeyframeParts, poses: Sequence[np.ndarray]
) -> list[np.ndarray]:  # fmt: skip
    """All poses [4, 4], those of the younger of two parts where a closure has them: the optimisation starts near its
    end."""
    old, new, T_old_new = closure.i, closure.j, closure.T_i_j
    if parts.of[new] < parts.of[old]:
        old, new, T_old_new = new, old, inverse(T_old_new)
    T = poses[old] @ T_old_new @ inverse(poses[new])
    younger = parts.members(new)
    return [T @ pose if k in younger else pose for k, pose in enumerate(poses)]


def _turn(link: GroundLink) -> GroundLink:
    """The link as seen from its other end."""
    T_new_old = inverse(link.T_old_new)
    information = information_in_frame(link.information, T_new_old)
    return replace(link, old=link.new, new=link.old, T_old_new=T_new_old, information=information)
