# SPDX-License-Identifier: Apache-2.0
"""Groups places with evidence of motion into whole things."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field

import cv2
import numpy as np

from ggslam.geometry.image_parts import parts_with_seeds
from ggslam.movers.settings import MoverSettings
from ggslam.sight.places import thin_out
from ggslam.system.tuning import Tuning


class SegmentTuning(Tuning):
    """Segments of moving things."""

    same_depth = 0.03
    """Largest relative difference in depth of neighbouring places of one thing."""
    min_clear = 0.5
    """Smallest share of clear evidence where a thing starts to move: a wrong pose can explain the rest."""
    min_judged = 0.25
    """Smallest share of a thing's places seen by earlier frames for it to be at rest."""
    max_rest = 0.5
    """Largest share at rest, of the judged places of a segment, that still moves as in the frame before."""
    max_growth = 2
    """Most places by which a thing grows beyond its evidence."""


_AROUND = np.ones((3, 3), np.uint8)


@dataclass(frozen=True)
class Gathering:
    """What is known about each place of a small image, bool [h, w] unless stated otherwise.

    Attributes:
        novel: something has come there.
        perhaps: the same by less evidence, where it hangs on places that are `novel`.
        known: earlier frames looked there.
        rests: it is where all the latest frames saw it that looked there...
        judged: ...of places at which enough of them did.
        depth: float32, metres.
        world: frames before saw the same there.
        factor: how many times the image is smaller.
        shape: of the whole image, (H, W).
    """

    novel: np.ndarray
    perhaps: np.ndarray
    known: np.ndarray
    rests: np.ndarray
    judged: np.ndarray
    depth: np.ndarray
    world: np.ndarray
    factor: int
    shape: tuple[int, int]


@dataclass(frozen=True)
class MovingThings:
    """Things that move in a frame.

    Attributes:
        small: bool [h, w], the places of all of them.
        parts: int32 [h, w], number of the thing at each place, 0 without one.
        full: int32 [H, W], the same for each pixel.
        segments: id of the segment that a thing is, by the thing's number.
    """

    small: np.ndarray
    parts: np.ndarray
    full: np.ndarray
    segments: dict[int, int] = field(default_factory=dict)

    def segments_on(self, mask: np.ndarray) -> frozenset[int]:
        """Ids of the segments that have pixels on a mask bool [H, W]."""
        numbers = np.unique(self.full[mask])
        return frozenset(self.segments[int(n)] for n in numbers if int(n) in self.segments)

    def keep_credible(self, novel: np.ndarray, clear: np.ndarray, before: np.ndarray | None) -> MovingThings | None:
        """Those whose places bool [h, w] of evidence are clear to more than a half, and those that meet what moved in
        the frame before; None without any."""
        numbers = []
        for number in np.unique(self.parts[self.small]):
            own = self.parts == number
            known = before is not None and bool((own & grow_places(before)).any())
            if known or (own & clear).sum() > SegmentTuning.min_clear * (own & novel).sum():
                numbers.append(number)
        if not numbers:
            return None
        small, pixels = np.isin(self.parts, numbers), np.isin(self.full, numbers)
        return MovingThings(small, np.where(small, self.parts, 0), np.where(pixels, self.full, 0), self.segments)

    def pixels_near(self, before: np.ndarray) -> np.ndarray | None:
        """Pixels, bool [H, W], of those that meet places bool [h, w] of the frame before; None without any."""
        numbers = np.unique(self.parts[grow_places(before)])
        numbers = numbers[numbers > 0]
        return np.isin(self.full, numbers) if len(numbers) else None


def gather(
    places: Gathering, load_segments: Callable[[], np.ndarray | None], settings: MoverSettings,
    moved: frozenset[int] = frozenset(),
) -> MovingThings | None:  # fmt: skip
    """The things that move, None without any.

    Args:
        places: see there.
        load_segments: gives ids uint16 [H, W] of the frame's segments, 0 = none, or None. Asked only where something
            may move.
        settings: how much of a thing has to have come.
        moved: ids of the segments that moved in the frame before.
    """
    blobs = parts_with_seeds(large_parts(places.novel, settings.min_pixels), places.novel | places.perhaps, 0)
    segments = load_segments()
    if segments is None:
        return _as_things(_blobs_that_move(blobs, places, settings), places, None, {})
    small = thin_out(segments, places.factor)
    moving = {number: k for k, number in enumerate(_segments_that_move(small, places, settings, moved), start=1)}
    of_segments = np.isin(small, list(moving)) & (small > 0)
    left = large_parts(blobs & ~grow_places(of_segments) & (small == 0), settings.min_pixels)
    return _as_things(_blobs_that_move(left, places, settings), places, segments, moving)


def _segments_that_move(
    small: np.ndarray, places: Gathering, s: MoverSettings, moved: frozenset[int]
) -> list[int]:
    """Ids of segments of which enough has come and that do not rest."""
    counted = (places.known, places.novel, places.rests, places.judged)
    count, novel, rest, judged = (np.bincount(small[mask], minlength=int(small.max()) + 1) for mask in counted)
    found = []
    candidates = sorted({*np.flatnonzero(novel).tolist(), *(n for n in moved if n < len(count) and count[n])} - {0})
    for number in candidates:
        enough = max(s.min_pixels / 4, s.min_share * count[number])
        has_come = novel[number] >= enough and not _at_rest(rest[number], judged[number], count[number], s)
        if has_come or (number in moved and rest[number] <= SegmentTuning.max_rest * judged[number]):
            found.append(number)
    return found


def _blobs_that_move(blobs: np.ndarray, places: Gathering, s: MoverSettings) -> np.ndarray:
    """Numbers int32 [h, w] of connected places that do not rest, each with what is connected to it."""
    count, labels = cv2.connectedComponents(blobs.astype(np.uint8), connectivity=8)
    for number in range(1, count):
        own = labels == number
        if _at_rest(places.rests[own].sum(), places.judged[own].sum(), own.sum(), s):
            labels[own] = 0
    for _ in range(SegmentTuning.max_growth):
        labels = _spread(labels, places)
    return labels


def _at_rest(rest: int, judged: int, count: int, s: MoverSettings) -> bool:
    """Whether a thing of so many places stays where it is."""
    return judged >= SegmentTuning.min_judged * count and rest >= s.at_rest * judged


def _spread(labels: np.ndarray, places: Gathering) -> np.ndarray:
    """Things take in neighbouring places of like depth that are not known to be of the world."""
    depth, grown = places.depth, labels.copy()
    for step in ((0, 1), (0, -1), (1, 0), (-1, 0)):
        beside, z = np.roll(labels, step, (0, 1)), np.roll(depth, step, (0, 1))
        joins = (grown == 0) & (beside > 0) & ~places.world & (np.abs(z - depth) < SegmentTuning.same_depth * depth)
        grown[joins] = beside[joins]
    return grown


def grow_places(mask: np.ndarray) -> np.ndarray:
    """A mask bool [h, w] and its neighbours."""
    return cv2.dilate(mask.astype(np.uint8), _AROUND) > 0


def large_parts(mask: np.ndarray, least: int) -> np.ndarray:
    """The connected parts of a mask bool [h, w] that have at least so many places."""
    count, labels = cv2.connectedComponents(mask.astype(np.uint8), connectivity=8)
    sizes = np.bincount(labels.reshape(-1), minlength=count)
    sizes[0] = 0
    return (sizes >= least)[labels]


def _as_things(
    labels: np.ndarray, places: Gathering, segments: np.ndarray | None, moving: dict[int, int]
) -> MovingThings | None:
    """Connected places and segments with their numbers, as things."""
    if not moving and not labels.any():
        return None
    (h, w), factor, first = labels.shape, places.factor, int(labels.max())
    parts, full = labels.astype(np.int32), np.zeros(places.shape, np.int32)
    large = cv2.resize(labels.astype(np.uint16), (w * factor, h * factor), interpolation=cv2.INTER_NEAREST)
    full[: h * factor, : w * factor] = large
    if segments is not None:
        small = thin_out(segments, factor)
        for number, k in moving.items():
            full[segments == number] = first + k
            parts[small == number] = first + k
    return MovingThings(parts > 0, parts, full, {first + k: number for number, k in moving.items()})
