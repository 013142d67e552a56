# SPDX-License-Identifier: Apache-2.0
"""Straight lanes through the rooms and corridors of a generated world, and what gets into a robot's way on them.

Everything is in the lane's frame: x along the lane, y to its left, z up from the floor, metres; the robot's centre
moves along y = 0. The world is that of the tests (tests/worlds), made of upright boxes, so that depth images of it and
the place where a disc touches something are exact.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from worlds.world import World, cast_rays

from ggslam.scene.camera import Camera
from ggslam.synthetic.materials import Material
from ggslam.synthetic.raycast import RayCaster
from ggslam.synthetic.scene import Kind, Scene, Shape
from ggslam.synthetic.sensor import noisy_depth
from ggslam.system.tuning import Tuning

MATERIAL = Material(np.full((8, 8, 3), 0.5, np.float32))
"""Of everything: only depth is rendered."""


class LaneTuning(Tuning):
    """Which lanes are taken."""

    around = 9.0
    """Metres about a lane's start that its scene reaches."""
    clear = 0.25
    """Metres that stay free on either side of the robot, so that walls along the way are none of its business."""
    corridor_width = 2.6
    """Metres: what is narrower between its walls is a corridor."""
    look_height = 2.5
    """Metres above the floor at which the width is looked up, above furniture and below beams."""
    tries = 20000
    """Random places that are tried."""


@dataclass(frozen=True)
class Solid:
    """An upright thing.

    Attributes:
        x, y: centre.
        half: half extents along its own axes (x, y); of a cylinder, its radius twice.
        low, high: heights.
        angle: radians by which its axes are turned.
        round: whether it is a cylinder.
    """

    x: float
    y: float
    half: tuple[float, float]
    low: float
    high: float
    angle: float = 0.0
    round: bool = False

    def shape(self) -> Shape:
        """For the ray caster."""
        T = np.eye(4)
        c, s = np.cos(self.angle), np.sin(self.angle)
        T[:2, :2], T[:3, 3] = [[c, -s], [s, c]], (self.x, self.y, (self.low + self.high) / 2)
        kind = Kind.FRUSTUM if self.round else Kind.BOX
        return Shape(kind, (*self.half, (self.high - self.low) / 2), T, MATERIAL, 1)

    def contact(self, radius: float) -> float:
        """The x at which a disc that comes along y = 0 first touches it; infinite if it does not."""
        if self.round:
            return _circle_entry(self.x, self.y, radius + self.half[0])
        c, s = np.cos(self.angle), np.sin(self.angle)
        # The path in the box's axes; the places of a disc that touches a box are the box with rounded corners.
        start = np.array([-c * self.x - s * self.y, s * self.x - c * self.y])
        along, (hx, hy) = np.array([c, -s]), self.half
        entries = [_slab_entry(start, along, (hx + radius, hy)), _slab_entry(start, along, (hx, hy + radius))]
        for corner in ((hx, hy), (hx, -hy), (-hx, hy), (-hx, -hy)):
            entries.append(_circle_entry(*_turn(corner, self), radius))
        return min(entries)


def _turn(corner: tuple[float, float], solid: Solid) -> tuple[float, float]:
    c, s = np.cos(solid.angle), np.sin(solid.angle)
    return solid.x + c * corner[0] - s * corner[1], solid.y + s * corner[0] + c * corner[1]


def _circle_entry(x: float, y: float, radius: float) -> float:
    return float(x - np.sqrt(radius**2 - y**2)) if abs(y) < radius else np.inf


def _slab_entry(start: np.ndarray, along: np.ndarray, half: tuple[float, float]) -> float:
    enter, leave = -np.inf, np.inf
    for a in (0, 1):
        if abs(along[a]) < 1e-12:
            if abs(start[a]) >= half[a]:
                return np.inf
            continue
        ends = sorted(((-half[a] - start[a]) / along[a], (half[a] - start[a]) / along[a]))
        enter, leave = max(enter, ends[0]), min(leave, ends[1])
    return enter if enter < leave else np.inf


@dataclass(frozen=True)
class Lane:
    """A straight way that is free for a while.

    Attributes:
        place: "corridor" or "room".
        solids: what stands around it, floor and ceiling left out.
        height: of the ceiling.
        end: x of the robot's centre when it touches what the lane ends at, from its start at 0.
    """

    place: str
    solids: tuple[Solid, ...]
    height: float
    end: float

    def contact(self, radius: float, heights: tuple[float, float]) -> float:
        """The x at which a disc that comes along y = 0 first touches what stands along the lane at its heights."""
        low = [s for s in self.solids if s.low < heights[1] and s.high > heights[0]]
        return min((x for s in low if (x := s.contact(radius)) > 0), default=np.inf)

    def scene(self) -> Scene:
        """The lane without obstacles."""
        wide = 2 * LaneTuning.around + 10
        ground = [Solid(0, 0, (wide, wide), z - 0.05, z + 0.05) for z in (-0.05, self.height + 0.05)]
        return Scene(shapes=[solid.shape() for solid in (*ground, *self.solids)], instance_names={1: "thing"})


def find_lanes(
    world: World, count: int, radius: float, heights: tuple[float, float], length: tuple[float, float], seed: int
) -> list[Lane]:
    """Lanes at random places, every other one in a corridor.

    Args:
        world: with rooms and corridors.
        count: of the lanes.
        radius: of the robot.
        heights: between which it can touch things.
        length: shortest and longest way from a lane's start to its end.
        seed: of the places.
    """
    rng = np.random.default_rng([seed, 53])
    lanes: list[Lane] = []
    for _ in range(LaneTuning.tries):
        if len(lanes) == count:
            return lanes
        wanted = ("corridor", "room")[len(lanes) % 2]
        at = rng.uniform(1, world.size - 1, 2)
        yaw = rng.integers(4) * np.pi / 2 if wanted == "corridor" else rng.uniform(0, 2 * np.pi)
        if _place(world, at, yaw) != wanted:
            continue
        solids = _around(world, at, yaw)
        low = [s for s in solids if s.low < heights[1] and s.high > heights[0]]
        if any(s.contact(radius + LaneTuning.clear) < length[0] - 1e-9 and _reaches(s, radius) for s in low):
            continue
        end = min((c for s in low if (c := s.contact(radius)) > 0), default=np.inf)
        if length[0] <= end <= length[1]:
            lanes.append(Lane(wanted, solids, world.height, end))
    raise RuntimeError(f"{len(lanes)} of {count} lanes found")


def _reaches(solid: Solid, radius: float) -> bool:
    """Whether a solid reaches beyond the back of a robot at x = 0."""
    reach = np.hypot(*solid.half)
    return solid.x + reach > -radius


def _place(world: World, at: np.ndarray, yaw: float) -> str:
    """Whether a place is in a corridor along `yaw` or elsewhere, in nothing."""
    if world.inside(np.array([[*at, z] for z in (0.1, 0.3, LaneTuning.look_height)])).any():
        return "wall"
    across = np.array([[-np.sin(yaw), np.cos(yaw), 0.0], [np.sin(yaw), -np.cos(yaw), 0.0]])
    origin = np.array([*at, LaneTuning.look_height])
    width = cast_rays(world, np.tile(origin, (2, 1)), across, 20.0).distance.sum()
    return "corridor" if width < LaneTuning.corridor_width else "room"


def _around(world: World, at: np.ndarray, yaw: float) -> tuple[Solid, ...]:
    near = np.linalg.norm(world.boxes[:, :2] - at, axis=1) - np.hypot(*world.boxes[:, 3:5].T) < LaneTuning.around
    c, s = np.cos(yaw), np.sin(yaw)
    found = []
    for x, y, z, hx, hy, hz, angle in world.boxes[near]:
        dx, dy = x - at[0], y - at[1]
        found.append(Solid(c * dx + s * dy, c * dy - s * dx, (hx, hy), z - hz, z + hz, angle - yaw))
    return tuple(found)


class LaneCaster:
    """Depth images along a lane, with one obstacle or none.

    Args:
        lane: where.
        camera: of the images.
        height: of the camera above the floor.
        obstacle: besides what stands along the lane.
        noise: seed of the noise of a structured-light camera; None: depth is exact.
    """

    def __init__(
        self, lane: Lane, camera: Camera, height: float, obstacle: Solid | None = None, noise: int | None = None
    ) -> None:
        self.camera, self.height = camera, height
        self._rng = None if noise is None else np.random.default_rng([noise, 56])
        self._caster = RayCaster(lane.scene(), further=[] if obstacle is None else [obstacle.shape()])

    def pose(self, x: float) -> np.ndarray:
        """T_lane_camera [4, 4] when the robot's centre is at x: looks along the lane, level."""
        T = np.eye(4)
        T[:3, :3], T[:3, 3] = np.array([[0, 0, 1], [-1, 0, 0], [0, -1, 0]]), (x, 0.0, self.height)
        return T

    def depth(self, x: float) -> np.ndarray:
        """Depth [H, W] in metres; +inf where there is nothing, 0 where a noisy camera measures nothing."""
        depth, _ = self._caster.measure(self.camera, self.pose(x))
        if self._rng is not None:
            return noisy_depth(depth, self.camera, self._rng)
        return np.where(depth > 0, depth, np.float32(np.inf))
