# SPDX-License-Identifier: Apache-2.0
"""Detects moving things frame by frame.

A place of a frame is evidence if several frames before it, or one without doubt, looked past it at something farther:
something has come there. Such places are gathered into whole things, by segments where there are any, else by what is
connected; what is seen once, or is too small, is noise.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field, replace
from typing import Annotated

import cv2
import numpy as np

from ggslam.geometry.moved_depth import shift_between
from ggslam.movers.evidence import EvidenceRequest, EvidenceSource, HostEvidence
from ggslam.movers.segments import Gathering, gather, grow_places
from ggslam.movers.settings import MoverSettings
from ggslam.movers.trail import Trail
from ggslam.native.loader import NativeContext
from ggslam.scene.camera import Camera
from ggslam.scene.frame import Frame
from ggslam.sight.margin import Margin
from ggslam.sight.places import CoarseView, thin_out
from ggslam.system.array_forms import Form, Mask
from ggslam.system.medians import median
from ggslam.system.savable import savable
from ggslam.system.tuning import Tuning


class DetectorTuning(Tuning):
    """Detection of movers."""

    ages = (1, 2, 4, 8, 16, 32, 48)
    """Each frame is compared with the frames this many before it."""
    mask_margin = 1
    """Margin of the masks of movers, in pixels of a 320 pixel wide image: outlines are blurred."""
    prediction_margin = 6
    """The same for the prediction of the next frame. Evidence from a single frame is predicted if the image shifts by
    at most twice this much."""
    min_rows = 8
    """Fewest rows and columns of the reduced images."""


@savable(not_saved="settings source _asked")
@dataclass
class MoverDetector:
    """Detects movers in located frames. It gets each frame once, in order.

    Attributes:
        settings: see there.
        mask: bool [H, W], what moves in the latest frame; None: nothing.
        views: coarse depth of the latest frames, the newest last.
        trail: where movers have been.
        segments: ids of the recording's segments that move in the latest frame.
        found: small mask of what moves, or may, in the latest frame...
        small: ...and of what does, as `mask`.
        things: int32 [H, W], number of the moving thing at each pixel, 0 without one, not grown; None: nothing.
        source: compares the frames.
        expected: bool [H, W], what the next frame is located without: all of `found` that will be about there.
    """

    settings: MoverSettings
    mask: Mask | None = None
    views: list[CoarseView] = field(default_factory=list)
    found: Annotated[np.ndarray, Form("?", None, None)] | None = None
    small: Annotated[np.ndarray, Form("?", None, None)] | None = None
    things: Annotated[np.ndarray, Form("i4", None, None)] | None = None
    expected: Mask | None = None
    segments: frozenset[int] = frozenset()
    trail: Trail = field(default_factory=Trail)
    source: EvidenceSource = field(default_factory=HostEvidence)
    _asked: EvidenceRequest | None = None
    """What the source was told to prepare of the frame at hand."""

    def expect(self, frame: Frame) -> Frame:
        """The frame to locate: without depth where something is expected to move."""
        if self.expected is None or self.expected.shape != frame.depth.shape:
            return frame
        return replace(frame, depth=np.where(self.expected, np.float32(0), frame.depth))

    def prepare(self, frame: Frame, margin: Margin) -> None:
        """A frame will be located next, and looked at with this margin as far as is known."""
        if self.found is None and self.expected is None:
            self._asked = self._request(frame, margin)
            self.source.prepare(self._asked)

    def look(
        self, frame: Frame, T_world_camera: np.ndarray | None, margin: Margin, context: NativeContext,
        sure: bool = True, swift: bool = False, load_mask: Callable[[], np.ndarray | None] | None = None,
    ) -> None:  # fmt: skip
        """Finds what moves in a frame: `mask`.

        Args:
            frame: as the camera saw it.
            T_world_camera: [4, 4], where it is; None: not known, which breaks the row of frames.
            margin: see there.
            context: that it is computed in.
            sure: whether the pose is; if it is not, nothing begins to move.
            swift: whether the camera moved so fast that shutters warp its images: nothing begins to move, and no later
                frame is held to this one.
            load_mask: gives the frame's masks, if not the frame itself is to read them.
        """
        self.mask = self.things = None
        if T_world_camera is None:
            self.views, self.found, self.small, self.expected, self.segments = [], None, None, None, frozenset()
            self._asked = None
            return
        s, request = self.settings, self._asked
        if request is None or request.depth is not frame.depth or request.margin is not margin:
            request = self._request(frame, margin)
        self._asked = None
        view, evidence = self.source.look(request, T_world_camera, self.small, context)
        earlier, self.views = self.views, [*self.views[-DetectorTuning.ages[-1] :], *([] if swift else [view])]
        before, moved, moving = self.found, self.small, self.segments
        self.segments = frozenset()
        self.found = self.small = self.expected = None
        if evidence is None:
            return
        passed, clearly, surely, same = evidence.passed, evidence.clearly, evidence.surely, evidence.same
        known, stayed, left, factor = evidence.known, evidence.stayed, evidence.left, request.factor
        novel = passed + surely >= s.min_passed
        if moved is not None:
            novel |= (passed > 0) & grow_places(moved)
        if novel.sum() < request.fewest and not moving:
            return
        rests, judged, shape = stayed & ~left, stayed | left, frame.depth.shape
        places = Gathering(novel, passed > 0, known, rests, judged, view.depth, same > passed, factor, shape)
        found = gather(places, load_mask or frame.load_mask, s, moving)
        most = known if moved is None else view.depth > 0  # what moves may hide most of what was seen before
        if found is None or found.small.sum() > s.max_share * most.sum():
            return
        found = found.keep_credible(novel, (clearly + surely >= s.min_passed) & (sure and not swift), moved)
        if found is None:
            return
        self.found = found.small
        seen_twice = None if before is None else found.pixels_near(before)
        if seen_twice is not None:
            self.mask = grow(seen_twice, DetectorTuning.mask_margin)
            self.things = np.where(seen_twice, found.full, 0)
            self.small = thin_out(seen_twice, factor)
            self.segments = found.segments_on(seen_twice)
            self.trail.add(view, self.small)
        likely = found.full > 0 if earlier and _stays_in_place(view, earlier[-1], found.small) else seen_twice
        self.expected = None if likely is None else grow(likely, DetectorTuning.prediction_margin)

    def _request(self, frame: Frame, margin: Margin) -> EvidenceRequest:
        factor, ages = coarse_factor(frame.camera, self.settings), DetectorTuning.ages
        return EvidenceRequest(frame.depth, frame.camera, factor, self.views, ages, margin, self.settings)

    def clean(self, frame: Frame) -> Frame:
        """The frame at hand without depth where something moves, which `Frame.moving` tells."""
        if self.mask is None:
            return frame
        return replace(frame, depth=np.where(self.mask, np.float32(0), frame.depth), moving=self.mask)

    def move(self, T_new_old: np.ndarray) -> None:
        """Follows a correction [4, 4] of the world about the camera."""
        self.views, self._asked = [view.move(T_new_old) for view in self.views], None


def _stays_in_place(view: CoarseView, before: CoarseView, places: np.ndarray) -> bool:
    """Whether what a view shows at some places, bool [h, w], hardly shifts in the image from one frame to the next."""
    seen = view.depth[places & (view.depth > 0)]
    if not len(seen):
        return False
    shift = shift_between(view.T_world_camera, before.T_world_camera, view.camera, median(seen))
    return shift * 320 <= 2 * DetectorTuning.prediction_margin * view.camera.width


def coarse_factor(camera: Camera, settings: MoverSettings) -> int:
    """How many times smaller the images are that are compared."""
    largest = min(camera.width, camera.height) // DetectorTuning.min_rows
    return max(1, min(round(camera.width / settings.columns), largest))


def grow(mask: np.ndarray, pixels: int) -> np.ndarray:
    """A mask bool [H, W] larger by some pixels of a 320 pixel wide image."""
    reach = max(1, round(pixels * mask.shape[1] / 320))
    return cv2.dilate(mask.astype(np.uint8), np.ones((2 * reach + 1, 2 * reach + 1), np.uint8)) > 0
