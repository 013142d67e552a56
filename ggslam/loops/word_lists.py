# SPDX-License-Identifier: Apache-2.0
"""Inverted lists of words in little memory. Most words of an index occur once, and a list for each would take forty
times its content."""

from __future__ import annotations

import numpy as np

from ggslam.system.tuning import Tuning


class WordListTuning(Tuning):
    """Index of words."""

    merge_after = 16
    """Places that are kept in a separate, quickly extended list before they are merged into the others."""


class WordLists:
    """Inverted lists: for each word the positions it occurs at, rising.

    Args:
        words: all are less than this.
    """

    def __init__(self, words: int) -> None:
        dtype = np.uint32 if words <= 1 << 32 else np.int64
        self._words = np.empty(0, dtype)
        self._ends = np.zeros(1, np.int64)  # of word i: positions from ends[i] to ends[i + 1]
        self._positions = np.empty(0, np.int32)
        self._recent_words, self._recent_positions = np.empty(0, dtype), np.empty(0, np.int32)  # by word, then position
        self._waiting = 0

    @property
    def held_bytes(self) -> int:
        """Memory that they take, about."""
        recent = self._recent_words.nbytes + self._recent_positions.nbytes
        return self._words.nbytes + self._ends.nbytes + self._positions.nbytes + recent

    def add(self, words: np.ndarray, position: int) -> None:
        """Words [w], sorted, occur at a position greater than all before."""
        place = np.searchsorted(self._recent_words, words, "right")
        self._recent_words = np.insert(self._recent_words, place, words)
        self._recent_positions = np.insert(self._recent_positions, place, position)
        self._waiting += 1
        if self._waiting == WordListTuning.merge_after:
            self._merge()

    def hits(self, words: np.ndarray, most: int) -> tuple[np.ndarray, np.ndarray]:
        """Where some words [w], sorted, occur: the rarest first, words that occur equally often in their order, until
        there would be more than `most` hits.

        Returns:
            Positions int64 [h], and how often the word of each occurs in all, int64 [h].
        """
        words = words.astype(self._words.dtype)
        place = np.searchsorted(self._words, words)
        known = place < len(self._words)
        known[known] = self._words[place[known]] == words[known]
        place = np.where(known, place, 0)
        begins = np.where(known, self._ends[place], 0)
        counts = np.where(known, self._ends[np.minimum(place + 1, len(self._ends) - 1)], 0) - begins
        recent_begins = np.searchsorted(self._recent_words, words)
        recent_counts = np.searchsorted(self._recent_words, words, "right") - recent_begins
        lengths = counts + recent_counts
        order = np.argsort(lengths, kind="stable")
        order = order[lengths[order] > 0]
        order = order[: int(np.searchsorted(np.cumsum(lengths[order]), most, "right"))]
        # A position's hits are all among the merged or all among the recent: each position has them by rising length.
        merged = self._positions[_ranges(begins[order], counts[order])]
        recent = self._recent_positions[_ranges(recent_begins[order], recent_counts[order])]
        times = [np.repeat(lengths[order], each[order]) for each in (counts, recent_counts)]
        return np.concatenate([merged, recent]).astype(np.int64), np.concatenate(times)

    def _merge(self) -> None:
        """The new positions go where the lists of their words end. Nothing else is as long as all lists together, which
        may be most of the memory that a long run has."""
        recent, counts = np.unique(self._recent_words, return_counts=True)
        new = self._recent_positions
        self._recent_words, self._recent_positions = self._recent_words[:0].copy(), new[:0].copy()
        self._waiting = 0
        place = np.searchsorted(self._words, recent)
        known = place < len(self._words)
        known[known] = self._words[place[known]] == recent[known]
        self._positions = np.insert(self._positions, np.repeat(self._ends[place + known], counts), new)
        self._words = np.insert(self._words, place[~known], recent[~known])
        lengths = np.insert(np.diff(self._ends), place[~known], 0)
        lengths[np.searchsorted(self._words, recent)] += counts
        self._ends = np.concatenate([self._ends[:1], np.cumsum(lengths)])


def _ranges(begins: np.ndarray, counts: np.ndarray) -> np.ndarray:
    """Numbers from each of `begins` [n] on, `counts` [n] of them, one range after the other."""
    before = np.cumsum(counts) - counts
    return np.repeat(begins - before, counts) + np.arange(int(counts.sum()))
