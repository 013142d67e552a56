# SPDX-License-Identifier: Apache-2.0
"""Words agree with their number."""

from __future__ import annotations

from ggslam.system.plurals import plural, quantity


def test_words_agree_with_their_number() -> None:
    assert [quantity(n, "frame") for n in (0, 1, 2)] == ["0 frames", "1 frame", "2 frames"]
    assert [quantity(n, "vertex", "vertices") for n in (1, 3)] == ["1 vertex", "3 vertices"]
    assert [plural(n, "has", "have") for n in (0, 1, 2)] == ["have", "has", "have"]
