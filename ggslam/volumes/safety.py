# SPDX-License-Identifier: Apache-2.0
"""How fast a robot may drive on a map that is so many milliseconds old.

Until an obstacle that the sensor sees has reached the map and the plan, the robot goes on: it is blind for
t = t_sensor + t_map + t_plan + t_network, over a distance v t. Then it brakes with friction mu:

    d(v) = v t + v^2 / (2 mu g)
"""

from __future__ import annotations

import math
from dataclasses import field
from typing import Final

from ggslam.system.settings import setting, settings_class

GRAVITY: Final = 9.81
"""Gravity of the earth, in metres per second squared."""


@settings_class(frozen=True)
class Latencies:
    """Times from the light on the sensor to the brake."""

    sensor: float = setting(0.033, 0, 60, "s")
    """Exposure and transfer."""
    map: float = setting(0.0, 0, 60, "s")
    """Until the map knows; measured."""
    plan: float = setting(0.05, 0, 60, "s")
    """Until the planner has reacted."""
    network: float = setting(0.0, 0, 60, "s")
    """On the way between machines."""

    @property
    def total(self) -> float:
        """Seconds in all."""
        return self.sensor + self.map + self.plan + self.network


@settings_class(frozen=True)
class Braking:
    """A robot that brakes."""

    latencies: Latencies = field(default_factory=Latencies)
    """Before the brake works."""
    friction: float = setting(0.5, 0.01, 2)
    """Coefficient mu between wheels and ground."""

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
