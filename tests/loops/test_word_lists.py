# SPDX-License-Identifier: Apache-2.0
"""Compact inverted lists against plain ones."""

from __future__ import annotations

import numpy as np
import pytest

from ggslam.loops.word_lists import WordLists


@pytest.mark.parametrize("places", [0, 5, 64, 150])
def test_hits_are_those_of_plain_lists(places: int) -> None:
    rng = np.random.default_rng(places)
    compact, plain = WordLists(400), {}
    for position in range(places):
        words = np.unique(rng.integers(0, 400, 60))
        compact.add(words, position)
        for word in words.tolist():
            plain.setdefault(word, []).append(position)
    for most in (0, 37, 10**6):
        query = np.unique(rng.integers(0, 500, 90))
        lists = sorted((plain[word] for word in query.tolist() if word in plain), key=len)
        read = int(np.searchsorted(np.cumsum([len(found) for found in lists]), most, "right")) if lists else 0
        weights = [1 / len(found) for found in lists[:read] for _ in found]
        expected = np.bincount([p for found in lists[:read] for p in found], weights, minlength=places)
        hits, lengths = compact.hits(query, most)
        assert np.array_equal(np.bincount(hits, 1 / lengths, minlength=places), expected)


def test_few_bytes_for_an_entry() -> None:
    compact, rng = WordLists(1 << 18), np.random.default_rng(1)
    entries = 0
    for position in range(128):
        words = np.unique(rng.integers(0, 1 << 18, 2000))
        entries += len(words)
        compact.add(words, position)
    assert 4 * entries <= compact.held_bytes < 16 * entries
