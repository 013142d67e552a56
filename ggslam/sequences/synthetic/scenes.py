# SPDX-License-Identifier: Apache-2.0
"""The scenes that can be recorded, by name, and how each is recorded unless one asks otherwise."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

from ggslam.sequences.synthetic.house import ring_of_rooms
from ggslam.sequences.synthetic.room import furnished_room
from ggslam.sequences.synthetic.scene import Scene


@dataclass(frozen=True)
class SceneKind:
    """A scene (a function of the seed) with the number of frames, frames per second, trajectory and distortion of the
    depth camera (see `disparity_distortion`) that suit it."""

    build: Callable[[int], Scene]
    frames: int
    frame_rate: float
    trajectory: str
    depth_distortion: float


SCENES = {
    "room": SceneKind(furnished_room, 60, 30.0, "loop", 0.0),
    "loop": SceneKind(ring_of_rooms, 480, 10.0, "route", 0.3),
}
