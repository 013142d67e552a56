# SPDX-License-Identifier: Apache-2.0
"""Worlds that are hard or uneven: halls between rooms, equal rooms side by side, things moved since a map was made."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from worlds.plan import HEIGHT, WALL, make_world
from worlds.world import World

HALL_PITCH, HALL = 50.0, 30.0
"""Metres from hall to hall, and their edge."""
ROOM_PITCH, ROOM_DOOR = 6.0, 1.4
"""Metres from equal room to equal room, and the width of the openings between them."""
_SMALLEST_MOVE, _LARGEST_MOVE = 0.1, 0.5


def hall_world(size: float, seed: int) -> World:
    """The generated world of rooms and corridors with a hall, empty but for the rooms' pillars, every 50 m."""
    world = make_world(size, seed)
    centres = np.arange(HALL_PITCH / 2, size, HALL_PITCH)
    away = np.abs(world.boxes[:, None, :2] - np.stack(np.meshgrid(centres, centres), -1).reshape(1, -1, 2))
    pillar = (world.boxes[:, 3:5].max(1) < 0.21) & (world.boxes[:, 5] == world.height / 2)
    return replace(world, boxes=world.boxes[pillar | ~(away.max(2) < HALL / 2).any(1)])


def equal_rooms(size: float, seed: int) -> World:
    """Square rooms that are all furnished alike, four pillars, two cabinets and a crate, with an opening in the middle
    of every wall; outer walls around them. The ways lead through the middles. Nothing but the outer walls tells one
    room from another."""
    count = max(2, int(size // ROOM_PITCH))
    rng = np.random.default_rng([seed, 12])
    things = _furniture(rng)
    boxes, nodes, ways = [], [], []
    for row in range(count):
        for column in range(count):
            middle = (np.array([column, row]) + 0.5) * ROOM_PITCH
            boxes += [(*(middle + thing[:2]), *thing[2:]) for thing in things]
            boxes += _walls(middle)
            nodes.append(middle)
            number = row * count + column
            ways += [(number, number + 1)] if column + 1 < count else []
            ways += [(number, number + count)] if row + 1 < count else []
    edge = count * ROOM_PITCH
    for across in (WALL / 2, edge - WALL / 2):
        boxes.append((edge / 2, across, HEIGHT / 2, edge / 2, WALL / 2, HEIGHT / 2, 0.0))
        boxes.append((across, edge / 2, HEIGHT / 2, WALL / 2, edge / 2, HEIGHT / 2, 0.0))
    return World(edge, HEIGHT, seed, np.array(boxes, float), np.array(nodes), np.array(ways, np.int64))


def changed(world: World, share: float, seed: int) -> World:
    """The world with this share of what stands about, nothing longer than 2 m, moved by 0.1 to 0.5 m or carried
    away."""
    rng = np.random.default_rng([seed, 13])
    loose = (world.boxes[:, 3:5].max(1) < 1.0) & (world.boxes[:, 2] - world.boxes[:, 5] < 0.05)
    chosen = loose & (rng.random(len(loose)) < share)
    boxes, angle = world.boxes.copy(), rng.uniform(0, 2 * np.pi, len(loose))
    distance = rng.uniform(_SMALLEST_MOVE, _LARGEST_MOVE, len(loose))
    boxes[chosen, :2] += (distance[:, None] * np.stack([np.cos(angle), np.sin(angle)], 1))[chosen]
    return replace(world, boxes=boxes[~(chosen & (rng.random(len(loose)) < 0.5))])


def _furniture(rng: np.random.Generator) -> list[tuple[float, ...]]:
    """Of a room about (0, 0): boxes as `World` has them, clear of the cross of its ways."""
    things = []
    for x in (-1, 1):
        for y in (-1, 1):
            at = np.array([x, y]) * rng.uniform(1.4, 2.0, 2)
            things.append((*at, HEIGHT / 2, 0.2, 0.2, HEIGHT / 2, 0.0))
            at = np.array([x * rng.uniform(1.3, 2.0), y * (ROOM_PITCH / 2 - WALL - 0.25)])
            half = (rng.uniform(0.2, 0.5), 0.22, rng.uniform(0.3, 1.0))
            things.append((*at, half[2], *half, 0.0))
    return things


def _walls(middle: np.ndarray) -> list[tuple[float, ...]]:
    """The western and the southern wall of a room about a place [2], with their openings."""
    half, boxes = ROOM_PITCH / 2, []
    length = (ROOM_PITCH - ROOM_DOOR) / 2
    for side in (-1, 1):
        along = side * (ROOM_DOOR + length) / 2
        x, y = middle
        boxes.append((x - half, y + along, HEIGHT / 2, WALL / 2, length / 2, HEIGHT / 2, 0.0))
        boxes.append((x + along, y - half, HEIGHT / 2, length / 2, WALL / 2, HEIGHT / 2, 0.0))
    return boxes
