# SPDX-License-Identifier: Apache-2.0
"""Images that a recording holds several times: the same depth beside new colour, or the same colour beside new
depth."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from ggslam.errors import SequenceError
from ggslam.sequences.images import read_color
from ggslam.sequences.recording import ImageFile
from ggslam.sequences.sequence import Sequence
from ggslam.system.tuning import Tuning
from ggslam.system.untrusted_files import FileTuning, read_untrusted


class RepeatTuning(Tuning):
    """When images are said to repeat."""

    stretches = 3
    """Stretches of a recording that are read."""
    stretch_frames = 9
    """Successive frames of a stretch."""
    min_pairs = 3
    """Fewest pairs of equal neighbours."""
    min_share = 0.1
    """Smallest share of them among all pairs."""


@dataclass(frozen=True)
class Repeats:
    """Neighbouring frames of which one image is the same and the other is not.

    Attributes:
        pairs: neighbours that were compared.
        depth: pairs with the same depth and other colour.
        color: pairs with the same colour and other depth.
        blank: whether the images that are the same there show one colour and nothing else.
    """

    pairs: int
    depth: int
    color: int
    blank: bool = False

    def many(self, count: int) -> bool:
        """Whether so many pairs are worth a word."""
        return count >= RepeatTuning.min_pairs and count >= RepeatTuning.min_share * self.pairs


def find_repeats(sequence: Sequence) -> Repeats:
    """Compares neighbours at some places of a recording, byte by byte."""
    pairs = depth = color = 0
    blank = True
    first = np.unique(
        np.linspace(0, max(len(sequence) - RepeatTuning.stretch_frames, 0), RepeatTuning.stretches).round().astype(int)
    )
    numbers = sorted(
        {k for at in first.tolist() for k in range(at, min(at + RepeatTuning.stretch_frames, len(sequence)) - 1)}
    )
    for number in numbers:
        try:
            here, there = sequence.files(number), sequence.files(number + 1)
            same_depth, same_color = _alike(here.depth, there.depth), _alike(here.color, there.color)
        except SequenceError:
            continue
        pairs += 1
        depth += same_depth and not same_color
        if same_color and not same_depth:
            color, blank = color + 1, blank and _is_blank(here.color)
    return Repeats(pairs, depth, color, blank and color > 0)


def _is_blank(file: ImageFile) -> bool:
    """Whether an image holds one colour only."""
    image = read_color(file)
    return bool((image == image[0, 0]).all())


def _alike(a: ImageFile, b: ImageFile) -> bool:
    """Whether two images are the same: files by their bytes, others by their pixels."""
    if isinstance(a, Path) and isinstance(b, Path):
        return a == b or read_untrusted(a, FileTuning.max_image_bytes, SequenceError) == read_untrusted(
            b, FileTuning.max_image_bytes, SequenceError
        )
    if isinstance(a, Path) or isinstance(b, Path):
        return False
    return bool(np.array_equal(a.read(), b.read()))
