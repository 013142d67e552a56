# SPDX-License-Identifier: Apache-2.0
"""What earlier views of a recording say of the latest one."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Protocol

import numpy as np

from ggslam.movers.settings import MoverSettings
from ggslam.native.loader import NativeContext
from ggslam.scene.camera import Camera
from ggslam.sight.margin import Margin
from ggslam.sight.places import CoarseView, compare


@dataclass(frozen=True)
class EvidenceRequest:
    """What is asked about a frame before its pose is known.

    Attributes:
        depth: float32 [H, W], metres, 0 where unknown.
        camera: of it.
        factor: how many times smaller the views are.
        earlier: views of the frames before, the newest last.
        ages: the frame is compared with those so many before it.
        margin: see there.
        settings: see there.
    """

    depth: np.ndarray
    camera: Camera
    factor: int
    earlier: list[CoarseView]
    ages: Sequence[int]
    margin: Margin
    settings: MoverSettings

    @property
    def fewest(self) -> int:
        """Novel places with which nothing is looked for."""
        return min(self.settings.min_pixels, 3)


@dataclass(frozen=True)
class Evidence:
    """What the earlier views say of each place, [h, w] each.

    Attributes:
        passed: int8, how many looked past it, at something farther...
        clearly: ...by twice the margin...
        surely: ...and both views saw something smooth.
        same: int8, how many saw a surface there.
        known: bool, whether one saw this, or nothing but others.
        stayed: whether a surface was there some frames ago...
        left: ...or, some time since, nothing but others.
    """

    passed: np.ndarray
    clearly: np.ndarray
    surely: np.ndarray
    same: np.ndarray
    known: np.ndarray
    stayed: np.ndarray
    left: np.ndarray


class EvidenceSource(Protocol):
    """Compares frames with those before."""

    def prepare(self, request: EvidenceRequest) -> None:
        """The frame that will be located next, in which nothing is expected to move."""

    def look(
        self, request: EvidenceRequest, T_world_camera: np.ndarray, moved: np.ndarray | None, context: NativeContext
    ) -> tuple[CoarseView, Evidence | None]:
        """A frame's view, and what the earlier ones say of it.

        Args:
            request: see there.
            T_world_camera: [4, 4], where the frame is.
            moved: bool [h, w], what moved in the frame before; None: nothing.
            context: that is computed in.

        Returns:
            No evidence if nothing moved before, and fewer than `request.fewest` places are novel.
        """


def ages_and_parts(request: EvidenceRequest) -> list[tuple[int, bool, bool]]:
    """The ages that there are views of, and whether each tells of `Evidence.left` and of `Evidence.stayed`."""
    rest = request.settings.rest_frames
    return [(age, age <= rest, age <= rest <= 2 * age) for age in request.ages if age <= len(request.earlier)]


class HostEvidence:
    """Compares frames by the compiled core."""

    def prepare(self, request: EvidenceRequest) -> None:
        """Nothing to do."""

    def look(
        self, request: EvidenceRequest, T_world_camera: np.ndarray, moved: np.ndarray | None, context: NativeContext
    ) -> tuple[CoarseView, Evidence | None]:
        """See `EvidenceSource`."""
        margin = request.margin
        view = CoarseView.of(request.depth, request.camera, request.factor, T_world_camera, margin, context)
        passed, clearly, surely, same = np.zeros((4, *view.depth.shape), np.int8)
        known, stayed, left = np.zeros((3, *view.depth.shape), bool)
        ages = ages_and_parts(request)
        found = compare(view, [request.earlier[-age] for age, _, _ in ages], margin, context, moved)
        for (_, tells_left, tells_stayed), evidence in zip(ages, found, strict=True):
            passed += evidence.passed
            clearly += evidence.clearly
            surely += evidence.surely
            same += evidence.same
            known |= evidence.same | evidence.otherwise
            if tells_left:
                left |= evidence.otherwise
            if tells_stayed:
                stayed |= evidence.same
        if moved is None and (passed + surely >= request.settings.min_passed).sum() < request.fewest:
            return view, None
        return view, Evidence(passed, clearly, surely, same, known, stayed, left)
