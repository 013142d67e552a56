# SPDX-License-Identifier: Apache-2.0
"""Finds outdated parts of the views of an earlier visit, by the depth of the current visit.

Each view of the newer visit that is surely located says of each place of an earlier one whether it looks through what
was there, or sees it again; and where it sees something that the earlier one looked through. One view may err: by its
pose, at outlines, where depth was guessed. Several from different poses have to agree, and far more of them than still
see what was there.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Annotated

import cv2
import numpy as np

from ggslam.movers.detector import DetectorTuning, grow
from ggslam.movers.segments import grow_places, large_parts
from ggslam.native.loader import NativeContext
from ggslam.scene.camera import Camera
from ggslam.scene.poses import inverse, transform_points
from ggslam.sight.margin import Margin
from ggslam.sight.places import CoarseView, PairEvidence, compare, thin_out
from ggslam.system.array_forms import Form, Mask
from ggslam.system.savable import savable
from ggslam.system.tuning import Tuning


class OutdatedTuning(Tuning):
    """Outdated parts of earlier views."""

    columns = 160
    """Approximate width, in pixels, of the images that are compared."""
    min_views = 3
    """Fewest views that look through a place..."""
    through_per_same = 2
    """...for each view that still sees it."""
    min_places = 6
    """Fewest connected places of a thing. Fewer are noise."""
    whole_share = 0.5
    """Share of a segment that must be judged, and share of that which must be gone, for all of it to be gone."""
    hidden_share = 0.25
    """Share of the newer views that must see something in front of a place. Wrong outlines reach less."""


_AROUND = np.ones((3, 3), np.uint8)


@dataclass(frozen=True)
class OutdatedParts:
    """Parts of an earlier view's image that say nothing of how things are now, bool [H, W] each. Where nothing was
    told that was not known, they are empty.

    Attributes:
        gone: what was there was looked through...
        around: ...the same with its outlines, where nobody surely looks through...
        hidden: ...and where something stands now in front of what was there, with its outlines.
    """

    gone: np.ndarray
    around: np.ndarray
    hidden: np.ndarray


@savable()
@dataclass
class EarlierView:
    """An earlier keyframe's depth, and what newer views say of its places.

    Attributes:
        view: its depth as it was measured; where it is tells `at`.
        through, same, before: int16 [h, w], newer views that looked through a place, that saw it again, and that saw
            something which this view looks through.
        gone, hidden: bool [h, w], places that were told to be so.
        looks: newer views that were held against it.
        fresh: whether something was said since `find_outdated`.
    """

    view: CoarseView
    through: Annotated[np.ndarray, Form("i2", "h", "w")]
    same: Annotated[np.ndarray, Form("i2", "h", "w")]
    before: Annotated[np.ndarray, Form("i2", "h", "w")]
    gone: Mask
    hidden: Mask
    looks: int = 0
    fresh: bool = False

    @staticmethod
    def of(view: CoarseView) -> EarlierView:
        """Of which nothing was said yet."""
        counts, flags = np.zeros((3, *view.depth.shape), np.int16), np.zeros((2, *view.depth.shape), bool)
        return EarlierView(view, *(array.copy() for array in (*counts, *flags)))

    def at(self, T_world_camera: np.ndarray) -> CoarseView:
        """The view from where its keyframe is now, [4, 4]."""
        return replace(self.view, T_world_camera=np.array(T_world_camera, float))

    def forget(self) -> None:
        """What was said counts no more: keyframes have moved against each other. What is gone stays so."""
        for counts in (self.through, self.same, self.before):
            counts[:] = 0
        self.looks, self.fresh = 0, False

    def count(self, placed: CoarseView, evidence: PairEvidence, newest: CoarseView, come: np.ndarray) -> None:
        """A newer view's evidence counts.

        Args:
            placed: this view where it is.
            evidence: of its places, by `newest`.
            newest: the newer view.
            come: places of that one, bool [h', w'], which this view looks past.
        """
        self.looks += 1
        self.through += evidence.passed
        self.same += evidence.same
        if come.any():
            self.before += _places_before(placed, newest, come)
        self.fresh |= bool(evidence.passed.any() or come.any())

    def find_outdated(self, segments: np.ndarray | None, shape: tuple[int, int]) -> OutdatedParts | None:
        """What is outdated of the view and was not known to be; None: nothing.

        Args:
            segments: ids uint16 [H, W] of its keyframe, 0 = none, or None.
            shape: of its keyframe's images, (H, W).
        """
        self.fresh, factor = False, shape[1] // self.view.camera.width
        tuning = OutdatedTuning
        through = (self.through >= tuning.min_views) & (self.through >= tuning.through_per_same * self.same)
        gone = large_parts(through, tuning.min_places)
        before = self.before >= max(tuning.min_views, tuning.hidden_share * self.looks)
        hidden = large_parts(before, tuning.min_places)
        full = _enlarge(gone, factor, shape)
        if segments is not None and gone.any():
            small = thin_out(segments, factor)
            ids = _segments_gone(gone, self.through + self.same >= OutdatedTuning.min_views, small, self.view.depth > 0)
            gone, full = gone | np.isin(small, ids), full | np.isin(segments, ids)
        # What is next to what was told before is its outline, and was left out with it.
        new_gone, new_hidden = (
            large_parts(now & ~grow_places(known), OutdatedTuning.min_places).any()
            for now, known in ((gone, self.gone), (hidden, self.hidden))
        )
        if not new_gone and not new_hidden:
            return None
        self.gone |= gone
        self.hidden |= hidden
        if not new_gone:
            full = np.zeros(shape, bool)
        around, before = (_with_outlines(mask, factor) for mask in (full, _enlarge(hidden, factor, shape)))
        return OutdatedParts(full, around, before)


def coarse_factor(camera: Camera) -> int:
    """How many times smaller the images are that are compared."""
    return max(1, round(camera.width / OutdatedTuning.columns))


def compare_both_ways(
    earlier: list[CoarseView], newest: CoarseView, margin: Margin, context: NativeContext
) -> tuple[list[PairEvidence], list[np.ndarray]]:
    """What the newest view says of the places of earlier ones; and where each of them looked past something that it
    sees, bool [h, w] in the newest view. Arguments as of `compare`."""
    of_earlier = [compare(view, [newest], margin, context)[0] for view in earlier]
    come = (
        [large_parts(e.passed, OutdatedTuning.min_places) for e in compare(newest, earlier, margin, context)]
        if earlier
        else []
    )
    return of_earlier, come


def _places_before(view: CoarseView, newest: CoarseView, come: np.ndarray) -> np.ndarray:
    """Places of a view, bool [h, w], in front of which the newest view sees what `come` marks there."""
    points = transform_points(newest.camera.back_project(newest.depth)[come].astype(float), newest.T_world_camera)
    rows, columns, inside = view.camera.project(transform_points(points, inverse(view.T_world_camera)))
    marked = np.zeros(view.depth.shape, np.uint8)
    marked[rows[inside], columns[inside]] = 1
    return cv2.morphologyEx(marked, cv2.MORPH_CLOSE, _AROUND) > 0  # points of the one leave gaps in the other


def _segments_gone(gone: np.ndarray, judged: np.ndarray, small: np.ndarray, known: np.ndarray) -> np.ndarray:
    """Ids of segments that are gone for the most part.

    Args:
        gone, judged: places, bool [h, w].
        small: id of the segment at each place, 0 = none.
        known: places that have depth, bool [h, w].
    """
    count = int(small.max()) + 1
    lost, told, whole = (np.bincount(small[places], minlength=count) for places in (gone, judged, known))
    ids = np.flatnonzero(
        (lost >= OutdatedTuning.min_places)
        & (lost > OutdatedTuning.whole_share * told)
        & (told > OutdatedTuning.whole_share * whole)
    )
    return ids[ids > 0]


def _with_outlines(mask: np.ndarray, factor: int) -> np.ndarray:
    """A mask bool [H, W] larger by a place and a little more all around: evidence comes of whole 3x3 places alone."""
    return grow(
        cv2.dilate(mask.astype(np.uint8), np.ones((2 * factor + 1, 2 * factor + 1), np.uint8)) > 0,
        DetectorTuning.mask_margin,
    )


def _enlarge(places: np.ndarray, factor: int, shape: tuple[int, int]) -> np.ndarray:
    """Places bool [h, w] as pixels bool [H, W]."""
    full, (h, w) = np.zeros(shape, bool), places.shape
    full[: h * factor, : w * factor] = places.repeat(factor, 0).repeat(factor, 1)
    return full
