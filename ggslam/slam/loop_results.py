# SPDX-License-Identifier: Apache-2.0
"""What the search for loops gives: events for the record of the run, corrections for its map."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ggslam.system.savable import savable


@savable(formerly="ggslam.slam.loop_closing.LoopEvent")
@dataclass(frozen=True)
class LoopEvent:
    """The outcome for a candidate, or for a lost frame.

    Attributes:
        kind: "closed", "verified" (believed later or never), "refused", "found again"; "new part", "joined",
            "left out" (see `slam.map_parts`).
        frame: index of the frame.
        keyframe: number of the newer keyframe (of the one it would become, for a frame found again).
        old_keyframe: the one it was compared with.
        reason: in words, with numbers.
        moved_m: how far the newer end was moved, metres (closed only).
    """

    kind: str
    frame: int
    keyframe: int
    old_keyframe: int
    reason: str
    moved_m: float = 0.0


@dataclass(frozen=True)
class Correction:
    """New keyframe poses after a loop was closed.

    Attributes:
        T_world_camera: float64 [K, 4, 4].
        T_new_old: float64 [K, 4, 4], what moves the world about each keyframe.
        kept: numbers of the keyframes at the older end, whose map stays.
        doubted: numbers of those that may have mapped the same surface again.
        active: numbers of the keyframes that the tracker relies on now.
    """

    T_world_camera: np.ndarray
    T_new_old: np.ndarray
    kept: set[int]
    doubted: set[int]
    active: set[int]
