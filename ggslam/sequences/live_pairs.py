# SPDX-License-Identifier: Apache-2.0
"""Pairs colour and depth that come one after the other by their times."""

from __future__ import annotations

from collections import Counter, deque
from dataclasses import dataclass
from typing import Final, Generic, Literal, TypeVar

from ggslam.sequences.association import PairingTuning
from ggslam.system.tuning import Tuning

T = TypeVar("T")
Kind = Literal["color", "depth"]
OTHER: Final[dict[Kind, Kind]] = {"color": "depth", "depth": "color"}


class LivePairTuning(Tuning):
    """How long an image waits for its partner."""

    most_waiting = 16
    """Images of one kind that wait for the other kind; the oldest makes room."""
    clock_back_s = 1.0
    """Seconds by which times go back from which the clock jumped; less is an image that came out of order."""
    gaps = 5
    """Steps from image to image that tell how soon the next one may be taken..."""
    sure = 0.8
    """...the shortest of them times this: nearer partners than a later image can be need not wait for it."""


@dataclass(frozen=True)
class Stamped(Generic[T]):
    """Something with the time at which it was taken, seconds."""

    stamp: float
    content: T


class _Waiting(Generic[T]):
    """Images of one kind that have no partner yet, in order of time."""

    def __init__(self) -> None:
        self.images: deque[Stamped[T]] = deque()
        self.last: float | None = None
        self._gaps: deque[float] = deque(maxlen=LivePairTuning.gaps)

    def add(self, image: Stamped[T]) -> None:
        if self.last is not None:
            self._gaps.append(image.stamp - self.last)
        self.last = image.stamp
        self.images.append(image)

    def next_not_before(self) -> float:
        """Time before which no further image is expected."""
        if self.last is None:
            return -float("inf")
        return self.last + LivePairTuning.sure * min(self._gaps) if self._gaps else float("inf")


class PairMatcher(Generic[T]):
    """Matches two streams by time: the closest pairs first, each image once, in order. What is within `tolerance_s` of
    no partner is counted.

    Attributes:
        tolerance_s: largest time between colour and depth, seconds.
        unmatched: images left out, by reason.
        closest_s: shortest time between two images that were not paired for it; inf: there were none.
        went_back_s: by how much time last went back; 0: never.
        jumps: how often it did.
    """

    def __init__(self, tolerance_s: float = PairingTuning.tolerance_s) -> None:
        self.tolerance_s = tolerance_s
        self.unmatched: Counter[str] = Counter()
        self.closest_s = float("inf")
        self.went_back_s, self.jumps = 0.0, 0
        self._waiting: dict[Kind, _Waiting[T]] = {"color": _Waiting(), "depth": _Waiting()}

    def add(self, kind: Kind, stamp: float, content: T) -> list[tuple[Stamped[T], Stamped[T]]]:
        """Takes an image; returns the pairs (colour, depth) that are settled by it, mostly one or none."""
        own = self._waiting[kind]
        if own.last is not None and stamp <= own.last:
            if own.last - stamp < LivePairTuning.clock_back_s:
                self.unmatched["came twice" if stamp == own.last else "came out of order"] += 1
                return []
            self._begin_anew(own.last - stamp)
            own = self._waiting[kind]
        own.add(Stamped(stamp, content))
        pairs = self._pairs()
        self._leave_out_old()
        return pairs

    def settle(self) -> list[tuple[Stamped[T], Stamped[T]]]:
        """The pairs among those that wait, where nothing more is expected soon."""
        return self._pairs(waits=False)

    def _pairs(self, waits: bool = True) -> list[tuple[Stamped[T], Stamped[T]]]:
        pairs = []
        while (pair := self._settled_pair(waits)) is not None:
            pairs.append(pair)
        return pairs

    def _begin_anew(self, back: float) -> None:
        for waiting in self._waiting.values():
            self.unmatched["the clock went back"] += len(waiting.images)
        self._waiting = {"color": _Waiting(), "depth": _Waiting()}
        self.went_back_s, self.jumps = back, self.jumps + 1

    def _settled_pair(self, waits: bool) -> tuple[Stamped[T], Stamped[T]] | None:
        """The closest pair, if no image that is still to come can be closer to one of the two, or nobody waits."""
        colors, depths = self._waiting["color"], self._waiting["depth"]
        gaps = [(abs(c.stamp - d.stamp), i, j) for i, c in enumerate(colors.images)
                for j, d in enumerate(depths.images)]  # fmt: skip
        if not gaps:
            return None
        gap, i, j = min(gaps)
        if gap > self.tolerance_s:
            self.closest_s = min(self.closest_s, gap)
            return None
        color, depth = colors.images[i], depths.images[j]
        if waits and min(colors.next_not_before() - depth.stamp, depths.next_not_before() - color.stamp) < gap:
            return None
        for waiting, count in ((colors, i), (depths, j)):
            self.unmatched["without a partner"] += count
            for _ in range(count + 1):
                waiting.images.popleft()
        return color, depth

    def _leave_out_old(self) -> None:
        """Images that no partner can come for any more."""
        for kind, waiting in self._waiting.items():
            last = self._waiting[OTHER[kind]].last
            images = waiting.images
            while images and last is not None and last > images[0].stamp + self.tolerance_s and not self._is_near(kind):
                images.popleft()
                self.unmatched["without a partner"] += 1
            while len(images) > LivePairTuning.most_waiting:
                images.popleft()
                self.unmatched[f"no {OTHER[kind]} came"] += 1

    def _is_near(self, kind: Kind) -> bool:
        """Whether the oldest image of a kind has a possible partner among those that wait."""
        first = self._waiting[kind].images[0].stamp
        return any(abs(image.stamp - first) <= self.tolerance_s for image in self._waiting[OTHER[kind]].images)
