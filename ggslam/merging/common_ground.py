# SPDX-License-Identifier: Apache-2.0
"""Finds where two runs saw the same place: similar keyframes, verified by features, surfaces and voxels."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field, replace

import numpy as np

from ggslam.loops.agreement import GroundLink, agreeing_links
from ggslam.loops.uncertainty import information_in_frame
from ggslam.loops.verification import LocalMap, Verification, verify
from ggslam.merging.known_run import KnownRun
from ggslam.merging.settings import MergeSettings
from ggslam.native.loader import NativeContext
from ggslam.scene.poses import inverse, transform_points
from ggslam.tracking.gicp import AlignmentResult, GicpTarget, align


@dataclass
class CommonGround:
    """What was found between two runs.

    Attributes:
        links: that were verified, whether they agree or not.
        agreeing: numbers of those that agree on how the runs lie to each other, the one that most agree with first.
        refusal: the best pair of keyframes that was refused, in words; empty if none was compared.
        score: its features that agreed, and its share of common voxels.
        compared: pairs of keyframes that were.
    """

    links: list[GroundLink] = field(default_factory=list)
    agreeing: list[int] = field(default_factory=list)
    refusal: str = ""
    score: tuple[int, float] = (-1, -1.0)
    compared: int = 0

    def verdict(self, needed: int) -> str:
        """Why this is too little, with the best score that was found."""
        if self.links:
            return (
                f"{len(self.links)} pairs of keyframes were verified, but no more than {len(self.agreeing)} agree on "
                f"how the runs lie to each other, {needed} needed"
            )
        if not self.refusal:
            return "no keyframe of the one looks like one of the other"
        return f"of {self.compared} pairs of keyframes that look alike the best, {self.refusal}"


def find_common_ground(
    old: KnownRun, new: KnownRun, settings: MergeSettings, context: NativeContext,
    progress: Callable[[int, int], None] | None = None,
) -> CommonGround:  # fmt: skip
    """Looks keyframes of one run up in another one.

    Args:
        old, new: the runs; the new one's keyframes are looked up.
        settings: see there.
        context: threads.
        progress: is told how many of how many keyframes are done.
    """
    found, comparison = CommonGround(), _Comparison(old, new, settings, context)
    count = min(len(new), settings.queries)
    numbers = np.unique(np.linspace(0, len(new) - 1, count).round().astype(int)).tolist()
    for done, number in enumerate(numbers, start=1):
        place = old.places.with_words(new.places[number])
        for match in old.places.query(place, settings.candidates):
            verified = comparison.verify(match.number, number)
            found.compared += 1
            if verified.accepted:
                link = GroundLink(
                    match.number, number, verified.T_old_new, verified.information, verified.inliers, verified.overlap
                )
                found.links.append(link)
                break
            score = (verified.inliers, verified.overlap)
            if score > found.score:
                found.score = score
                found.refusal = f"{match.number} and {number}, was refused: {verified.reason}"
        if progress is not None:
            progress(done, len(numbers))
    found.agreeing = agreeing_links(found.links, old.poses, new.poses, settings.graph)
    return found


class _Comparison:
    """Compares keyframes of two runs."""

    def __init__(self, old: KnownRun, new: KnownRun, settings: MergeSettings, context: NativeContext) -> None:
        self._old, self._new, self._settings, self._context = old, new, settings, context
        noises = sorted((old.noise, new.noise), key=lambda noise: noise.sigma(2.0))
        self._noise = noises[-1]
        self._targets: dict[int, GicpTarget] = {}

    def verify(self, old: int, new: int) -> Verification:
        """Whether two keyframes see the same, and how they lie to each other."""
        run, points = self._old, self._new.frame_points(new)
        around = self._around(old)
        T_world_old = run.poses[old]
        T_old_world = inverse(T_world_old)

        def align_at(T_old_new: np.ndarray) -> AlignmentResult:
            if old not in self._targets:
                self._targets[old] = run.surface.of(around)
            guess, align_settings = T_world_old @ T_old_new, run.tracking.align
            found = align(points, self._targets[old], guess, align_settings, self._noise, self._context)
            information = information_in_frame(found.information, T_old_world)
            return replace(found, T_world_camera=T_old_world @ found.T_world_camera, information=information)

        surface = transform_points(run.surface.points(around), T_old_world)
        return verify(
            LocalMap(run.places[old].landmarks, surface), LocalMap(self._new.places[new].landmarks, points.points),
            self._new.cameras[new], self._noise.sigma, align_at, self._settings.verification,
        )  # fmt: skip

    def _around(self, number: int) -> list[int]:
        reach = self._settings.neighbourhood
        return list(range(max(0, number - reach), min(len(self._old), number + reach + 1)))
