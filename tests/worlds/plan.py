# SPDX-License-Identifier: Apache-2.0
"""The plan of a generated world: a lattice of corridors, and in each of its blocks one room, two rooms or a hall.

Blocks are about 10 m apart, corridors 2.4 m wide. Every room has two doors or more, so that nobody has to turn back.
Pilasters, cabinets, beams and door frames tell how far one has gone along a corridor. The same seed and size give the
same world; sizes and places vary from block to block, so that no two look alike.
"""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from ggslam.errors import SequenceError
from worlds.world import World, spread

HEIGHT = 3.0
PITCH, CORRIDOR, WALL = 10.0, 2.4, 0.15
"""Metres from corridor to corridor, their width, and the thickness of walls."""
DOOR_WIDTH, DOOR_HEIGHT = 1.1, 2.1
FREE = 0.75
"""Metres that things stay away from the ways."""
_SMALLEST, _LARGEST = 25.0, 1000.0
_JITTER = 0.9
_SPLIT = 0.5
"""Share of the blocks that hold two rooms."""
_ENTRANCE = 0.8
"""Metres from the inner side of a door to the place where one has entered."""
_CORNER = 1.0
"""Metres from a corner to the middle of a door at least."""

SOUTH, NORTH, WEST, EAST = range(4)

Place = tuple[float, float]


def make_world(size: float = 100.0, seed: int = 0) -> World:
    """A world of size x size metres, closed by outer walls.

    Args:
        size: 25 to 1000; 316 has ten times the area of 100.
        seed: of the plan and everything in it.

    Raises:
        SequenceError: impossible size.
    """
    if not _SMALLEST <= size <= _LARGEST:
        raise SequenceError(f"size: expected {_SMALLEST:g} to {_LARGEST:g} m, found {size}")
    rng = np.random.default_rng([seed, 10])
    count = max(2, round((size - CORRIDOR) / PITCH))
    lines = np.linspace(CORRIDOR / 2, size - CORRIDOR / 2, count + 1)[None].repeat(2, 0)
    lines[:, 1:-1] += rng.uniform(-_JITTER, _JITTER, (2, count - 1))
    plan = _Plan(rng)
    _outer_walls(plan, lines, size)
    fronts = _Fronts(lines)
    for row in range(count):
        for column in range(count):
            _block(plan, fronts, lines, column, row)
    fronts.link(plan)
    return World(size, HEIGHT, seed, np.array(plan.boxes), np.array(plan.nodes), np.array(plan.ways, np.int64))


@dataclass
class _Plan:
    """What has been drawn so far."""

    rng: np.random.Generator
    boxes: list[tuple[float, ...]] = field(default_factory=list)
    nodes: list[Place] = field(default_factory=list)
    ways: list[tuple[int, int]] = field(default_factory=list)

    def node(self, place: Place) -> int:
        """A new node's number."""
        self.nodes.append(place)
        return len(self.nodes) - 1

    def path(self, *nodes: int) -> None:
        """Ways from each node to the next."""
        self.ways.extend(zip(nodes[:-1], nodes[1:], strict=True))

    def sampled_ways(self, first: int) -> np.ndarray:
        """Places [n, 2] along the ways from number `first` on, 0.2 m apart or less."""
        ends = np.array([[self.nodes[one], self.nodes[other]] for one, other in self.ways[first:]])
        steps = np.maximum(np.ceil(np.linalg.norm(ends[:, 1] - ends[:, 0], axis=1) / 0.2), 1).astype(np.int64) + 1
        way, index = spread(steps)
        share = (index / (steps[way] - 1))[:, None]
        return ends[way, 0] * (1 - share) + ends[way, 1] * share

    def box(self, at: Place, size: Place, low: float, high: float, angle: float = 0.0) -> None:
        """A box of full size (x, y) from height `low` to `high`, turned by `angle` radians."""
        self.boxes.append((*at, (low + high) / 2, size[0] / 2, size[1] / 2, (high - low) / 2, angle))


@dataclass
class _Side:
    """A straight wall seen from within a room: from `start` along `along` for `length` metres; `out` points out of the
    room. Doors are centred at metres along it."""

    start: np.ndarray
    along: np.ndarray
    out: np.ndarray
    length: float
    doors: list[float] = field(default_factory=list)

    def at(self, along: float, out: float) -> Place:
        """The place so many metres along the inner face and beyond it."""
        x, y = self.start + along * self.along + out * self.out
        return float(x), float(y)

    def extent(self, along: float, across: float) -> Place:
        """The size (x, y) of what measures so much along the wall and across it."""
        return (along, across) if abs(self.along[0]) > 0.5 else (across, along)

    def door_place(self, rng: np.random.Generator) -> float:
        """Metres along the wall at which a door leaves room for corners."""
        return float(rng.uniform(_CORNER, self.length - _CORNER))

    def box(self, plan: _Plan, span: Place, across: Place, low: float, high: float) -> None:
        """A box from span[0] to span[1] along the wall and across[0] to across[1] outwards."""
        at = self.at((span[0] + span[1]) / 2, (across[0] + across[1]) / 2)
        plan.box(at, self.extent(span[1] - span[0], across[1] - across[0]), low, high)


class _Room:
    """A room from corner `low` to corner `high` (inside), with a node `hub` in its middle. `inner` is the side that is
    shared with another room, `outer` are those towards corridors."""

    def __init__(self, plan: _Plan, low: np.ndarray, high: np.ndarray, inner: int | None = None) -> None:
        (x0, y0), (x1, y1) = low, high
        east, north, corner = np.array([1.0, 0.0]), np.array([0.0, 1.0]), np.array([x0, y0])
        self.low, self.high, self.inner = low, high, inner
        self.outer = [side for side in (SOUTH, NORTH, WEST, EAST) if side != inner]
        self.sides = (
            _Side(corner, east, -north, x1 - x0), _Side(np.array([x0, y1]), east, north, x1 - x0),
            _Side(corner, north, -east, y1 - y0), _Side(np.array([x1, y0]), north, east, y1 - y0),
        )  # fmt: skip
        self.hub = plan.node((float((x0 + x1) / 2), float((y0 + y1) / 2)))


class _Fronts:
    """Places on the corridors in front of doors, by stretch of corridor: axis it runs along, number of its line and of
    the block it passes."""

    def __init__(self, lines: np.ndarray) -> None:
        self._lines = lines
        self._places: dict[tuple[int, int, int], list[tuple[float, int]]] = {}

    def add(self, plan: _Plan, stretch: tuple[int, int, int], at: float) -> int:
        """The node in front of a door, at coordinate `at` along the corridor."""
        axis, line, _ = stretch
        across = float(self._lines[1 - axis, line])
        node = plan.node((at, across) if axis == 0 else (across, at))
        self._places.setdefault(stretch, []).append((at, node))
        return node

    def link(self, plan: _Plan) -> None:
        """Crossings, and ways along the corridors."""
        count = self._lines.shape[1]
        crossing = {
            (i, j): plan.node((float(self._lines[0, i]), float(self._lines[1, j])))
            for j in range(count)
            for i in range(count)
        }
        for axis in range(2):
            for line in range(count):
                for block in range(count - 1):
                    ends = [(block + k, line) if axis == 0 else (line, block + k) for k in range(2)]
                    between = [node for _, node in sorted(self._places.get((axis, line, block), []))]
                    plan.path(crossing[ends[0]], *between, crossing[ends[1]])


def _outer_walls(plan: _Plan, lines: np.ndarray, size: float) -> None:
    edges = [np.concatenate([[-WALL], axis[1:-1], [size + WALL]]) for axis in lines]
    for across in (-WALL / 2, size + WALL / 2):
        for axis in range(2):
            for low, high in zip(edges[axis][:-1], edges[axis][1:], strict=True):
                middle, length = (low + high) / 2, high - low
                at, extent = ((middle, across), (length, WALL)) if axis == 0 else ((across, middle), (WALL, length))
                plan.box(at, extent, 0.0, HEIGHT)


def _block(plan: _Plan, fronts: _Fronts, lines: np.ndarray, column: int, row: int) -> None:
    """The rooms between four corridors, and what stands in the corridors along their walls."""
    inset, first, rng = CORRIDOR / 2 + WALL, len(plan.ways), plan.rng
    low = np.array([lines[0, column], lines[1, row]]) + inset
    high = np.array([lines[0, column + 1], lines[1, row + 1]]) - inset
    stretches = ((0, row, column), (0, row + 1, column), (1, column, row), (1, column + 1, row))
    rooms = [_Room(plan, low, high)]
    if rng.random() < _SPLIT:
        axis = int(rng.integers(2))
        cut = low[axis] + (high - low)[axis] * rng.uniform(0.42, 0.58)
        end, begin = high.copy(), low.copy()
        end[axis], begin[axis] = cut - WALL / 2, cut + WALL / 2
        rooms = [_Room(plan, low, end, (EAST, NORTH)[axis]), _Room(plan, begin, high, (WEST, SOUTH)[axis])]
        _connect(plan, *rooms)
    for room in rooms:
        doors = 1 if room.inner is not None else int(rng.integers(2, 4))
        for side in rng.permutation(room.outer)[:doors]:
            wall = room.sides[side]
            at = wall.door_place(rng)
            wall.doors.append(at)
            axis = stretches[side][0]
            front = fronts.add(plan, stretches[side], wall.at(at, 0.0)[axis])
            plan.path(front, plan.node(wall.at(at, -_ENTRANCE)), room.hub)
    ways = plan.sampled_ways(first)
    for room in rooms:
        for side in range(4):
            if side != room.inner or room is rooms[0]:  # a wall between rooms is drawn once
                _wall(plan, room.sides[side], WALL)
        _furnish(plan, room, ways)
        for side in room.outer:
            _line_corridor(plan, room.sides[side], ways, beam=side in (SOUTH, WEST))


def _connect(plan: _Plan, one: _Room, other: _Room) -> None:
    """A door in the wall between two rooms."""
    assert one.inner is not None and other.inner is not None
    walls = one.sides[one.inner], other.sides[other.inner]
    at = walls[0].door_place(plan.rng)
    for wall in walls:
        wall.doors.append(at)
    plan.path(one.hub, *(plan.node(wall.at(at, -_ENTRANCE)) for wall in walls), other.hub)


def _wall(plan: _Plan, side: _Side, thickness: float) -> None:
    """A wall with openings, lintels and the jambs of its doors, which stand out on both sides."""
    edges = [-thickness]
    for door in sorted(side.doors):
        left, right = door - DOOR_WIDTH / 2, door + DOOR_WIDTH / 2
        edges += [left, right]
        side.box(plan, (left, right), (0.0, thickness), DOOR_HEIGHT, HEIGHT)
        for span in ((left - 0.08, left), (right, right + 0.08)):
            side.box(plan, span, (-0.05, thickness + 0.05), 0.0, DOOR_HEIGHT)
    edges.append(side.length + thickness)
    for left, right in zip(edges[::2], edges[1::2], strict=True):
        side.box(plan, (left, right), (0.0, thickness), 0.0, HEIGHT)


def _furnish(plan: _Plan, room: _Room, ways: np.ndarray) -> None:
    """Cabinets and shelves along the walls; tables, crates and pillars in between."""
    rng = plan.rng
    for side in room.sides:
        for _ in range(int(side.length / 1.5)):
            width, depth, height = rng.uniform((0.5, 0.3, 0.4), (min(1.7, 0.6 * side.length), 0.6, 2.3))
            at = rng.uniform(width / 2, side.length - width / 2)
            if _is_free(side.at(at, -depth / 2), side.extent(width, depth), 0.0, ways):
                side.box(plan, (at - width / 2, at + width / 2), (-depth, 0.0), 0.0, height)
    for _ in range(int(np.prod(room.high - room.low) / 6)):
        at = rng.uniform(room.low + 0.6, room.high - 0.6)
        width, depth = rng.uniform((0.35, 0.35), (1.6, 0.9))
        angle, kind = rng.uniform(0, np.pi), rng.random()
        place = (float(at[0]), float(at[1]))
        if kind < 0.3:
            width = depth = 0.4
        if not _is_free(place, (width, depth), angle, ways):
            continue
        if kind < 0.3:
            plan.box(place, (width, depth), 0.0, HEIGHT, angle)
        elif kind < 0.75:
            plan.box(place, (width, depth), 0.68, 0.75, angle)
            plan.box(place, (0.3 * width, 0.3 * depth), 0.0, 0.68, angle)
        else:
            plan.box(place, (width, depth), 0.0, float(rng.uniform(0.4, 1.4)), angle)


def _line_corridor(plan: _Plan, side: _Side, ways: np.ndarray, beam: bool) -> None:
    """Pilasters and cabinets before the outer face of a room's wall, a beam across the corridor."""
    rng = plan.rng
    for _ in range(int(side.length / 1.4)):
        pilaster = rng.random() < 0.55
        width = rng.uniform(0.25, 0.6) if pilaster else rng.uniform(0.5, 1.3)
        depth = rng.uniform(0.1, 0.25) if pilaster else rng.uniform(0.25, CORRIDOR / 2 - FREE - 0.02)
        height = HEIGHT if pilaster else rng.uniform(0.7, 2.1)
        at = rng.uniform(width / 2, side.length - width / 2)
        if _is_free(side.at(at, WALL + depth / 2), side.extent(width, depth), 0.0, ways):
            side.box(plan, (at - width / 2, at + width / 2), (WALL, WALL + depth), 0.0, height)
    if beam:
        at = rng.uniform(0.3, side.length - 0.3)
        side.box(plan, (at - 0.12, at + 0.12), (WALL, WALL + CORRIDOR), HEIGHT - rng.uniform(0.15, 0.4), HEIGHT)


def _is_free(at: Place, size: Place, angle: float, ways: np.ndarray) -> bool:
    """Whether a rectangle of full size (x, y), turned by `angle`, stays away from sampled ways [n, 2]."""
    x, y = (ways - at).T
    cosine, sine = np.cos(angle), np.sin(angle)
    beside = np.maximum(np.abs(cosine * x + sine * y) - size[0] / 2, 0)
    before = np.maximum(np.abs(cosine * y - sine * x) - size[1] / 2, 0)
    return bool((np.hypot(beside, before) >= FREE).all())
