# SPDX-License-Identifier: Apache-2.0
"""The package foxglove-sdk, and small messages of its schemas."""

from __future__ import annotations

from typing import Any

import numpy as np

from ggslam.errors import MissingDependency
from ggslam.messages.pose_numbers import position_and_quaternion
from ggslam.messages.stamps import seconds_and_nanoseconds


def foxglove_package() -> Any:
    """The package; raises MissingDependency without it."""
    try:
        import foxglove
        import foxglove.messages
    except ImportError as error:
        raise MissingDependency(f"Foxglove needs foxglove-sdk: pip install 'ggslam[foxglove]' ({error})") from None
    return foxglove


def foxglove_messages() -> Any:
    """Its messages."""
    return foxglove_package().messages


def timestamp(stamp: float) -> Any:
    """foxglove.Timestamp."""
    return foxglove_messages().Timestamp(*seconds_and_nanoseconds(stamp))


def vector(xyz: np.ndarray) -> Any:
    """foxglove.Vector3."""
    return foxglove_messages().Vector3(x=float(xyz[0]), y=float(xyz[1]), z=float(xyz[2]))


def quaternion(xyzw: np.ndarray) -> Any:
    """foxglove.Quaternion."""
    x, y, z, w = map(float, xyzw)
    return foxglove_messages().Quaternion(x=x, y=y, z=z, w=w)


def pose(T: np.ndarray) -> Any:
    """foxglove.Pose."""
    numbers = position_and_quaternion(T)
    return foxglove_messages().Pose(position=vector(numbers[:3]), orientation=quaternion(numbers[3:]))


def color(rgb: tuple[int, int, int], alpha: float = 1.0) -> Any:
    """foxglove.Color of 0 to 255."""
    return foxglove_messages().Color(r=rgb[0] / 255, g=rgb[1] / 255, b=rgb[2] / 255, a=alpha)
