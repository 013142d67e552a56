# SPDX-License-Identifier: Apache-2.0
"""A robot that drives on a floor, as maps see it: an upright cylinder."""

from __future__ import annotations

import re
from typing import Final

from ggslam.errors import ConfigError
from ggslam.system.settings import Conflict, setting, settings_class

_NAME: Final = re.compile(r"[A-Za-z0-9][A-Za-z0-9_-]{0,31}")
"""Names may stand in file names."""


@settings_class(frozen=True)
class Robot:
    """Size of a robot and what it can drive over."""

    height: float = setting(0.4, 0.01, 100, "m")
    """Height of its highest point above the floor."""
    radius: float = setting(0.2, 0, 100, "m")
    """Radius of the circle that it takes up on the floor."""
    step: float = setting(0.05, 0, 10, "m")
    """Height above the floor from which something is an obstacle; it drives over what is lower."""
    name: str = ""
    """What files made for it are called by: letters, digits, `-` and `_`; empty: no name."""

    def __post_init__(self) -> None:
        if self.step >= self.height:
            raise Conflict("step", f"expected less than height, {self.height:g}, found {self.step:g}")
        if self.name and not _NAME.fullmatch(self.name):
            raise Conflict("name", f"expected up to 32 letters, digits, - and _, found {self.name!r}")

    @property
    def band(self) -> tuple[float, float]:
        """Lowest and highest obstacle that it meets, metres above the floor."""
        return self.step, self.height


def parse_robot(text: str) -> Robot:
    """A robot as the command line writes it: "HEIGHT,RADIUS", "HEIGHT,RADIUS,STEP", with "NAME:" before it if wanted.

    Raises:
        ConfigError: the text says something else, or numbers out of range.
    """
    name, colon, numbers = text.rpartition(":")
    try:
        values = [float(word) for word in numbers.split(",")]
    except ValueError:
        values = []
    if len(values) not in (2, 3) or (colon and not name):
        raise ConfigError(f'robot: expected "HEIGHT,RADIUS" or "NAME:HEIGHT,RADIUS" in metres, found {text!r}')
    height, radius, step = (*values, Robot.step)[:3]
    return Robot(height, radius, step, name)
