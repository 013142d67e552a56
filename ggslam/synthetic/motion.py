# SPDX-License-Identifier: Apache-2.0
"""Motion of objects in a generated recording, for the ray caster and the ground truth."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

import numpy as np

from ggslam.scene.camera import Camera
from ggslam.scene.poses import translation
from ggslam.synthetic.scene import Scene, Shape


@dataclass(frozen=True)
class Mover:
    """An object that moves.

    Attributes:
        name: of its instance; `what`: for people to read.
        instance: id in the masks.
        rigid: whether one pose tells all.
        poses: T_world_own, float64 [frames, 4, 4].
        numbers: of its shapes, among those of the scene followed by those that movers bring along.
        tracks: their T_world_shape, float64 [frames, shapes, 4, 4].
        parts: T_world_part, float64 [frames, 4, 4], of parts that move by themselves.
        painted: what stands for it while it is only painted on a larger thing, in the frames `is_painted` [frames].
    """

    name: str
    what: str
    instance: int
    rigid: bool
    poses: np.ndarray
    numbers: list[int]
    tracks: np.ndarray
    parts: dict[str, np.ndarray] = field(default_factory=dict)
    painted: Shape | None = None
    is_painted: np.ndarray | None = None

    def moves(self, frame: int) -> bool:
        """Whether it is elsewhere than in the frame before."""
        return frame > 0 and not np.array_equal(self.tracks[frame], self.tracks[frame - 1])

    def describe(self) -> dict[str, Any]:
        """For JSON."""
        return {"name": self.name, "what": self.what, "instance_id": self.instance, "rigid": self.rigid}

    def describe_frame(self, frame: int, mask: np.ndarray) -> dict[str, Any]:
        """Where it is in a frame with a mask [H, W]; for JSON."""
        told: dict[str, Any] = {
            "name": self.name,
            "instance_id": self.instance,
            "moving": self.moves(frame),
            "visible_px": int((mask == self.instance).sum()),
            "T_world": self.poses[frame].tolist(),
        }
        if self.parts:
            told["parts"] = {name: poses[frame].tolist() for name, poses in self.parts.items()}
        return told


@dataclass(frozen=True)
class Views:
    """Small images that a camera takes of the scene at rest in some of a recording's frames.

    Attributes:
        camera: of the small images.
        poses: T_world_camera of all the recording's frames, float64 [frames, 4, 4].
        frames: numbers of those with images.
        depths, masks: [n, H, W].
    """

    camera: Camera
    poses: np.ndarray
    frames: np.ndarray
    depths: np.ndarray
    masks: np.ndarray

    def sees(self, points: np.ndarray, frame: int) -> np.ndarray:
        """Whether points [n, 3] are in the image of a frame and not hidden by what is at rest; bool [n].

        Args:
            points: world.
            frame: position in `frames`.
        """
        T = self.poses[self.frames[frame]]
        own = (points - T[:3, 3]) @ T[:3, :3]
        rows, columns, inside = self.camera.project(own, nearest=0.1)
        return inside & (own[:, 2] < self.depths[frame][rows, columns] + 0.03)

    def share_seen(self, points: np.ndarray, progress: np.ndarray) -> float:
        """Of what is under way, the share that is seen.

        Args:
            points: of it in every frame, float64 [frames, n, 3].
            progress: from 0 to 1, [frames].
        """
        times = [i for i, frame in enumerate(self.frames) if 0 < progress[frame] < 1]
        return float(np.mean([self.sees(points[self.frames[i]], i) for i in times])) if times else 0.0


@dataclass(frozen=True)
class Setting:
    """The scene, camera and frames that a mover is made for.

    Attributes:
        scene: at rest, with the names of all movers so far.
        views: of it.
        seed: of everything random.
        shapes: that movers so far bring along, at a pose to be lit at.
        movers: so far.
    """

    scene: Scene
    views: Views
    seed: int
    shapes: list[Shape] = field(default_factory=list)
    movers: list[Mover] = field(default_factory=list)

    @property
    def frames(self) -> int:
        """Of the recording."""
        return len(self.views.poses)

    def new_instance(self, name: str) -> int:
        """Id of a thing that the scene does not have."""
        number = max(self.scene.instance_names) + 1
        self.scene.instance_names[number] = name
        return number

    def add_shapes(self, shapes: list[Shape]) -> list[int]:
        """Their numbers."""
        first = len(self.scene.shapes) + len(self.shapes)
        self.shapes.extend(shapes)
        return list(range(first, first + len(shapes)))


def progress_between(frames: int, first: float, last: float) -> np.ndarray:
    """From 0 to 1 between two shares of a recording, with a gentle start and stop: float64 [frames]; it is exactly 0
    and 1 outside."""
    begin, end = round(first * frames), round(last * frames)
    t = np.clip((np.arange(frames) - begin) / max(1, end - begin), 0, 1)
    return t**3 * (10 - 15 * t + 6 * t**2)


def sample_window(rng: np.random.Generator, frames: int) -> np.ndarray:
    """A short motion somewhere well inside a recording, as of `progress_between`."""
    first = rng.uniform(0.12, 0.5)
    return progress_between(frames, first, first + rng.uniform(0.25, 0.35))


def turn(angles: np.ndarray, axis: int) -> np.ndarray:
    """Transforms [n, 4, 4] of turns by angles [n] in radians about an axis: 1 is y, 2 is z."""
    T = translation(np.zeros((len(angles), 3)))
    i, j = ((2, 0), (0, 1))[axis - 1]
    T[:, i, i] = T[:, j, j] = np.cos(angles)
    T[:, j, i] = np.sin(angles)
    T[:, i, j] = -T[:, j, i]
    return T
