# SPDX-License-Identifier: Apache-2.0
"""Camera paths through a scene, smooth but with the small unrest of a hand."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from scipy.interpolate import CubicSpline
from scipy.ndimage import gaussian_filter1d

from ggslam.errors import SequenceError
from ggslam.synthetic.scene import Scene
from ggslam.system.tuning import Tuning

TRAJECTORIES = ("loop", "round", "pan", "route", "walk", "turns", "still")


class PathTuning(Tuning):
    """How fast and how near the camera moves."""

    max_step_m = 0.045
    """Longest way between frames, in metres; short recordings see less of the scene."""
    max_turn_deg = 1.9
    """Largest rotation between frames, in degrees."""
    peak_turn_deg = 4.7
    """Largest rotation between frames of "turns", in degrees."""
    turn_frames = 88
    """Frames of "turns" from one side to the other and back."""
    clearance_m = 0.18
    """Smallest distance from every shape, in metres."""
    route_clearance_m = 0.3
    """The same on a route through several rooms."""
    route_step_m = 0.075
    """Way between frames of a route that weighs as much as `route_turn_deg`, in metres."""
    route_turn_deg = 2.5
    """Rotation between frames of a route that weighs as much as `route_step_m`, in degrees."""
    seen_again = 0.14
    """Share of a route's circuit, from its start, that is gone a second time."""


def camera_path(scene: Scene, frames: int, trajectory: str = "loop", seed: int = 0) -> np.ndarray:
    """Poses T_world_camera, float64 [frames, 4, 4].

    Args:
        scene: gives the ellipse to walk and the points to look at.
        frames: how many.
        trajectory: "loop": once around the ellipse, the view swinging over the points nearest to the first and back, so
            that the end meets the beginning; "round": around the ellipse while the view passes over all the points;
            "pan": turning on the spot; "turns": from side to side, slow at either end and fast between, while walking;
            "still": as a camera on a tripod; "route": along the scene's route, past its beginning for `seen_again` of
            it; "walk": along the scene's route from its beginning, as far as one gets at the usual pace.
        seed: of the unrest.

    Raises:
        SequenceError: unknown trajectory, fewer than 2 frames, or no way around the furniture.
    """
    if trajectory not in TRAJECTORIES:
        raise SequenceError(f"trajectory: expected one of {', '.join(TRAJECTORIES)}, found '{trajectory}'")
    if frames < 2:
        raise SequenceError(f"frames: expected at least 2, found {frames}")
    if trajectory == "still":
        return np.repeat(_path(scene, frames, "pan", seed, 1.0)[:1], frames, 0)
    if trajectory in ("route", "walk"):
        return _route(scene, frames, seed, closed=trajectory == "route")
    for size in (1.0, 0.7, 0.45, 0.25, 0.1):
        poses = _path(scene, frames, trajectory, seed, size)
        if _is_clear(scene, poses[:, :3, 3], PathTuning.clearance_m):
            return poses
    raise SequenceError("the scene leaves the camera no free way: every path comes too near to something")


def _path(scene: Scene, frames: int, trajectory: str, seed: int, size: float) -> np.ndarray:
    (cx, cy, cz), radii = scene.walk
    phase = np.arange(frames) / frames  # 0 to nearly 1: the frame after the last would be the first again
    length = 2 * np.pi * size * max(radii)
    shrink = 0.0 if trajectory == "pan" else size * min(1.0, PathTuning.max_step_m * frames / max(length, 1e-9))
    around = 2 * np.pi * phase + 0.75 * np.pi
    unrest = _unrest(frames, seed)
    position = np.stack(
        [
            cx + shrink * radii[0] * np.cos(around),
            cy - shrink * radii[1] * np.sin(around),
            cz + 0.10 * shrink * np.sin(2 * around),
        ],
        1,
    )
    position += 0.012 * unrest[:, :3]
    first = np.arctan2(*(scene.interest[0] - (cx, cy, cz))[1::-1])
    turn_limit = np.radians(PathTuning.max_turn_deg) * frames
    if trajectory == "turns":
        heading = first + _swings(frames)
    elif trajectory == "loop":
        swing = min(np.radians(32), turn_limit / (2 * np.pi) * 0.8)
        heading = first + swing * np.sin(2 * np.pi * phase)
    else:
        heading = first + min(2 * np.pi, turn_limit * 0.8) * phase
    pitch = np.radians(-17 + 4 * np.cos(2 * np.pi * phase))
    poses = np.empty((frames, 4, 4))
    for i in range(frames):
        angle, tilt = heading[i] + 0.012 * unrest[i, 3], pitch[i] + 0.010 * unrest[i, 4]
        forward = np.array([np.cos(angle) * np.cos(tilt), np.sin(angle) * np.cos(tilt), np.sin(tilt)])
        poses[i] = _look_along(position[i], forward, 0.012 * unrest[i, 5])
    return poses


def _swings(frames: int) -> np.ndarray:
    """Headings of "turns" against the first, radians [frames]: the pace goes with the fourth power of a sine."""
    sine = np.sin(2 * np.pi * (np.arange(frames) - 0.5) / PathTuning.turn_frames)
    turned = np.cumsum(np.radians(PathTuning.peak_turn_deg) * np.sign(sine) * sine**4)
    return turned - turned.max() / 2


def _look_along(position: np.ndarray, forward: np.ndarray, roll: float) -> np.ndarray:
    """Pose of a camera at `position` with its z axis along `forward`, turned about it by `roll` radians."""
    right = np.cross(forward, (0.0, 0.0, 1.0))
    right /= np.linalg.norm(right)
    down = np.cross(forward, right)
    T = np.eye(4)
    T[:3, 0] = np.cos(roll) * right + np.sin(roll) * down
    T[:3, 1] = np.cos(roll) * down - np.sin(roll) * right
    T[:3, 2], T[:3, 3] = forward, position
    return T


def _unrest(frames: int, seed: int) -> np.ndarray:
    """Smooth periodic noise [frames, 6] of deviation about 1: a few slow sines for each degree of freedom."""
    rng = np.random.default_rng([seed, 3])
    cycles = np.arange(1, max(2, round(frames / 25)) + 1)
    phase = 2 * np.pi * np.arange(frames)[:, None] / frames
    values = np.zeros((frames, 6))
    for k in range(6):
        amplitude = rng.standard_normal(len(cycles)) / np.sqrt(len(cycles))
        values[:, k] = (amplitude * np.sin(cycles * phase + rng.uniform(0, 2 * np.pi, len(cycles)))).sum(1)
    return values


def _is_clear(scene: Scene, positions: np.ndarray, clearance: float) -> bool:
    return all(shape.distance(positions).min() >= clearance for shape in scene.shapes)


def _route(scene: Scene, frames: int, seed: int, closed: bool) -> np.ndarray:
    """Poses [frames, 4, 4] along the route of the scene, at an even pace."""
    if len(scene.route) < 3:
        raise SequenceError("the scene has no route to follow")
    values = _circuit(scene.route, frames) if closed else _one_way(scene.route, frames)
    unrest = _unrest(frames, seed)
    position = values[:, :3] + 0.015 * unrest[:, :3]
    heading = np.radians(values[:, 3]) + 0.014 * unrest[:, 3]
    tilt = np.radians(values[:, 4]) + 0.012 * unrest[:, 4]
    forward = np.stack([np.cos(heading) * np.cos(tilt), np.sin(heading) * np.cos(tilt), np.sin(tilt)], 1)
    if not _is_clear(scene, position, PathTuning.route_clearance_m):
        raise SequenceError(f"the route leads nearer than {PathTuning.route_clearance_m} m to something")
    return np.stack([_look_along(p, f, 0.012 * u) for p, f, u in zip(position, forward, unrest[:, 5], strict=True)])


def _circuit(route: np.ndarray, frames: int) -> np.ndarray:
    """Rows [frames, 5] of a closed route: all of it and `PathTuning.seen_again` of it again, in so many frames."""
    where, period = _closed_spline(route)
    fine = np.linspace(0, period, 4096)
    spent = _spent(where(fine), 40, "wrap")
    wanted = spent[-1] * (1 + PathTuning.seen_again) * np.arange(frames) / frames
    laps, rest = np.divmod(wanted, spent[-1])
    values = where(np.asarray(np.interp(rest, spent, fine)))
    values[:, 3] += 360 * laps
    return values


def _one_way(route: np.ndarray, frames: int) -> np.ndarray:
    """Rows [frames, 5] from the beginning of an open route, a frame for each `route_step_m` or `route_turn_deg`."""
    at = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(route[:, :3], axis=0), axis=1))])
    spline = CubicSpline(at, route)
    fine = np.arange(0, at[-1], 0.01)
    spent = _spent(spline(fine), 40, "nearest")
    if spent[-1] < frames - 1:
        raise SequenceError(f"the route is too short for {frames} frames")
    return spline(np.interp(np.arange(frames), spent, fine))


def _spent(rows: np.ndarray, smoothing: float, mode: str) -> np.ndarray:
    """Frames spent up to each of the rows [n, 5] at the usual pace, which changes gently: [n]."""
    step = np.diff(rows, axis=0)
    metres, degrees = np.linalg.norm(step[:, :3], axis=1), np.linalg.norm(step[:, 3:], axis=1)
    effort = gaussian_filter1d(
        np.hypot(metres / PathTuning.route_step_m, degrees / PathTuning.route_turn_deg), smoothing, mode=mode
    )
    return np.concatenate([[0.0], np.cumsum(effort)])


def _closed_spline(route: np.ndarray) -> tuple[Callable[[np.ndarray], np.ndarray], float]:
    """A smooth function of a parameter from 0 to its period that gives rows of the route and whole turns of heading in
    between."""
    closed = np.concatenate([route, route[:1]])
    turns = 360 * np.rint((closed[-2, 3] - closed[-1, 3]) / 360)
    closed[-1, 3] += turns
    at = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(closed[:, :3], axis=0), axis=1) ** 0.5)])
    drift = turns * at / at[-1]
    spline = CubicSpline(at, np.column_stack([closed[:, :3], closed[:, 3] - drift, closed[:, 4]]), bc_type="periodic")

    def value(u: np.ndarray) -> np.ndarray:
        rows = spline(u)
        rows[:, 3] += turns * u / at[-1]
        return rows

    return value, float(at[-1])
