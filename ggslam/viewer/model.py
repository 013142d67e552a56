# SPDX-License-Identifier: Apache-2.0
"""The interface between a page and the map that it shows."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol

import numpy as np

from ggslam.scene.camera import Camera

Box = tuple[np.ndarray, np.ndarray, np.ndarray]
"""Center [3], axes (rows of [3, 3]) and size [3], metres, world frame."""


@dataclass(frozen=True)
class ListedObject:
    """An object in a list.

    Attributes:
        id: 1 to 65535.
        name: None if nobody named it.
        color: RGB in pictures.
        gaussians: how many belong to it.
        center, axes, size: its oriented box, [3], rows of [3, 3], [3] metres, world frame.
        centroid: [3], about which it turns when it is moved.
    """

    id: int
    name: str | None
    color: tuple[int, int, int]
    gaussians: int
    center: np.ndarray
    axes: np.ndarray
    size: np.ndarray
    centroid: np.ndarray


@dataclass(frozen=True)
class ShownMover:
    """Something that moved while the map was recorded.

    Attributes:
        way: its middles, [n, 3], world.
        boxes: its box in each frame in which it moves: center [3], axes (rows of [3, 3]) and size [3].
        color: RGB.
    """

    way: np.ndarray
    boxes: dict[int, Box]
    color: tuple[int, int, int]


@dataclass(frozen=True)
class ShownChange:
    """Something that changed between two visits.

    Attributes:
        text: a line about it.
        old, new: its box at the older and at the newer visit; None: it was not there.
        picture: both visits side by side, uint8 [H, W, 3]; None: there is none.
    """

    text: str
    old: Box | None
    new: Box | None
    picture: np.ndarray | None

    def boxes(self) -> list[Box]:
        """Those there are."""
        return [box for box in (self.old, self.new) if box is not None]


class ViewedMap(Protocol):
    """A map with its recording. Methods may be called from any thread."""

    @property
    def camera(self) -> Camera:
        """Of the recording."""

    @property
    def training_cameras(self) -> list[Camera]:
        """The cameras whose pictures taught the map; none: not known."""

    @property
    def frame_poses(self) -> dict[int, np.ndarray]:
        """T_world_camera [4, 4] of the frames that were located, in order; at least one."""

    @property
    def walks(self) -> list[np.ndarray]:
        """Positions [n, 3] of the located frames, by recording and camera."""

    @property
    def keyframe_poses(self) -> np.ndarray:
        """T_world_camera [K, 4, 4]."""

    @property
    def up(self) -> np.ndarray:
        """Unit vector [3]."""

    @property
    def floor(self) -> float | None:
        """Its height along `up`, metres from the world's origin; None: none was found."""

    def centers(self) -> np.ndarray:
        """Of the Gaussians that are shown, float32 [N, 3]."""

    def describe(self) -> str:
        """A line about the map."""

    def objects(self) -> list[ListedObject]:
        """By rising id."""

    def movers(self) -> list[ShownMover]:
        """What moved while it was recorded."""

    def changes(self) -> list[ShownChange]:
        """What changed between two visits."""

    def frame_picture(self, frame: int) -> tuple[np.ndarray, np.ndarray]:
        """Recorded and rendered images of a frame side by side, and what the frame's camera recorded (or, without
        the recording, renders), uint8 [H, W, 3] both."""

    def picture(self, camera: Camera, T_world_camera: np.ndarray, hidden: set[int]) -> np.ndarray:
        """The map from there, as well as can be rendered, uint8 [H, W, 3]."""
