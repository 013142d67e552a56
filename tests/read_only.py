# SPDX-License-Identifier: Apache-2.0
"""Recordings whose images nobody may write into, as those are that are views of a message or of a mapped file."""

from __future__ import annotations

import dataclasses
import warnings
import zlib
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any

import numpy as np
import pytest

from ggslam.scene.frame import Frame
from ggslam.sequences import sequence
from ggslam.sequences.masks import MaskReader

_IMAGES = ("color", "depth", "mask", "valid")


def locked(array: Any) -> Any:
    """A read-only copy of an array; what is none stays as it is."""
    if not isinstance(array, np.ndarray):
        return array
    out = array.copy()
    out.setflags(write=False)
    return out


def _locking(read: Callable[..., Any]) -> Callable[..., Any]:
    return lambda *given, **named: locked(read(*given, **named))


def _sum(array: np.ndarray) -> int:
    return zlib.crc32(np.ascontiguousarray(array))


@contextmanager
def read_only_images() -> Iterator[list[Frame]]:
    """Inside, what readers and sequences give is read-only, and torch's warning about such arrays is an error. Yields
    the frames that were delivered; at the end they are as they were, also if compiled code got hold of them."""
    delivered: list[Frame] = []
    sums: list[tuple[Frame, dict[str, int]]] = []
    make = sequence.Sequence._frame

    def frame(self: sequence.Sequence, *given: Any) -> Frame:
        found = make(self, *given)
        found = dataclasses.replace(found, **{name: locked(getattr(found, name)) for name in _IMAGES})
        if found.mask_loader is not None:
            found = dataclasses.replace(found, mask_loader=_locking(found.mask_loader))
        delivered.append(found)
        # A pair at once: several threads may read frames.
        sums.append((found, {name: _sum(array) for name in _IMAGES if (array := getattr(found, name)) is not None}))
        return found

    with pytest.MonkeyPatch.context() as patch, warnings.catch_warnings():
        warnings.filterwarnings("error", message=".*not writable.*")
        for name in ("read_color", "metric_depth", "no_returns", "read_confidence"):
            patch.setattr(sequence, name, _locking(getattr(sequence, name)))
        patch.setattr(MaskReader, "read", _locking(MaskReader.read))
        patch.setattr(sequence.Sequence, "_frame", frame)
        yield delivered
    assert len(sums) == len(delivered)
    for found, kept in sums:
        assert {name: _sum(getattr(found, name)) for name in kept} == kept
