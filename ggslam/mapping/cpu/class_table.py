# SPDX-License-Identifier: Apache-2.0
"""The classifier while it is trained: rows are added as object ids appear, Adam's moments grow along."""

from __future__ import annotations

from typing import Annotated

import numpy as np

from ggslam.errors import FormatError
from ggslam.mapping.class_numbers import ClassNumbers, ClassTuning, new_rows
from ggslam.scene.identity import IDENTITY_CHANNELS, IdentityClassifier, IdentityVectorTuning
from ggslam.system.array_forms import Form
from ggslam.system.savable import savable


@savable(check="check")
class CpuClassTable:
    """A growing linear classifier with its optimizer.

    Args:
        rng: draws the rows of new classes.
        channels: length of an identity vector.
    """

    _rows: Annotated[np.ndarray, Form("f4", "rows", None, finite=True)]
    _moments: Annotated[np.ndarray, Form("f4", 2, "rows", None, finite=True)]

    def __init__(self, rng: np.random.Generator, channels: int = IDENTITY_CHANNELS) -> None:
        self._rng, self._channels = rng, channels
        self._rows = np.zeros((ClassTuning.initial_rows, channels + 1), np.float32)  # weights, then the bias
        self._moments = np.zeros((2, ClassTuning.initial_rows, channels + 1), np.float32)
        self._numbers = ClassNumbers()
        self._steps = 0

    def check(self) -> None:
        """Raises FormatError if it has not a row for each class: it may come from a file."""
        width = self._channels + 1
        if self.count > len(self._rows) or self._rows.shape[1] != width or self._moments.shape[2] != width:
            raise FormatError(f"classifier: expected {self.count} rows of {width} numbers")
        if self._steps < 0:
            raise FormatError(f"classifier: {self._steps} steps")

    @property
    def count(self) -> int:
        """Number of classes."""
        return self._numbers.count

    @property
    def classifier(self) -> IdentityClassifier:
        """Views of the classes there are."""
        n = self.count
        return IdentityClassifier(self._numbers.ids, self._rows[:n, :-1], self._rows[:n, -1])

    def classes(self, object_ids: np.ndarray) -> np.ndarray:
        """Class number of each object id, int32 of the same shape; -1 where there is none."""
        return self._numbers.of(object_ids)

    def add(self, object_ids: np.ndarray) -> None:
        """Makes a class of each id (uint16, distinct) that is not 0 and has none yet."""
        new = self._numbers.add(object_ids)
        if new.stop > len(self._rows):
            extra = max(new.stop, 2 * len(self._rows)) - len(self._rows)
            self._rows = np.pad(self._rows, ((0, extra), (0, 0)))
            self._moments = np.pad(self._moments, ((0, 0), (0, extra), (0, 0)))
        self._rows[new, :-1] = new_rows(self._rng, new.stop - new.start, self._channels)
        self._rows[new, -1] = 0

    def resume(self, classifier: IdentityClassifier) -> None:
        """Takes over the classes of a classifier, with fresh moments."""
        self.add(classifier.class_ids)
        number = self._numbers.of(classifier.class_ids)
        self._rows[number, :-1], self._rows[number, -1] = classifier.weight, classifier.bias

    def remove(self, object_id: int) -> None:
        """Forgets a class; the last one takes its place."""
        number = self._numbers.remove(object_id)
        if number is None:
            return
        last = self.count
        for array in (self._rows, self._moments[0], self._moments[1]):
            array[number] = array[last]
            array[last] = 0

    def codes(self, object_ids: np.ndarray) -> np.ndarray:
        """Identity vectors that the classifier takes for these objects, float32 [M, F]; zeros for those without a
        class."""
        number = self._numbers.of(object_ids)
        weights = self._rows[: self.count, :-1]
        codes = ClassTuning.code_length * weights / np.maximum(np.linalg.norm(weights, axis=1, keepdims=True), 1e-12)
        return np.concatenate([codes, np.zeros((1, self._channels), np.float32)])[number]

    def members(
        self, features: np.ndarray, object_ids: np.ndarray, rivals: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray]:
        """Vectors that are more probably one of some objects than nothing and than a rival of their own. Costs what
        these objects cost, however many classes there are.

        Args:
            features: float32 [N, F].
            object_ids: with classes, [K].
            rivals: object id for each vector, [N]; without a class: none.

        Returns:
            Rows int64 [M] and the likeliest of `object_ids` [M].
        """
        best, which = (
            np.full(len(features), IdentityVectorTuning.nothing_logit, np.float32),
            np.zeros(len(features), np.int64),
        )
        for k, number in enumerate(self._numbers.of(object_ids)):
            logits = features @ self._rows[number, :-1] + self._rows[number, -1]
            which[logits > best] = k
            np.maximum(best, logits, out=best)
        rows = np.flatnonzero(best > IdentityVectorTuning.nothing_logit)
        rival = self._numbers.of(rivals[rows])
        weights = self._rows[rival]
        of_rival = np.einsum("nf,nf->n", features[rows], weights[:, :-1]) + weights[:, -1]
        rows = rows[(rival < 0) | (of_rival < best[rows])]
        return rows, object_ids[which[rows]]

    def step(self, classes: np.ndarray, gradient: np.ndarray, rate: float) -> None:
        """Adam (0.9, 0.999) on the rows `classes` [M] with gradient [M, F + 1] (weights, then bias)."""
        self._steps += 1
        first, second = self._moments[0][classes], self._moments[1][classes]
        first += 0.1 * (gradient - first)
        second += 0.001 * (gradient**2 - second)
        self._moments[0][classes], self._moments[1][classes] = first, second
        corrected = np.sqrt(second / (1 - 0.999**self._steps)) + 1e-15
        self._rows[classes] -= rate / (1 - 0.9**self._steps) * first / corrected
