# SPDX-License-Identifier: Apache-2.0
"""Tells a map over ROS 2, by whichever middleware the node uses."""

from __future__ import annotations

from collections.abc import Callable

from ggslam.messages.contents import Channel, Content
from ggslam.messages.join_watch import JoinWatch
from ggslam.messages.ros2_channel import Ros2Channel
from ggslam.messages.sound_content import sound_content
from ggslam.middleware.node import Node
from ggslam.middleware.types import MessageTypes


class Ros2Outlet:
    """An Outlet of a node. Closing it leaves the node open."""

    name = "ros2"

    def __init__(self, node: Node, types: MessageTypes) -> None:
        self._node = node
        self._types = types
        self._channels: dict[Channel, Ros2Channel] = {}
        self._joins = JoinWatch()
        self._refused = 0
        self._left_out = 0

    def open(self, channel: Channel) -> None:
        """Makes a channel known."""
        opened = Ros2Channel(self._node, self._types, channel)
        self._channels[channel] = opened
        self._joins.add(channel, opened.listeners)

    def listeners(self, channel: Channel) -> int:
        """How many subscribers the topics of a channel have."""
        return self._channels[channel].listeners()

    def on_join(self, told: Callable[[Channel], None]) -> None:
        """`told` is called in a thread of the outlet."""
        self._joins.tell(told)

    def send(self, channel: Channel, content: Content, stamp: float) -> int:
        """Sends; returns the bytes of the messages, 0 if nothing of the content can be told."""
        sound = sound_content(content)
        if sound is None:
            self._refused += 1
            return 0
        opened = self._channels[channel]
        messages = opened.messages(sound, stamp)
        for end, message in messages:
            opened.publishers[end].send(message)
        return sum(len(message) for _, message in messages)

    def left_out(self) -> int:
        """Messages that the middleware did not take, and contents that could not be told."""
        if not self._channels:
            return self._left_out
        publishers = [p for opened in self._channels.values() for p in opened.publishers.values()]
        return self._refused + sum(publisher.left_out for publisher in publishers)

    def close(self) -> None:
        """Sends no more."""
        self._joins.close()
        self._left_out = self.left_out()
        for opened in self._channels.values():
            opened.close()
        self._channels.clear()
