# SPDX-License-Identifier: Apache-2.0
"""Nouns agree with their numbers."""

from __future__ import annotations

from ggslam.system.counting import counted


def test_one_and_many() -> None:
    assert [counted(number, "frame") for number in (0, 1, 2)] == ["0 frames", "1 frame", "2 frames"]
