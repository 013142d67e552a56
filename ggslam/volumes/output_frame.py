# SPDX-License-Identifier: Apache-2.0
"""Frames that files of a map are written in."""

from __future__ import annotations

from enum import Enum

from ggslam.errors import ConfigError


class OutputFrame(str, Enum):
    """Frame that files are written in: that of the map, or that of its floor."""

    map = "map"
    floor = "floor"


def output_frame(name: str) -> OutputFrame:
    """The frame of this name. Raises ConfigError if there is none."""
    try:
        return OutputFrame(name)
    except ValueError:
        raise ConfigError(f"`frame`: expected {' or '.join(f.value for f in OutputFrame)}, found '{name}'") from None
