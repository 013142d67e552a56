# SPDX-License-Identifier: Apache-2.0
"""Where contents go: ROS 2, Foxglove, a file."""

from __future__ import annotations

from collections.abc import Callable
from typing import Protocol

from ggslam.messages.contents import Channel, Content


class Outlet(Protocol):
    """Writes contents as messages and sends them. Called from one thread; never waits for who listens."""

    name: str

    def open(self, channel: Channel) -> None:
        """Makes a channel known."""

    def listeners(self, channel: Channel) -> int:
        """How many listen; a file counts as one."""

    def on_join(self, told: Callable[[Channel], None]) -> None:
        """`told` is called, from any thread, when somebody began to listen to a channel."""

    def send(self, channel: Channel, content: Content, stamp: float) -> int:
        """Sends; returns the bytes of the message. Latched contents are also kept for who joins late, but for parts of
        meshes: those are to be sent again when `on_join` tells."""

    def left_out(self) -> int:
        """Messages that could not be taken without waiting."""

    def close(self) -> None:
        """Ends it."""
