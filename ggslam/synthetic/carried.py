# SPDX-License-Identifier: Apache-2.0
"""A mug of the room that is lifted, carried in an arc and put down elsewhere."""

from __future__ import annotations

import numpy as np

from ggslam.errors import SequenceError
from ggslam.scene.poses import translation
from ggslam.synthetic.changes import fill, free_motion, outline
from ggslam.synthetic.motion import Mover, Setting, sample_window, turn
from ggslam.synthetic.scene import Shape
from ggslam.system.tuning import Tuning


class CarriedTuning(Tuning):
    """How an object is carried."""

    lift_m = 0.22
    """Height that it is lifted, in metres."""
    min_way_m = 0.2
    """Shortest way, in metres."""
    tries = 25
    """Places that are tried for each object."""


def carried_mug(setting: Setting) -> Mover:
    """The mug that the camera sees best of those that can be carried somewhere.

    Raises:
        SequenceError: none can.
    """
    rng = np.random.default_rng([setting.seed, 11, 1])
    names = setting.scene.instance_names
    mugs = [number for number, name in names.items() if name == "mug"]
    best, chosen, most = None, 0, 0.0
    for number in mugs:
        if not (setting.views.masks == number).any():
            continue
        for _ in range(CarriedTuning.tries):
            found = _way(setting, number, rng)
            if found is not None and found[1] > most:
                (best, most), chosen = found, number
    if best is None:
        raise SequenceError("movers: no mug that the camera sees can be carried elsewhere")
    shapes = setting.scene.shapes
    numbers = [i for i, shape in enumerate(shapes) if shape.instance == chosen]
    rest = np.array([shapes[i].T_world_shape for i in numbers])
    what = "a mug, carried by nothing visible and put down elsewhere"
    return Mover(names[chosen], what, chosen, True, best @ rest[0], numbers, best[:, None] @ rest)


def _way(setting: Setting, number: int, rng: np.random.Generator) -> tuple[np.ndarray, float] | None:
    """Motions T_world_start [frames, 4, 4] to a free place, through nothing, and the share that is seen on the way;
    None: this time none was found."""
    scene = setting.scene
    others = [shape for shape in scene.shapes if shape.instance != number]
    points = np.concatenate([outline(shape) for shape in scene.shapes if shape.instance == number])
    middle, target = points.mean(0), free_motion(scene, number, rng)
    if target is None:
        return None
    way = target[:3, :3] @ middle + target[:3, 3] - middle
    if np.linalg.norm(way) < CarriedTuning.min_way_m:
        return None
    angle, progress = float(np.arctan2(target[1, 0], target[0, 0])), sample_window(rng, setting.frames)
    motion = _arc(progress, middle, way, angle)
    seen = setting.views.share_seen(_places_after(middle[None], motion), progress)
    free = seen > 0 and _is_free(fill(points), _arc(np.linspace(0.1, 0.9, 15), middle, way, angle), others)
    return (motion, seen) if free else None


def _arc(s: np.ndarray, middle: np.ndarray, way: np.ndarray, angle: float) -> np.ndarray:
    """Motions [n, 4, 4] at shares s [n] of the way: up fast, along, and down."""
    height = CarriedTuning.lift_m * (1 - (2 * s - 1) ** 4)
    at = middle + s[:, None] * way + height[:, None] * np.array([0.0, 0.0, 1.0])
    return translation(at) @ turn(s * angle, 2) @ translation(-middle)


def _places_after(points: np.ndarray, motions: np.ndarray) -> np.ndarray:
    """Points [n, 3] after each of the motions: [motions, n, 3]."""
    return points @ motions[:, :3, :3].swapaxes(1, 2) + motions[:, None, :3, 3]


def _is_free(points: np.ndarray, motions: np.ndarray, others: list[Shape]) -> bool:
    moved = _places_after(points, motions).reshape(-1, 3)
    return all((shape.distance(moved) > 0).all() for shape in others)
