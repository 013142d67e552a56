# SPDX-License-Identifier: Apache-2.0
"""An outlet that keeps what was sent, for tests."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

from ggslam.messages.contents import Channel, Content


@dataclass(frozen=True)
class Kept:
    """One send."""

    channel: Channel
    content: Content
    stamp: float


class KeptOutlet:
    """Keeps what was sent; `join` acts as somebody who begins to listen. A send counts `size` bytes.

    Attributes:
        opened: channels by name.
        sent: all sends in order.
        heard: listeners of each channel, by name; `everybody` for channels that are not among them.
        closed: whether `close` was called.
    """

    name = "kept"

    def __init__(self, *, everybody: int = 1, size: int = 1) -> None:
        self.opened: dict[str, Channel] = {}
        self.sent: list[Kept] = []
        self.heard: dict[str, int] = {}
        self.everybody = everybody
        self.size = size
        self.refused = 0
        self.closed = False
        self._told: list[Callable[[Channel], None]] = []

    def open(self, channel: Channel) -> None:
        assert channel.name not in self.opened, f"{channel.name} was opened before"
        self.opened[channel.name] = channel

    def listeners(self, channel: Channel) -> int:
        return self.heard.get(channel.name, self.everybody)

    def on_join(self, told: Callable[[Channel], None]) -> None:
        self._told.append(told)

    def join(self, name: str) -> None:
        """Somebody begins to listen to a channel."""
        self.heard[name] = self.heard.get(name, 0) + 1
        for told in self._told:
            told(self.opened[name])

    def send(self, channel: Channel, content: Content, stamp: float) -> int:
        assert not self.closed, "sent after close"
        assert self.opened.get(channel.name) == channel, f"{channel.name} was not opened"
        assert isinstance(content, channel.kind), f"{channel.name} takes {channel.kind.__name__}"
        self.sent.append(Kept(channel, content, stamp))
        return self.size

    def left_out(self) -> int:
        return self.refused

    def close(self) -> None:
        self.closed = True

    def of(self, name: str) -> list[Content]:
        """Contents that were sent to a channel, in order."""
        return [kept.content for kept in self.sent if kept.channel.name == name]
