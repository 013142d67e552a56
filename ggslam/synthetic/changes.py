# SPDX-License-Identifier: Apache-2.0
"""One room at two visits: objects are moved, turned, taken away and added in between."""

from __future__ import annotations

from dataclasses import dataclass, replace
from itertools import product
from typing import Any, Literal

import numpy as np

from ggslam.errors import SequenceError
from ggslam.scene.poses import translation
from ggslam.synthetic.room import furnished_room
from ggslam.synthetic.scene import Kind, Scene, Shape
from ggslam.system.tuning import Tuning


class ChangeTuning(Tuning):
    """How objects are moved between two visits."""

    max_changes = 10
    """Most changes of a scene."""
    gap_m = 0.015
    """Smallest distance of a moved object from all others, in metres."""
    tries = 200
    """Places that are tried for it."""
    shifts_m = (0.08, 0.5)
    """Shortest and longest way that it moves, in metres."""
    turns_deg = (-90.0, 90.0)
    """Rotations to the right and to the left, in degrees."""
    touching_m = 0.02
    """Largest distance between an object and what it stands on, in metres."""


_MOVABLE = (
    "mug", "book pile", "ball", "beach ball", "pouf", "vase", "waste basket", "laptop", "chair", "desk chair",
    "keyboard", "desk lamp",
)  # fmt: skip
_AWAY = np.array([0.0, 0.0, -60.0])
"""Where things are that are not there: textures are drawn shape by shape, so every shape stays in the scene."""


@dataclass(frozen=True)
class MadeChange:
    """A change made to an instance between the visits.

    Attributes:
        kind: what.
        instance: id in the masks.
        name: of it.
        middle: float64 [3], of it where it is in the visit that has it, the first if both do; world.
        T_new_old: float64 [4, 4], world; None: it was not moved.
    """

    kind: Literal["moved", "removed", "added"]
    instance: int
    name: str
    middle: np.ndarray
    T_new_old: np.ndarray | None = None

    def to_dict(self) -> dict[str, Any]:
        """For JSON."""
        T = None if self.T_new_old is None else self.T_new_old.tolist()
        middle = self.middle.tolist()
        return {"kind": self.kind, "instance": self.instance, "name": self.name, "middle": middle, "T_new_old": T}


def room_at_two_visits(seed: int, count: int) -> tuple[Scene, Scene, list[MadeChange]]:
    """The furnished room of a seed at a first and at a second visit, and what is different.

    Args:
        seed: of the room, and of what changes.
        count: of the changes: every third one takes something away or puts something there, the others move things
            along what they stand on by 8 to 50 cm and turn them by up to 90 degrees.

    Raises:
        SequenceError: fewer than 0 or more than `ChangeTuning.max_changes`.
    """
    if not 0 <= count <= ChangeTuning.max_changes:
        raise SequenceError(f"changes: expected 0 to {ChangeTuning.max_changes}, found {count}")
    rng = np.random.default_rng([seed, 7])
    first, second = furnished_room(seed), furnished_room(seed)
    names = first.instance_names
    candidates = [i for i, name in names.items() if name in _MOVABLE]
    made: list[MadeChange] = []
    for instance in rng.permutation(candidates).tolist():
        if len(made) == count:
            break
        middle = _middle([shape for shape in first.shapes if shape.instance == instance])
        if len(made) % 3 == 2:
            kind: Literal["removed", "added"] = "removed" if len(made) % 2 else "added"
            _move(second if kind == "removed" else first, instance, translation(_AWAY))
            made.append(MadeChange(kind, instance, names[instance], middle))
            continue
        T = free_motion(second, instance, rng)
        if T is not None:
            _move(second, instance, T)
            made.append(MadeChange("moved", instance, names[instance], middle, T))
    if len(made) < count:
        raise SequenceError(f"changes: no more than {len(made)} of {count} objects found a free place")
    return first, second, made


def free_motion(scene: Scene, instance: int, rng: np.random.Generator) -> np.ndarray | None:
    """A motion [4, 4] along what the instance stands on, to where nothing else is; None: none was found."""
    own = [shape for shape in scene.shapes if shape.instance == instance]
    others = [shape for shape in scene.shapes if shape.instance != instance]
    points = np.concatenate([outline(shape) for shape in own])
    middle, bottom = points.mean(0), float(points[:, 2].min())
    supports = [
        s
        for s in others
        if _is_flat(s) and abs(_top(s) - bottom) < ChangeTuning.touching_m and _carries(s, points, bottom)
    ]
    for _ in range(ChangeTuning.tries if supports else 0):
        heading, turn = rng.uniform(0, 2 * np.pi), np.radians(rng.uniform(*ChangeTuning.turns_deg))
        T = _turn_about(middle, turn)
        T[:2, 3] += rng.uniform(*ChangeTuning.shifts_m) * np.array([np.cos(heading), np.sin(heading)])
        moved = points @ T[:3, :3].T + T[:3, 3]
        if not any(_carries(support, moved, bottom) for support in supports):
            continue
        raised = np.concatenate([moved, fill(moved)])
        raised[:, 2] = np.maximum(raised[:, 2], bottom + ChangeTuning.touching_m + ChangeTuning.gap_m)
        if all((shape.distance(raised) > ChangeTuning.gap_m).all() for shape in others):
            return T
    return None


def _middle(shapes: list[Shape]) -> np.ndarray:
    """Of a thing [3], by the volumes of its shapes: a mug's is in the mug, not in its handle."""
    volumes = [float(np.prod(shape.bounds())) for shape in shapes]
    return np.average([shape.T_world_shape[:3, 3] for shape in shapes], 0, volumes)


def _move(scene: Scene, instance: int, T: np.ndarray) -> None:
    scene.shapes = [
        replace(shape, T_world_shape=T @ shape.T_world_shape) if shape.instance == instance else shape
        for shape in scene.shapes
    ]


def outline(shape: Shape) -> np.ndarray:
    """Corners [8, 3] of a shape's bounding box, world."""
    corners = np.array(list(product((-1, 1), repeat=3))) * shape.bounds()
    return corners @ shape.T_world_shape[:3, :3].T + shape.T_world_shape[:3, 3]


def fill(points: np.ndarray) -> np.ndarray:
    """Points [n, 3] all over the box around some, which lie no farther from each other than what may stand between."""
    low, high = points.min(0), points.max(0)
    axes = [np.linspace(a, b, max(2, int((b - a) / 0.04) + 1)) for a, b in zip(low, high, strict=True)]
    return np.stack(np.meshgrid(*axes), -1).reshape(-1, 3)


def _is_flat(shape: Shape) -> bool:
    """Whether things stand on it."""
    return shape.kind in (Kind.BOX, Kind.FRUSTUM) and bool(shape.T_world_shape[2, 2] > 0.999)


def _top(shape: Shape) -> float:
    return float(shape.T_world_shape[2, 3] + shape.half[2])


def _carries(shape: Shape, points: np.ndarray, bottom: float) -> bool:
    """Whether all that is low of the points [n, 3] is over the top of a flat shape."""
    low = points[points[:, 2] < bottom + 0.1]
    local = (low - shape.T_world_shape[:3, 3]) @ shape.T_world_shape[:3, :3]
    if shape.kind == Kind.FRUSTUM:
        return bool((np.linalg.norm(local[:, :2], axis=1) < shape.half[0] * shape.top).all())
    return bool((np.abs(local[:, :2]) < np.array(shape.half[:2])).all())


def _turn_about(middle: np.ndarray, angle: float) -> np.ndarray:
    """Turn about the vertical through a point."""
    T = np.eye(4)
    T[:2, :2] = [[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]]
    T[:2, 3] = middle[:2] - T[:2, :2] @ middle[:2]
    return T
