# SPDX-License-Identifier: Apache-2.0
"""The scenes that can be recorded, by name, and how each is recorded by default."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

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


def _loop(seed: int, frames: int) -> Scene:
    from ggslam.synthetic.houses.house import ring_of_rooms  # houses are loaded by those who want one

    return ring_of_rooms(seed)


def _corridor(seed: int, frames: int, bare: bool = False) -> Scene:
    from ggslam.synthetic.houses.corridor import furnished_corridor

    return furnished_corridor(seed, frames, bare=bare)


SCENES = {
    "room": SceneKind(lambda seed, frames: furnished_room(seed), 60, 30.0, "loop", 0.0),
    "loop": SceneKind(_loop, 480, 10.0, "route", 0.3),
    "corridor": SceneKind(_corridor, 720, 10.0, "walk", 0.0),
    "bare": SceneKind(lambda seed, frames: _corridor(seed, frames, bare=True), 720, 10.0, "walk", 0.0),
}
