# SPDX-License-Identifier: Apache-2.0
"""Maps object ids to classes of the classifier and initializes new classes, equally on every device."""

from __future__ import annotations

from typing import Annotated

import numpy as np

from ggslam.errors import FormatError
from ggslam.system.array_forms import Form
from ggslam.system.savable import savable
from ggslam.system.tuning import Tuning


class ClassTuning(Tuning):
    """How new classes of objects start."""

    initial_rows = 100
    """Rows allocated at the start."""
    row_length = 4.0
    """Length of a new class's row: with codes of length 2, a Gaussian of one object has a logit of 8 for it."""
    code_length = 2.0
    """Length of the identity vector of a Gaussian that shows one object only."""


@savable(check="check")
class ClassNumbers:
    """Which class each object id has: numbers from 0 on, without gaps."""

    _ids: Annotated[np.ndarray, Form("u2", None)]
    _class_of: Annotated[np.ndarray, Form("i4", 65536)]

    def __init__(self) -> None:
        self._ids = np.zeros(ClassTuning.initial_rows, np.uint16)
        self._class_of = np.full(65536, -1, np.int32)
        self.count = 0

    def check(self) -> None:
        """Raises FormatError if ids and numbers do not belong to each other: it may come from a file."""
        known = self._class_of >= 0
        if not 0 <= self.count <= len(self._ids) or known.sum() != self.count or self._class_of.min() < -1:
            raise FormatError(f"classes of objects: expected numbers from 0 to below {self.count}")
        if not np.array_equal(self._class_of[self.ids], np.arange(self.count)):
            raise FormatError("classes of objects: an id has two classes")

    @property
    def ids(self) -> np.ndarray:
        """Object id of each class, uint16 [count]; a view."""
        return self._ids[: self.count]

    @property
    def table(self) -> np.ndarray:
        """Class number of every object id, int32 [65536], -1 where there is none; a view."""
        return self._class_of

    def of(self, object_ids: np.ndarray) -> np.ndarray:
        """Class number of each object id, int32 of the same shape; -1 where there is none."""
        return self._class_of[object_ids]

    def add(self, object_ids: np.ndarray) -> slice:
        """Gives the next numbers to those ids (uint16, distinct) that are not 0 and have none yet; returns them."""
        new = object_ids[(object_ids != 0) & (self._class_of[object_ids] < 0)]
        numbers = slice(self.count, self.count + len(new))
        if numbers.stop > len(self._ids):
            self._ids = np.pad(self._ids, (0, max(numbers.stop, 2 * len(self._ids)) - len(self._ids)))
        self._ids[numbers], self._class_of[new] = new, np.arange(numbers.start, numbers.stop)
        self.count = numbers.stop
        return numbers

    def remove(self, object_id: int) -> int | None:
        """Takes an id's number away, which the class with the last number gets; returns the number, None if the id has
        none."""
        number, last = int(self._class_of[object_id]), self.count - 1
        if number < 0:
            return None
        self._class_of[self._ids[last]] = number
        self._class_of[object_id] = -1
        self._ids[number], self._ids[last] = self._ids[last], 0
        self.count = last
        return number


def new_rows(rng: np.random.Generator, count: int, channels: int) -> np.ndarray:
    """Weights of new classes, float32 [count, channels]: directions drawn evenly."""
    directions = rng.normal(size=(count, channels)).astype(np.float32)
    directions *= ClassTuning.row_length / np.linalg.norm(directions, axis=1, keepdims=True)
    return directions
