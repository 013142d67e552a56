# SPDX-License-Identifier: Apache-2.0
"""Evidence over keyframes on which objects are one."""

from __future__ import annotations

from collections.abc import Collection
from dataclasses import dataclass, field

import numpy as np

from ggslam.objects.overlap import SegmentOverlap
from ggslam.objects.settings import AssociationSettings
from ggslam.system.array_forms import ObjectId
from ggslam.system.savable import savable
from ggslam.system.tuning import Tuning


class EvidenceTuning(Tuning):
    """What a keyframe says of two objects."""

    min_weight = 0.05
    """Smallest weight of an object that is seen."""
    full_share = 0.5
    """Share of an object's largest view from which a view counts fully."""


@savable()
@dataclass
class _Pair:
    """What is known of two objects.

    Attributes:
        together, apart: weight of what says that they lie in one segment, or in two.
        keyframes: numbers of those in which they lay in one. Each counts once: a segment across many pieces of a wall
            says no more than that it is one segment, however many of them become one meanwhile.
    """

    together: float = 0.0
    apart: float = 0.0
    keyframes: set[int] = field(default_factory=set)


@savable()
class PairEvidence:
    """How often two objects lay together in one segment, and how often in segments of their own.

    An observation weighs as much as the objects are visible compared with the largest view of them so far: from afar,
    or by a sliver at the border of the image, much looks like one.
    """

    _pairs: dict[tuple[ObjectId, ObjectId], _Pair]
    _largest: dict[ObjectId, int]

    def __init__(self, settings: AssociationSettings) -> None:
        self._settings = settings
        self._pairs = {}
        self._largest = {}
        self._keyframe = 0

    def observe(self, overlap: SegmentOverlap, neighbours: Collection[tuple[int, int]]) -> None:
        """Takes a keyframe into account.

        Args:
            overlap: of its segments with the objects.
            neighbours: pairs of ids (smaller first) that touch each other in the map's view. Other pairs are noted
                only once they have been seen together.
        """
        self._keyframe += 1
        if not overlap.shared.size:
            return
        visible = overlap.shared.sum(0)
        weight = self._weights(overlap.objects, visible, overlap.row.size)
        covers = overlap.covers
        home = covers.argmax(0)
        whole = (covers.max(0) >= self._settings.whole) & (weight >= EvidenceTuning.min_weight)
        found = {int(overlap.objects[k]): (int(home[k]), float(weight[k])) for k in np.flatnonzero(whole)}
        for segment in np.unique(home[whole]):
            inside = overlap.objects[whole & (home == segment)].tolist()
            for k, a in enumerate(inside):
                for b in inside[k + 1 :]:
                    pair = self._pairs.setdefault((a, b), _Pair())
                    pair.together += min(found[a][1], found[b][1])
                    pair.keyframes.add(self._keyframe)
        for key in neighbours:
            self._pairs.setdefault(key, _Pair())
        for (a, b), pair in self._pairs.items():
            if a in found and b in found and found[a][0] != found[b][0]:
                pair.apart += min(found[a][1], found[b][1])

    def _weights(self, ids: np.ndarray, visible: np.ndarray, pixels: int) -> np.ndarray:
        for i, n in zip(ids.tolist(), visible.tolist(), strict=True):
            self._largest[i] = max(self._largest.get(i, 0), n)
        largest = np.array([self._largest[i] for i in ids.tolist()], float)
        weight = np.minimum(1.0, visible / np.maximum(EvidenceTuning.full_share * largest, 1))
        return np.where(visible >= self._settings.min_visible * pixels, weight, 0.0)

    def take_over(self, whole: int, part: int, together: int, apart: int) -> None:
        """A part has become an object: in so many keyframes it lay in one segment with the rest, and in so many not."""
        pair = self._pairs.setdefault((min(whole, part), max(whole, part)), _Pair())
        pair.together += together
        pair.apart += apart

    def merges(self) -> list[tuple[int, int]]:
        """Pairs (kept, dropped) that the evidence makes one; the larger object keeps its id. They are merged here."""
        done: list[tuple[int, int]] = []
        while True:
            ripe = [key for key, pair in self._pairs.items() if self._is_one(pair)]
            if not ripe:
                return done
            a, b = max(ripe, key=lambda key: (self._pairs[key].together - self._pairs[key].apart, key))
            kept, dropped = (a, b) if self._largest.get(a, 0) >= self._largest.get(b, 0) else (b, a)
            self.join(kept, dropped)
            done.append((kept, dropped))

    def forget(self, object_ids: Collection[int]) -> None:
        """These objects are no more."""
        for i in object_ids:
            self._largest.pop(i, None)
        for key in [key for key in self._pairs if key[0] in object_ids or key[1] in object_ids]:
            del self._pairs[key]

    def _is_one(self, pair: _Pair) -> bool:
        enough = len(pair.keyframes) >= self._settings.merge_observations
        return enough and pair.together > self._settings.merge_ratio * pair.apart

    def join(self, kept: int, dropped: int) -> None:
        """What is known of one object is known of another one from now on."""
        self._largest[kept] = self._largest.get(kept, 0) + self._largest.pop(dropped, 0)
        for key in [key for key in self._pairs if dropped in key]:
            pair = self._pairs.pop(key)
            other = key[0] if key[1] == dropped else key[1]
            if other == kept:
                continue
            into = self._pairs.setdefault((min(kept, other), max(kept, other)), _Pair())
            into.together += pair.together
            into.apart += pair.apart
            into.keyframes |= pair.keyframes
