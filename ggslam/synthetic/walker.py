# SPDX-License-Identifier: Apache-2.0
"""A person of boxes and cylinders who walks through the view."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from ggslam.errors import SequenceError
from ggslam.scene.poses import translation
from ggslam.synthetic.materials import MaterialMaker
from ggslam.synthetic.motion import Mover, Setting, progress_between, turn
from ggslam.synthetic.scene import Scene, SceneBuilder, Shape
from ggslam.system.tuning import Tuning


class WalkerTuning(Tuning):
    """How a person walks."""

    radius_m = 0.26
    """Radius of free floor around a person's middle, in metres."""
    height_m = 1.78
    """Height of a person, in metres."""
    from_camera_m = 0.6
    """Smallest distance from the camera, in metres."""
    max_step_m = 0.05
    """Longest mean way between frames, in metres."""
    min_way_m = 1.3
    """Shortest limit of the way, in metres."""
    max_way_m = 3.6
    """Longest limit of the way, in metres."""
    stride_m = 1.4
    """Length of two steps, in metres."""
    swing = np.radians(27)
    """How far legs swing, in radians."""
    cell_m = 0.08
    """Side of the cells of the floor, in metres."""
    tries = 4000
    """Ways that are tried."""
    enough = 0.6
    """Share of a way in view with which it is taken at once."""


_JOINTS = {"torso": (0.0, 0.0, 0.88), "left leg": (0.0, 0.1, 0.88), "right leg": (0.0, -0.1, 0.88),
           "left arm": (0.0, 0.26, 1.4), "right arm": (0.0, -0.26, 1.4)}  # fmt: skip
_SWINGS = {"torso": 0.0, "left leg": 1.0, "right leg": -1.0, "left arm": -0.8, "right arm": 0.8}


@dataclass(frozen=True)
class _Way:
    """Positions [frames, 2], headings [frames] and metres walked [frames]."""

    at: np.ndarray
    heading: np.ndarray
    walked: np.ndarray


def walker(setting: Setting) -> Mover:
    """A person whose arms and legs swing.

    Raises:
        SequenceError: nowhere can anybody walk in view of the camera.
    """
    rng = np.random.default_rng([setting.seed, 11, 0])
    way = _find_way(setting, rng)
    number = setting.new_instance("person")
    root = translation(np.column_stack([way.at, np.zeros(setting.frames)])) @ turn(way.heading, 2)
    gentle = np.clip(np.minimum(way.walked, way.walked[-1] - way.walked) / (WalkerTuning.stride_m / 4), 0, 1)
    swing = WalkerTuning.swing * gentle * np.sin(2 * np.pi * way.walked / WalkerTuning.stride_m)
    figure = _figure(number, rng)
    parts, shapes, tracks = {}, [], []
    for name, joint in _JOINTS.items():
        parts[name] = root @ translation(np.array(joint)) @ turn(_SWINGS[name] * swing, 1)
        for shape in figure[name]:
            local = translation(-np.array(joint)) @ shape.T_world_shape
            tracks.append(parts[name] @ local)
            shapes.append(replace(shape, T_world_shape=tracks[-1][setting.frames // 2]))
    numbers = setting.add_shapes(shapes)
    what = f"a walking person of boxes and cylinders, {WalkerTuning.height_m:g} m"
    return Mover("person", what, number, False, root, numbers, np.stack(tracks, 1), {"root": root, **parts})


def person_in_stride(rng: np.random.Generator, swing: float) -> list[Shape]:
    """Shapes of a person at the origin who looks along x, with legs apart.

    Args:
        rng: chooses the clothes.
        swing: of the left leg to the back, radians; the other limbs go with it.
    """
    figure, shapes = _figure(1, rng), []
    for name, joint in _JOINTS.items():
        part = translation(np.array(joint)) @ turn(np.array([_SWINGS[name] * swing]), 1)[0]
        local = part @ translation(-np.array(joint))
        shapes += [replace(shape, T_world_shape=local @ shape.T_world_shape) for shape in figure[name]]
    return shapes


def _figure(number: int, rng: np.random.Generator) -> dict[str, list[Shape]]:
    """Shapes of each part of a person who stands at the origin and looks along x."""
    make = MaterialMaker(rng)
    skin, hair = make.plain((0.80, 0.60, 0.48), 0.05), make.plain((0.22, 0.15, 0.10), 0.12)
    hue = rng.uniform(0.15, 0.75, 3)
    shirt = make.checker((hue[0], hue[1], hue[2]), (0.9 - hue[0], 0.9 - hue[1], 0.9 - hue[2]), 6)
    sleeve, trousers = make.fabric((hue[0], hue[1], hue[2])), make.fabric((0.20, 0.24, 0.34))
    shoe = make.plain((0.16, 0.12, 0.10), 0.1)

    made: dict[str, list[Shape]] = {}
    for name, (_, y, _) in _JOINTS.items():
        builder = SceneBuilder()
        part = builder.instance("person")
        if name == "torso":
            part.box((0, 0, 1.16), (0.22, 0.42, 0.58), shirt)
            part.cylinder((0, 0, 1.48), 0.055, 0.12, skin)
            part.ellipsoid((0, 0, 1.63), (0.10, 0.085, 0.125), skin)
            part.ellipsoid((-0.018, 0, 1.66), (0.10, 0.09, 0.12), hair)
        elif name.endswith("leg"):
            part.cylinder((0, y, 0.47), 0.07, 0.82, trousers, top=1.2)
            part.box((0.05, y, 0.04), (0.26, 0.09, 0.08), shoe)
        else:
            part.cylinder((0, y, 1.13), 0.045, 0.56, sleeve, top=1.2)
            part.ellipsoid((0, y, 0.82), (0.045, 0.035, 0.07), skin)
        made[name] = [replace(shape, instance=number, casts_shadow=False) for shape in builder.scene.shapes]
    return made


def _find_way(setting: Setting, rng: np.random.Generator) -> _Way:
    free, corner = _free_floor(setting)
    places = np.argwhere(free) * WalkerTuning.cell_m + corner
    if not len(places):
        raise SequenceError("movers: nowhere is there room for a person")
    times, best, most = setting.views.frames, None, 0.0
    for _ in range(WalkerTuning.tries):
        first = rng.uniform(0.12, 0.45)
        last = min(0.9, first + rng.uniform(0.4, 0.65))
        longest = np.clip(
            WalkerTuning.max_step_m * (last - first) * setting.frames, WalkerTuning.min_way_m, WalkerTuning.max_way_m
        )
        a, b, c = places[rng.integers(len(places), size=3)]
        if not 0.7 * longest < np.linalg.norm(c - a) < longest:
            continue
        progress = progress_between(setting.frames, first, last)
        way = _bend(a, (a + b + c) / 3, c, progress)
        cells = np.rint((way.at - corner) / WalkerTuning.cell_m).astype(int)
        if not free[cells[:, 0], cells[:, 1]].all():
            continue
        if np.linalg.norm(way.at - setting.views.poses[:, :2, 3], axis=1).min() < WalkerTuning.from_camera_m:
            continue
        seen, under_way = _shares_seen(setting, way), (progress[times] > 0) & (progress[times] < 1)
        score = float(seen[under_way].mean()) - 0.15 * float(seen[0] + seen[-1])
        if score > most:
            best, most = way, score
        if most >= WalkerTuning.enough:
            break
    if best is None:
        raise SequenceError("movers: there is no way for a person through what the camera sees")
    return best


def _bend(a: np.ndarray, b: np.ndarray, c: np.ndarray, progress: np.ndarray) -> _Way:
    """From a to c, bent towards b, at an even pace but for start and stop."""
    t = np.linspace(0, 1, 200)[:, None]
    curve = (1 - t) ** 2 * a + 2 * t * (1 - t) * b + t**2 * c
    length = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(curve, axis=0), axis=1))])
    walked = progress * length[-1]
    u = np.interp(walked, length, t[:, 0])[:, None]
    at = (1 - u) ** 2 * a + 2 * u * (1 - u) * b + u**2 * c
    ahead = (1 - u) * (b - a) + u * (c - b)
    return _Way(at, np.arctan2(ahead[:, 1], ahead[:, 0]), walked)


def _shares_seen(setting: Setting, way: _Way) -> np.ndarray:
    """Of a person on a way, the share that is seen in each of the views."""
    heights = np.array([0.3, 0.7, 1.1, 1.5])
    shares = []
    for i, frame in enumerate(setting.views.frames):
        points = np.column_stack([np.tile(way.at[frame], (len(heights), 1)), heights])
        shares.append(setting.views.sees(points, i).mean())
    return np.array(shares)


def _free_floor(setting: Setting) -> tuple[np.ndarray, np.ndarray]:
    """Where a person can stand, bool [x, y], and the middle of its first cell."""
    scene: Scene = setting.scene
    low, high = np.array(scene.bounds)
    x, y = (
        np.arange(low[k] + WalkerTuning.radius_m + 0.05, high[k] - WalkerTuning.radius_m - 0.05, WalkerTuning.cell_m)
        for k in (0, 1)
    )
    grid = np.stack(np.meshgrid(x, y, np.arange(0.1, WalkerTuning.height_m, 0.2), indexing="ij"), -1).reshape(-1, 3)
    obstacles = [shape for shape in scene.shapes if _is_in_the_way(shape)]
    for mover in setting.movers:
        known = [*scene.shapes, *setting.shapes]
        for number, track in zip(mover.numbers, mover.tracks.swapaxes(0, 1), strict=True):
            steps = np.unique(track.reshape(-1, 16), axis=0).reshape(-1, 4, 4)[::4]
            obstacles.extend(replace(known[number], T_world_shape=T) for T in steps)
    nearest = np.full(len(grid), np.inf)
    for shape in obstacles:
        np.minimum(nearest, shape.distance(grid), out=nearest)
    free = nearest.reshape(len(x), len(y), -1).min(2) > WalkerTuning.radius_m
    return free, np.array([x[0], y[0]])


def _is_in_the_way(shape: Shape) -> bool:
    """Whether anybody runs into it: rugs and lamps at the ceiling they do not."""
    reach = np.abs(shape.T_world_shape[2, :3]) @ shape.bounds()
    middle = shape.T_world_shape[2, 3]
    return bool(middle + reach > 0.05 and middle - reach < WalkerTuning.height_m)
