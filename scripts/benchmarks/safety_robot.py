# SPDX-License-Identifier: Apache-2.0
"""A robot that drives straight ahead, brakes on command and stands still: a disc with mass on dry ground."""

from __future__ import annotations

from dataclasses import dataclass

from ggslam.volumes.safety import GRAVITY


@dataclass(frozen=True)
class Robot:
    """The body.

    Attributes:
        radius: of the disc, metres.
        heights: lowest and highest part that can touch something, metres above the floor.
        camera_height: metres above the floor; the camera is at the centre and looks ahead.
        mass: kilograms that rest on braked wheels.
        load: kilograms that roll along unbraked.
        friction: coefficient between the braked wheels and the ground.
        step: of the integration, seconds.
    """

    radius: float = 0.3
    heights: tuple[float, float] = (0.05, 0.6)
    camera_height: float = 0.4
    mass: float = 40.0
    load: float = 0.0
    friction: float = 0.5
    step: float = 1e-3

    @property
    def braked_share(self) -> float:
        """Share of the weight that rests on braked wheels."""
        return self.mass / (self.mass + self.load)

    def brake(self, x: float, speed: float) -> float:
        """Where the robot stands still that brakes at x with `speed`: Coulomb friction, step by step; the last step
        ends when it stands."""
        force = self.friction * self.mass * GRAVITY
        deceleration = force / (self.mass + self.load)
        while speed > 0:
            duration = min(self.step, speed / deceleration)
            slower = max(0.0, speed - deceleration * duration)
            x += (speed + slower) / 2 * duration
            speed = slower if duration == self.step else 0.0
        return x
