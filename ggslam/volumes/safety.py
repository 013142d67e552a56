# SPDX-License-Identifier: Apache-2.0
"""How fast a robot may drive on a map that is so many milliseconds old.

Until an obstacle that the sensor sees has reached the map and the plan, the robot goes on: it is blind for
t = t_sensor + t_map + t_plan + t_network, over a distance v t. Then it brakes with friction mu:

    d(v) = v t + v^2 / (2 mu g)
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field

from ggslam.errors import check_ranges

GRAVITY = 9.81
"""Metres per second squared."""


@dataclass(frozen=True)
class Latencies:
    """Seconds from the light on the sensor to the brake.

    Attributes:
        sensor: exposure and transfer.
        map: until the map knows; measured.
        plan: until the planner has reacted.
        network: on the way between machines.
    """

    sensor: float = 0.033
    map: float = 0.0
    plan: float = 0.05
    network: float = 0.0

    def __post_init__(self) -> None:
        check_ranges(self, dict.fromkeys(("sensor", "map", "plan", "network"), (0.0, 60.0)))

    @property
    def total(self) -> float:
        """Seconds in all."""
        return self.sensor + self.map + self.plan + self.network


@dataclass(frozen=True)
class Braking:
    """A robot that brakes.

    Attributes:
        latencies: before the brake works.
        friction: coefficient mu between wheels and ground.
    """

    latencies: Latencies = field(default_factory=Latencies)
    friction: float = 0.5

    def __post_init__(self) -> None:
        check_ranges(self, {"friction": (0.01, 2.0)})

    def blind_distance(self, speed: float) -> float:
        """Metres driven before the brake works, at `speed` in m/s."""
        return speed * self.latencies.total

    def stopping_distance(self, speed: float) -> float:
        """Metres driven from the moment an obstacle can be seen until standing still, at `speed` in m/s."""
        return self.blind_distance(speed) + speed**2 / (2 * self.friction * GRAVITY)

    def largest_speed(self, distance: float) -> float:
        """Speed in m/s from which the robot stops within `distance` metres."""
        slowed = self.friction * GRAVITY * self.latencies.total
        return math.sqrt(slowed**2 + 2 * self.friction * GRAVITY * distance) - slowed
