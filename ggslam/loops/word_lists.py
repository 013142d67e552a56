# SPDX-License-Identifier: Apache-2.0
"""Where words occur, in few bytes: most words of an index of places occur once, and a list for each costs forty times
what it says."""

from __future__ import annotations

from itertools import chain

import numpy as np

_MERGED_AFTER = 16
"""Places that are kept in lists of their own, which are quick to add to, before they join the arrays."""
_LIST_BYTES = 170
"""Memory of a list with one position, and of its key."""


class WordLists:
    """Inverted lists: for each word the positions it occurs at, rising.

    Args:
        words: all are less than this.
    """

    def __init__(self, words: int) -> None:
        self._words = np.empty(0, np.uint32 if words <= 1 << 32 else np.int64)
        self._ends = np.zeros(1, np.int64)  # of word i: positions from ends[i] to ends[i + 1]
        self._positions = np.empty(0, np.int32)
        self._recent: dict[int, list[int]] = {}
        self._waiting = 0

    @property
    def held_bytes(self) -> int:
        """Memory that they take, about."""
        return self._words.nbytes + self._ends.nbytes + self._positions.nbytes + _LIST_BYTES * len(self._recent)

    def add(self, words: np.ndarray, position: int) -> None:
        """Words [w], sorted, occur at a position greater than all before."""
        for word in words.tolist():
            self._recent.setdefault(word, []).append(position)
        self._waiting += 1
        if self._waiting == _MERGED_AFTER:
            self._merge()

    def hits(self, words: np.ndarray, most: int) -> tuple[np.ndarray, np.ndarray]:
        """Where some words [w], sorted, occur: the rarest first, words that occur equally often in their order, until
        there would be more than `most` hits.

        Returns:
            Positions int64 [h], and how often the word of each occurs in all, int64 [h].
        """
        place = np.searchsorted(self._words, words)
        known = place < len(self._words)
        known[known] = self._words[place[known]] == words[known]
        place = np.where(known, place, 0)
        begins = np.where(known, self._ends[place], 0)
        counts = np.where(known, self._ends[np.minimum(place + 1, len(self._ends) - 1)], 0) - begins
        lists = [self._recent.get(word, ()) for word in words.tolist()]
        lengths = counts + np.array([len(found) for found in lists], np.int64)
        order = np.argsort(lengths, kind="stable")
        order = order[lengths[order] > 0]
        order = order[: int(np.searchsorted(np.cumsum(lengths[order]), most, "right"))]
        merged = np.repeat(begins[order] - np.cumsum(counts[order]) + counts[order], counts[order])
        of_merged = self._positions[merged + np.arange(len(merged))]
        recent = [lists[i] for i in order.tolist()]
        of_recent = np.fromiter(chain.from_iterable(recent), np.int64)
        recent_counts = np.array([len(found) for found in recent], np.int64)
        # A position's hits are all among the merged or all among the recent: each position has them by rising length.
        return (
            np.concatenate([of_merged.astype(np.int64), of_recent]),
            np.concatenate([np.repeat(lengths[order], counts[order]), np.repeat(lengths[order], recent_counts)]),
        )

    def _merge(self) -> None:
        """The new positions go where the lists of their words end. Nothing else is as long as all lists together, which
        may be most of the memory that a long run has."""
        recent = np.array(sorted(self._recent), self._words.dtype)
        counts = np.array([len(self._recent[word]) for word in recent.tolist()], np.int64)
        new = np.fromiter(chain.from_iterable(self._recent[word] for word in recent.tolist()), np.int32)
        self._recent, self._waiting = {}, 0
        place = np.searchsorted(self._words, recent)
        known = place < len(self._words)
        known[known] = self._words[place[known]] == recent[known]
        self._positions = np.insert(self._positions, np.repeat(self._ends[place + known], counts), new)
        words = np.union1d(self._words, recent)
        lengths = np.zeros(len(words), np.int64)
        lengths[np.searchsorted(words, self._words)] = np.diff(self._ends)
        lengths[np.searchsorted(words, recent)] += counts
        self._words, self._ends = words, np.concatenate([self._ends[:1], np.cumsum(lengths)])
