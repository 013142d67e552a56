# SPDX-License-Identifier: Apache-2.0
"""What tests of `jobs.serve` share."""

from __future__ import annotations

import sys
import time
from collections.abc import Callable
from pathlib import Path

import numpy as np

sys.path += [str(Path(__file__).parents[1] / room) for room in ("messages", "middleware")]
from kept_outlet import KeptOutlet  # noqa: E402
from local_node import LocalNetwork  # noqa: E402

from ggslam.messages.contents import Channel, Content, Transforms  # noqa: E402

__all__ = ["KeptOutlet", "LocalNetwork", "SlowOutlet", "chain", "until"]


class SlowOutlet(KeptOutlet):
    """Takes its time for each message."""

    def __init__(self, seconds: float, **values: int) -> None:
        super().__init__(**values)
        self.seconds, self.begun = seconds, 0

    def wait(self) -> object:
        """Until a message is sent."""
        return time.sleep(self.seconds)

    def send(self, channel: Channel, content: Content, stamp: float) -> int:
        self.begun += 1
        self.wait()
        return super().send(channel, content, stamp)


def until(happened: Callable[[], object], seconds: float = 30.0) -> None:
    """Waits until something is so."""
    end = time.monotonic() + seconds
    while not happened():
        assert time.monotonic() < end, "it did not happen"
        time.sleep(0.01)


def chain(transforms: Transforms, *frames: str) -> np.ndarray:
    """T_first_last along edges from parent to child."""
    edges = {(parent, child): T for parent, child, T in transforms.edges}
    T = np.eye(4)
    for parent, child in zip(frames[:-1], frames[1:], strict=True):
        T = T @ edges[parent, child]
    return T
