# SPDX-License-Identifier: Apache-2.0
"""How fast a robot may drive on a map that is so many milliseconds old.

Until an obstacle that the sensor sees has reached the map and the plan, the robot goes on: it is blind for
t = t_wait + t_sensor + t_map + t_plan + t_network + t_control, over a distance v t. Then it brakes with friction mu:

    d(v) = v t + v^2 / (2 mu g)

The four latencies are those of a frame on its way. The obstacle has to wait besides, at worst until the next frame is
taken (`frame_period`), until a map that holds the place free believes in it (`frames`), and for the next turn of the
controller (`control_period`). These are 0 unless given: without them d is met on average, with them never exceeded
(scripts/benchmarks/bench_safety.py).
"""

from __future__ import annotations

import math
from dataclasses import field
from typing import Final

from ggslam.system.settings import setting, settings_class

GRAVITY: Final = 9.81
"""Gravity of the earth, in metres per second squared."""
FRAMES_UNTIL_OCCUPIED: Final = 2
"""Frames that have to measure points in a voxel until a `TsdfMap` that has seen it free holds it occupied."""


@settings_class(frozen=True)
class Latencies:
    """Times from the light on the sensor to the brake."""

    sensor: float = setting(0.033, 0, 60, "s")
    """Exposure and transfer."""
    map: float = setting(0.0, 0, 60, "s")
    """Until the map knows; measured with frames that show something new."""
    plan: float = setting(0.05, 0, 60, "s")
    """Until the planner has reacted."""
    network: float = setting(0.0, 0, 60, "s")
    """On the way between machines."""
    frame_period: float = setting(0.0, 0, 60, "s")
    """From one frame of the sensor to the next: what appears just after a frame waits for the next."""
    frames: int = setting(1, 1, 1000)
    """Frames that have to show an obstacle until the map has it: `FRAMES_UNTIL_OCCUPIED` where the TSDF has seen the
    place free, 1 where it was not known."""
    control_period: float = setting(0.0, 0, 60, "s")
    """From one command of the controller to the next."""
    map_calm: float = setting(0.0, 0, 60, "s")
    """Time that a frame takes in the map that shows nothing new; 0: as long as `map`."""

    @property
    def wait(self) -> float:
        """Seconds, at worst, from the moment an obstacle can be seen until the frame is taken with which the map has
        it, and until the controller's turn.

        A map that takes longer than the frames' period takes the newest frame as soon as it is done with one. If it
        takes as long with frames that show nothing new, it is busy when an obstacle comes into view."""
        if not self.map > self.frame_period > 0:
            return self.frames * self.frame_period + self.control_period
        calm = self.map_calm or self.map
        busy = calm if calm > self.frame_period else 0.0
        return self.frame_period + busy + (self.frames - 1) * self.map + self.control_period

    @property
    def total(self) -> float:
        """Seconds in all."""
        return self.wait + self.sensor + self.map + self.plan + self.network


@settings_class(frozen=True)
class Braking:
    """A robot that brakes."""

    latencies: Latencies = field(default_factory=Latencies)
    """Before the brake works."""
    friction: float = setting(0.5, 0.01, 2)
    """Coefficient mu between wheels and ground."""
    braked_share: float = setting(1.0, 0.01, 1)
    """Share of the weight that rests on braked wheels: less than 1 with a load on castors or on a trailer."""
    margin: float = setting(0.0, 0, 100, "m")
    """Distance that is kept for what the map may place too far away, and for standing clear."""

    @property
    def deceleration(self) -> float:
        """Metres per second squared; masses cancel."""
        return self.friction * self.braked_share * GRAVITY

    def blind_distance(self, speed: float) -> float:
        """Metres driven before the brake works, at `speed` in m/s."""
        return speed * self.latencies.total

    def stopping_distance(self, speed: float) -> float:
        """Metres needed from the moment an obstacle can be seen until standing still, at `speed` in m/s."""
        return self.margin + self.blind_distance(speed) + speed**2 / (2 * self.deceleration)

    def largest_speed(self, distance: float) -> float:
        """Speed in m/s from which the robot stops within `distance` metres."""
        slowed = self.deceleration * self.latencies.total
        return math.sqrt(slowed**2 + 2 * self.deceleration * max(0.0, distance - self.margin)) - slowed
