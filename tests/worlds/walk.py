# SPDX-License-Identifier: Apache-2.0
"""A walk through a generated world: along corridors, through doors and rooms, never turning back."""

from __future__ import annotations

import numpy as np
from scipy.ndimage import gaussian_filter1d

from ggslam.errors import SequenceError
from worlds.world import World

SPEED, RATE = 1.2, 10.0
"""Metres and poses per second."""
SENSOR_HEIGHT = 1.3
_FINE = 0.02
_ROUNDING, _LOOKING = 0.35, 0.6
"""Standard deviations in metres of the way by which corners of the path and changes of heading are smoothed."""
_SHARP = -0.3
"""Cosine of the turn from which a way is taken only where there is no other."""
_STEPS_PER_SECOND = 1.9


def walk(world: World, length: float, seed: int = 0) -> np.ndarray:
    """A tour of `length` metres: poses T_world_sensor, float64 [n, 4, 4], 12 cm and a tenth of a second apart.

    The sensor's x axis points ahead, y to the left, z up. It bobs, rolls and pitches a little with every step. At
    each junction the walk takes the way it has gone least often, so that it comes round.

    Raises:
        SequenceError: shorter than a metre.
    """
    if not length >= 1:
        raise SequenceError(f"length: expected at least 1 m, found {length}")
    rng = np.random.default_rng([world.seed, seed, 11])
    path = _evenly(_round_corners(_tour(world, 1.2 * length + 5, rng)))  # rounded corners are shorter
    tangent = np.gradient(path, axis=0)
    heading = gaussian_filter1d(np.unwrap(np.arctan2(tangent[:, 1], tangent[:, 0])), _LOOKING / _FINE, mode="nearest")
    at = np.arange(int(length * RATE / SPEED)) * (SPEED / RATE / _FINE)
    x, y, turn = (np.interp(at, np.arange(len(path)), values) for values in (path[:, 0], path[:, 1], heading))
    return _poses(np.stack([x, y], 1), turn, rng)


def _tour(world: World, length: float, rng: np.random.Generator) -> np.ndarray:
    """Corners [k, 2] of a path along the ways, at least `length` metres."""
    neighbours: list[list[tuple[int, int]]] = [[] for _ in world.nodes]
    for number, (one, other) in enumerate(world.ways):
        neighbours[one].append((int(other), number))
        neighbours[other].append((int(one), number))
    times = np.zeros(len(world.ways), np.int64)
    node, last, total, ahead = int(rng.integers(len(world.nodes))), -1, 0.0, np.zeros(2)
    while not neighbours[node]:  # the middle of a block that two rooms share is on no way
        node = int(rng.integers(len(world.nodes)))
    corners = [world.nodes[node]]
    while total < length:
        choices = []
        for other, way in neighbours[node]:
            step = world.nodes[other] - corners[-1]
            metres = float(np.linalg.norm(step))
            if way != last:
                sharp = step @ ahead < _SHARP * metres
                choices.append((times[way] + rng.random() + 10 * sharp, other, way, metres))
        _, node, last, metres = min(choices)
        times[last] += 1
        total += metres
        ahead = (world.nodes[node] - corners[-1]) / metres
        corners.append(world.nodes[node])
    return np.array(corners)


def _round_corners(corners: np.ndarray) -> np.ndarray:
    """Places [n, 2] along a path with its corners [k, 2] rounded."""
    return gaussian_filter1d(_evenly(corners), _ROUNDING / _FINE, axis=0, mode="nearest")


def _evenly(path: np.ndarray) -> np.ndarray:
    """Places [n, 2] at even distances along a path [k, 2]."""
    gone = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(path, axis=0), axis=1))])
    at = np.arange(0, gone[-1], _FINE)
    return np.stack([np.interp(at, gone, path[:, k]) for k in range(2)], 1)


def _poses(places: np.ndarray, heading: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """Poses [n, 4, 4] at places [n, 2], with the motion of somebody who walks."""
    count = len(places)
    step = 2 * np.pi * _STEPS_PER_SECOND * np.arange(count) / RATE + rng.uniform(0, 2 * np.pi)
    slow = gaussian_filter1d(rng.standard_normal((count, 4)), 8, axis=0, mode="nearest") * 4  # deviation about 0.75
    height = SENSOR_HEIGHT + 0.02 * np.sin(step) + 0.02 * slow[:, 0]
    roll = np.radians(1.2 * np.sin(step / 2) + 1.0 * slow[:, 1])
    pitch = np.radians(0.8 * np.sin(step + 1) + 1.0 * slow[:, 2])
    yaw = heading + np.radians(1.0 * slow[:, 3])
    poses = np.tile(np.eye(4), (count, 1, 1))
    poses[:, :3, :3] = _rotations(yaw, 2) @ _rotations(pitch, 1) @ _rotations(roll, 0)
    poses[:, :2, 3], poses[:, 2, 3] = places, height
    return poses


def _rotations(angle: np.ndarray, axis: int) -> np.ndarray:
    """Rotations [n, 3, 3] by angles [n] about one of the axes."""
    a, b = (axis + 1) % 3, (axis + 2) % 3
    R = np.zeros((len(angle), 3, 3))
    R[:, axis, axis] = 1
    R[:, a, a] = R[:, b, b] = np.cos(angle)
    R[:, b, a], R[:, a, b] = np.sin(angle), -np.sin(angle)
    return R
