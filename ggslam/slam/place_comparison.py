# SPDX-License-Identifier: Apache-2.0
"""Compares a frame with an old keyframe: its features, and its points with the surface measured there."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import replace

import numpy as np

from ggslam.features.registration import Matches, match
from ggslam.loops.places import Place, PlaceIndex
from ggslam.loops.settings import VerificationSettings
from ggslam.loops.uncertainty import information_in_frame
from ggslam.loops.verification import LocalMap, Verification, verify, verify_expected
from ggslam.native.loader import NativeContext
from ggslam.scene.camera import Camera
from ggslam.scene.poses import inverse, transform_points
from ggslam.tracking.gicp import AlignmentResult, align
from ggslam.tracking.points import FramePoints, PointSource
from ggslam.tracking.settings import DepthNoise
from ggslam.tracking.surface import MeasuredSurface
from ggslam.tracking.tracker import Tracker


class PlaceComparison:
    """Compares frames with the places of keyframes.

    Args:
        settings: what a comparison has to show.
        neighbourhood: keyframes before and after an old one whose points make its surface.
        surface: the keyframes' points.
        tracker: whose settings and noise G-ICP works with.
        context: threads.
    """

    def __init__(
        self, settings: VerificationSettings, neighbourhood: int, surface: MeasuredSurface, tracker: Tracker,
        context: NativeContext,
    ) -> None:  # fmt: skip
        self.settings = settings
        self._neighbourhood, self._surface = neighbourhood, surface
        self._tracker, self._context = tracker, context
        self._noise_then: DepthNoise | None = None

    def find(
        self, source: PointSource, place: Place, places: PlaceIndex, poses: Sequence[np.ndarray], old: int,
        camera: Camera,
    ) -> tuple[Verification, AlignmentResult | None]:  # fmt: skip
        """Whether a frame sees what keyframe `old` saw, from wherever, and the last alignment to the surface there.

        Args:
            source: points of the frame.
            place: what it is known by.
            places: of the keyframes.
            poses: T_world_camera of the keyframes.
            old: number of the keyframe.
            camera: that took the frame.
        """
        there = _There(self, source.read(), poses, old)
        found = verify(
            there.local_map(places), LocalMap(place.landmarks, there.points.points), camera, self.noise.sigma,
            there.align_at, self.settings,
        )  # fmt: skip
        return found, there.last

    def matches(self, place: Place, old: Place) -> Matches:
        """Features that two places share."""
        return match(old.landmarks, place.landmarks, self.settings.registration)

    def count_agreeing(self, matches: Matches, T_old_new: np.ndarray, camera: Camera, slack: float = 1.0) -> int:
        """How many of the matches a motion [4, 4] explains; `camera` took the new frame, `slack` widens the limits."""
        return int(matches.agree(T_old_new, camera, self.settings.registration, slack).sum())

    def confirm(
        self, source: PointSource, place: Place, places: PlaceIndex, poses: Sequence[np.ndarray], old: int,
        camera: Camera, matches: Matches, T_old_new: np.ndarray, min_witnesses: int,
    ) -> Verification:  # fmt: skip
        """As `find`, where the motion is expected to be about `T_old_new` [4, 4], and `matches` are known."""
        there = _There(self, source.read(), poses, old)
        return verify_expected(
            there.local_map(places), LocalMap(place.landmarks, there.points.points), matches, T_old_new, camera,
            self.noise.sigma, there.align_at, self.settings, min_witnesses,
        )  # fmt: skip

    @property
    def noise(self) -> DepthNoise:
        """Of the depth camera."""
        return self._noise_then or self._tracker.noise or DepthNoise()

    @contextmanager
    def noise_as(self, noise: DepthNoise | None) -> Iterator[None]:
        """Within, noise is as it was known when what is compared was located; None: as the tracker knows it."""
        self._noise_then = noise
        try:
            yield
        finally:
            self._noise_then = None

    def around(self, number: int, count: int) -> list[int]:
        """The keyframes of `count` whose points make the surface at one of them."""
        reach = self._neighbourhood
        return list(range(max(0, number - reach), min(count, number + reach + 1)))


class _There:
    """The surroundings of an old keyframe, gathered once something is aligned to them: most candidates are refused
    before."""

    def __init__(self, of: PlaceComparison, points: FramePoints, poses: Sequence[np.ndarray], old: int) -> None:
        self.points, self._of, self._old = points, of, old
        self.last: AlignmentResult | None = None
        self._around = of.around(old, len(poses))
        self._T_world_old = poses[old]
        self._T_old_world = inverse(poses[old])

    def local_map(self, places: PlaceIndex) -> LocalMap:
        surface = transform_points(self._of._surface.points(self._around), self._T_old_world)
        return LocalMap(places[self._old].landmarks, surface)

    def align_at(self, T_old_new: np.ndarray) -> AlignmentResult:
        of = self._of
        self.last = align(
            self.points, of._surface.of(self._around), self._T_world_old @ T_old_new, of._tracker.settings.align,
            of.noise, of._context,
        )  # fmt: skip
        information = information_in_frame(self.last.information, self._T_old_world)
        return replace(
            self.last, T_world_camera=self._T_old_world @ self.last.T_world_camera, information=information
        )
