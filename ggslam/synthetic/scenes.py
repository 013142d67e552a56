# SPDX-License-Identifier: Apache-2.0
"""The scenes that can be recorded, by name, and how each is recorded by default."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import partial

from ggslam.synthetic.corridor import furnished_corridor
from ggslam.synthetic.house import ring_of_rooms
from ggslam.synthetic.room import furnished_room
from ggslam.synthetic.scene import Scene


@dataclass(frozen=True)
class SceneKind:
    """A scene (a function of the seed and the number of frames) with the number of frames, frames per second,
    trajectory and distortion of the depth camera (see `disparity_distortion`) that suit it."""

    build: Callable[[int, int], Scene]
    frames: int
    frame_rate: float
    trajectory: str
    depth_distortion: float


SCENES = {
    "room": SceneKind(lambda seed, frames: furnished_room(seed), 60, 30.0, "loop", 0.0),
    "loop": SceneKind(lambda seed, frames: ring_of_rooms(seed), 480, 10.0, "route", 0.3),
    "corridor": SceneKind(furnished_corridor, 720, 10.0, "walk", 0.0),
    "bare": SceneKind(partial(furnished_corridor, bare=True), 720, 10.0, "walk", 0.0),
}
