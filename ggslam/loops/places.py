# SPDX-License-Identifier: Apache-2.0
"""Finds old keyframes that may show the same place. Needs no vocabulary file and no training.

Words are bits sampled from ORB descriptors (locality-sensitive hashing: P. Indyk, R. Motwani, STOC 1998): descriptors
alike share most of their bits and so some of their words. An inverted list per word (J. Sivic, A. Zisserman, ICCV
2003) names the keyframes it was seen in; rare words count more. The keyframes with the best scores are then compared
by randomised ferns on a thumbnail of colour and depth (B. Glocker et al., TVCG 2015), which prefers like viewpoints:
they are the ones that can be verified.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from typing import Annotated

import cv2
import numpy as np

from ggslam.errors import FormatError
from ggslam.features.orb import FeatureView, Landmarks
from ggslam.loops.settings import PlaceSettings
from ggslam.loops.word_lists import WordLists
from ggslam.scene.camera import Camera
from ggslam.system.array_forms import Form, check_arrays
from ggslam.system.savable import savable
from ggslam.system.tuning import Tuning


class FernTuning(Tuning):
    """Random tests of places. Places of stored maps are comparable only under the same values."""

    seed = 0
    """Seed of the random tests."""
    thumbnail = (40, 30)
    """Width and height, in pixels, of the images that the tests read."""


@savable()
@dataclass(frozen=True)
class Place:
    """The description of a view.

    Attributes:
        landmarks: its features with depth.
        words: int64 [w], sorted; empty in the index, which has them in its lists.
        codes: uint8 [ferns].
    """

    landmarks: Landmarks
    words: Annotated[np.ndarray, Form("i8", None)]
    codes: Annotated[np.ndarray, Form("u1", None)]


@dataclass(frozen=True)
class PlaceMatch:
    """A keyframe that may see the same place; scores above 0, comparable within one query."""

    number: int
    score: float


@savable(
    not_saved="camera settings _bits _fern_pixels _fern_colors _fern_depths _lists", growing="_places",
    after="list_again", check="check",
)  # fmt: skip
class PlaceIndex:
    """An index of keyframes by appearance.

    Args:
        camera: of all views.
        settings: see `PlaceSettings`.
    """

    _numbers: list[int]
    _positions: dict[int, int]
    _places: list[Place]
    _codes: Annotated[np.ndarray, Form("u1", "places", None)]
    _sizes: Annotated[np.ndarray, Form("f8", "places", finite=True)]

    def __init__(self, camera: Camera, settings: PlaceSettings | None = None) -> None:
        self.camera = camera
        self.settings = s = settings or PlaceSettings()
        # RandomState's numbers are the same in every version of numpy: saved codes stay comparable.
        random = np.random.RandomState(FernTuning.seed)
        self._bits = np.stack([random.permutation(256)[: s.bits] for _ in range(s.tables)])
        self._fern_pixels = random.randint(0, FernTuning.thumbnail[0] * FernTuning.thumbnail[1], s.ferns)
        self._fern_colors = random.randint(30, 226, (s.ferns, 3))
        self._fern_depths = random.uniform(s.near, s.far, s.ferns)
        self._numbers = []
        self._positions = {}
        self._places = []
        self._codes, self._sizes = np.zeros((16, s.ferns), np.uint8), np.zeros(16)
        self._lists = WordLists(s.tables << s.bits)

    def __len__(self) -> int:
        return len(self._numbers)

    @property
    def held_bytes(self) -> int:
        """Memory that the places take, about."""
        marks = sum(place.landmarks.descriptors.nbytes + place.landmarks.points.nbytes for place in self._places)
        return marks + self._lists.held_bytes + self._codes.nbytes

    def check(self) -> None:
        """Raises FormatError if places and their numbers do not fit together: it may come from a file."""
        count, ferns = len(self._numbers), self.settings.ferns
        sized = len(self._places) == count <= len(self._codes) and self._codes.shape[1] == ferns
        if not sized or self._positions != {number: position for position, number in enumerate(self._numbers)}:
            raise FormatError("places do not match their keyframes")
        if any(len(place.codes) != ferns or len(place.words) for place in self._places):
            raise FormatError("places: their features are of another kind")

    def __contains__(self, number: int) -> bool:
        return number in self._positions

    def __getitem__(self, number: int) -> Place:
        return self._places[self._positions[number]]

    def with_words(self, place: Place) -> Place:
        """A place of this index or another one with the words that it is looked up by here."""
        return replace(place, words=self._words(place.landmarks.descriptors))

    def describe(self, view: FeatureView, camera: Camera | None = None) -> Place:
        """What a view is known by; for `add`, `query`, or both. `camera` took it, if not the one of all views."""
        landmarks = view.landmarks(camera or self.camera, self.settings.features)
        return Place(landmarks, self._words(landmarks.descriptors), self._fern_codes(view))

    def empty_place(self) -> Place:
        """What a view without a feature is known by: no query finds it."""
        nothing = Landmarks(np.zeros((0, 32), np.uint8), np.zeros((0, 3), np.float32))
        return Place(nothing, np.zeros(0, np.int64), np.zeros(self.settings.ferns, np.uint8))

    def add(self, number: int, place: Place) -> None:
        """Keyframe `number` sees `place`. Numbers next to each other are next in time.

        Raises:
            ValueError: the number is there already.
        """
        if number in self._positions:
            raise ValueError(f"keyframe {number} is in the index already")
        position = self._positions[number] = len(self._numbers)
        self._numbers.append(number)
        self._places.append(replace(place, words=place.words[:0].copy()))  # only a query needs them
        if position == len(self._codes):
            self._codes = np.concatenate([self._codes, np.zeros_like(self._codes)])
            self._sizes = np.concatenate([self._sizes, np.zeros_like(self._sizes)])
        self._codes[position], self._sizes[position] = place.codes, len(place.words)
        self._lists.add(place.words, position)

    def query(
        self, place: Place, count: int, excluded: Callable[[int], bool] = lambda number: False
    ) -> list[PlaceMatch]:
        """The keyframes that look most like a place, best first.

        Args:
            count: of keyframes at most; those without a common word are never among them.
            excluded: says of a keyframe's number that it is not wanted: it does not support others either.
        """
        scores = self._word_scores(place)
        best = np.argsort(-scores, kind="stable")
        chosen: list[int] = []
        for position in best.tolist():
            if scores[position] <= 0 or len(chosen) == self.settings.shortlist:
                break
            if not excluded(self._numbers[position]):
                chosen.append(position)
        alike = (self._codes[chosen] == place.codes).mean(1) if chosen else np.zeros(0)
        found = {self._numbers[k]: float(scores[k] * a) for k, a in zip(chosen, alike, strict=True)}
        supported = [PlaceMatch(n, s + self.settings.support * self._neighbour(n, s, found)) for n, s in found.items()]
        return sorted(supported, key=lambda m: (-m.score, m.number))[:count]

    def to_arrays(self) -> dict[str, np.ndarray]:
        """All that it takes to find a view again in another run: see `from_arrays`."""
        landmarks = [place.landmarks for place in self._places]
        return {
            "numbers": np.array(self._numbers, np.int32),
            "counts": np.array([len(marks) for marks in landmarks], np.int32),
            "descriptors": np.concatenate([marks.descriptors for marks in landmarks] or [np.zeros((0, 32), np.uint8)]),
            "points": np.concatenate([marks.points for marks in landmarks] or [np.zeros((0, 3), np.float32)]),
            "codes": self._codes[: len(self)].copy(),
        }

    @classmethod
    def from_arrays(
        cls, camera: Camera, arrays: Mapping[str, np.ndarray], settings: PlaceSettings | None = None
    ) -> PlaceIndex:
        """The index that `to_arrays` came from, with the same settings.

        Args:
            arrays: numbers int32 [n], counts int32 [n], codes uint8 [n, ferns]; of all landmarks, keyframe after
                keyframe, descriptors uint8 [sum of counts, 32] and points float32 [sum of counts, 3].

        Raises:
            FormatError: an array is missing or they do not fit each other or the settings.
        """
        index = cls(camera, settings)
        _check_arrays(arrays, index.settings.ferns)
        starts = np.cumsum(arrays["counts"])[:-1]
        descriptors, points = (np.split(arrays[name], starts) for name in ("descriptors", "points"))
        rows = zip(arrays["numbers"].tolist(), descriptors, points, arrays["codes"], strict=False)
        for number, of_descriptors, of_points, codes in rows:
            landmarks = Landmarks(of_descriptors.copy(), of_points.copy())
            index.add(number, Place(landmarks, index._words(of_descriptors), codes.copy()))
        return index

    def list_again(self) -> None:
        """Makes the lists of words from the landmarks of the places."""
        self._lists = WordLists(self.settings.tables << self.settings.bits)
        for position, place in enumerate(self._places):
            self._lists.add(self._words(place.landmarks.descriptors), position)

    # --- parts -------------------------------------------------------------------------------------------------------

    def _words(self, descriptors: np.ndarray) -> np.ndarray:
        bits = np.unpackbits(descriptors, axis=1)[:, self._bits].astype(np.int64)  # [n, tables, bits]
        tables = np.arange(self.settings.tables) << self.settings.bits
        return np.unique(bits @ (1 << np.arange(self.settings.bits)) + tables)

    def _fern_codes(self, view: FeatureView) -> np.ndarray:
        soft = cv2.resize(view.color, FernTuning.thumbnail, interpolation=cv2.INTER_AREA)
        color = cv2.GaussianBlur(soft, (0, 0), 0.5).reshape(-1, 3)[self._fern_pixels]
        depth = cv2.resize(view.depth, FernTuning.thumbnail, interpolation=cv2.INTER_NEAREST).reshape(-1)[
            self._fern_pixels
        ]
        code = (color > self._fern_colors) @ np.array([1, 2, 4]) + 8 * (depth > self._fern_depths)
        return code.astype(np.uint8)

    def _word_scores(self, place: Place) -> np.ndarray:
        """Sum of squared inverse document frequencies of the common words over the root of both numbers of words.

        The rarest words are looked up first, until so many entries were read: a query takes no longer in a large index.
        """
        hits, lengths = self._lists.hits(place.words, self.settings.entries)
        scores = np.bincount(hits, np.log((1 + len(self)) / lengths) ** 2, minlength=len(self))
        return scores / np.sqrt(np.maximum(self._sizes[: len(self)], 1) * max(len(place.words), 1))

    @staticmethod
    def _neighbour(number: int, score: float, found: Mapping[int, float]) -> float:
        """The better score of the two keyframes next in time, at most `score`."""
        return min(score, max(found.get(number - 1, 0.0), found.get(number + 1, 0.0)))


def _check_arrays(arrays: Mapping[str, np.ndarray], ferns: int) -> None:
    """Raises FormatError if these are not the arrays of an index."""
    forms = {
        "numbers": Form("int", "n", below=2**31 - 1), "counts": Form("int", "n", below=2**31 - 1),
        "codes": Form("u1", "n", ferns), "descriptors": Form("u1", "landmarks", 32),
        "points": Form("float", "landmarks", 3, finite=True),
    }  # fmt: skip
    check_arrays(arrays, forms, "places")
    landmarks = int(arrays["counts"].astype(np.int64).sum())
    if len(arrays["points"]) != landmarks:
        raise FormatError(f"places: 'points' has {len(arrays['points'])} rows, expected {landmarks}")
    if len(np.unique(arrays["numbers"])) != len(arrays["numbers"]):
        raise FormatError("places: a keyframe has two places")
