# SPDX-License-Identifier: Apache-2.0
"""The interface between a page and the map that it shows."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Literal, Protocol

import numpy as np

from ggslam.scene.camera import Camera
from ggslam.viewer.splats import Splats

Coloring = Literal["colour", "objects", "identity", "depth"]
"""What splats are coloured by: as trained; by object; by the first three principal components of their identity
vectors; by distance from the camera of the frame that is looked at."""
COLORINGS: dict[Coloring, str] = {
    "colour": "colour", "objects": "objects", "identity": "identity (PCA)", "depth": "depth from the frame",
}  # fmt: skip


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

    @property
    def label(self) -> str:
        """For people: number and name."""
        return f"{self.id} · {self.name}" if self.name else f"{self.id} · object"


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
    def colorings(self) -> tuple[Coloring, ...]:
        """Those there are."""

    def describe(self) -> str:
        """A line about the map."""

    def splats(self, coloring: Coloring, frame: int) -> dict[int, Splats]:
        """By object id; 0 holds those of no object. `frame` is the one that is looked at."""

    def objects(self) -> list[ListedObject]:
        """By rising id."""

    def movers(self) -> list[ShownMover]:
        """What moved while it was recorded."""

    def changes(self) -> list[ShownChange]:
        """What changed between two visits."""

    def frame_picture(self, frame: int) -> tuple[np.ndarray, np.ndarray]:
        """Recorded and rendered images of a frame side by side, and what the frame's camera recorded (or, without
        the recording, renders), uint8 [H, W, 3] both."""

    def object_at(self, origin: np.ndarray, direction: np.ndarray, focal: float, hidden: set[int]) -> int:
        """The object seen along a ray from `origin` [3] by a camera of `focal` pixels when some are hidden; 0: none."""

    def picture(self, camera: Camera, T_world_camera: np.ndarray, hidden: set[int]) -> np.ndarray:
        """The map from there, as well as can be rendered, uint8 [H, W, 3]."""


class EditableMap(ViewedMap, Protocol):
    """A map whose objects can be edited. What is edited is a copy until it is saved.

    Editing methods return a sentence about what was done and raise ConfigError if it cannot be done.
    """

    def rename(self, object_id: int, name: str) -> str:
        """Names an object."""

    def remove(self, object_id: int) -> str:
        """Takes an object out."""

    def move(self, object_id: int, T: np.ndarray) -> str:
        """Moves an object by the rigid transform T [4, 4] of the world frame."""

    def undo(self) -> str:
        """Takes the last edit back."""

    def edits(self) -> list[str]:
        """What was done so far."""

    def export(self, object_id: int) -> tuple[str, bytes]:
        """Name and content of a PLY file of an object."""

    def default_target(self) -> str:
        """Name to save as, if nobody gives another."""

    def save_folder(self) -> Path:
        """Folder that edited maps are saved in."""

    def save(self, target: str, inpaint: bool) -> str:
        """Writes the edited map with all that belongs to it, as a folder of this name in `save_folder`."""
