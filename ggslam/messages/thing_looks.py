# SPDX-License-Identifier: Apache-2.0
"""How things look in viewers: the same in rviz and in Foxglove."""

from __future__ import annotations

import numpy as np

from ggslam.messages.contents import Thing
from ggslam.messages.sound_content import plain_text
from ggslam.system.tuning import Tuning


class ThingTuning(Tuning):
    """Boxes, names and arrows of things."""

    text_m = 0.12
    """Height of a capital letter of a name in metres."""
    box_alpha = 0.35
    """Opacity of boxes, 0 to 1."""
    arrow_s = 1.0
    """Seconds of motion that an arrow is long."""
    arrow_m = 0.04
    """Thickness of an arrow in metres."""
    slowest = 1e-3
    """Speed in m/s below which no arrow is drawn."""
    least_m = 1e-3
    """Least side of a box in metres; rviz complains of none."""
    gray = 0.7
    """Brightness of meshes without colours, 0 to 1."""


def label(thing: Thing) -> str:
    """The text at a thing."""
    return plain_text(f"{thing.name}: {thing.note}" if thing.note else thing.name)


def label_place(thing: Thing, up: tuple[float, float, float] | None) -> np.ndarray:
    """Where the text stands, float64 [3]: above the box, or at its middle if nobody knows where up is."""
    T = np.asarray(thing.T, np.float64)
    if up is None:
        return T[:3, 3]
    direction = np.asarray(up, np.float64)
    highest = np.abs(direction @ T[:3, :3]) @ np.asarray(thing.size, np.float64) / 2
    return T[:3, 3] + direction * (highest + ThingTuning.text_m)


def speed(thing: Thing) -> float:
    """m/s; 0 for things that do not move, or too slowly to draw."""
    if thing.velocity is None or not np.isfinite(thing.velocity).all():
        return 0.0
    found = float(np.linalg.norm(thing.velocity))
    return found if found >= ThingTuning.slowest else 0.0


def arrow_pose(thing: Thing) -> np.ndarray:
    """T_frame_arrow float64 [4, 4]: at the middle of the box, x along the velocity."""
    x = np.asarray(thing.velocity, np.float64) / speed(thing)
    helper = np.eye(3)[np.argmin(np.abs(x))]
    y = np.cross(helper, x)
    y /= np.linalg.norm(y)
    T = np.eye(4)
    T[:3, :3] = np.stack([x, y, np.cross(x, y)], 1)
    T[:3, 3] = np.asarray(thing.T, np.float64)[:3, 3]
    return T
