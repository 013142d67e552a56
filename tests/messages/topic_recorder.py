# SPDX-License-Identifier: Apache-2.0
"""A process that subscribes to all that a run publishes over ROS 2 and keeps it as an MCAP.

    python topic_recorder.py zenoh ADDRESS DOMAIN FILE

It says "ready", then "topic NAME" with the first message of each, and writes the file when its input ends.
"""

from __future__ import annotations

import sys
import threading
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

from second_readers import definition

from ggslam.jobs.serve import channels
from ggslam.messages.contents import Channel
from ggslam.messages.ros2_channel import TOPICS, topic_qos
from ggslam.middleware.names import full_name
from ggslam.middleware.node import Qos, Received
from ggslam.middleware.opening import NodeRequest, open_node

DEPTH = 200
"""Messages of a topic that may wait."""


def published() -> Iterator[tuple[str, str, Qos]]:
    """Topics of a run, their types and what they promise."""
    named = [value for value in vars(channels).values() if isinstance(value, Channel)]
    for channel in (*named, channels.grid_channel("")):
        for end, kind in TOPICS[channel.kind]:
            yield full_name("", channel.name + end), kind, replace(topic_qos(channel, end), depth=DEPTH)


class Kept:
    """Messages as they came: topic, type, and what came."""

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self.messages: list[tuple[str, str, Received]] = []
        self._seen: set[str] = set()

    def taker(self, topic: str, kind: str) -> Any:
        def take(received: Received) -> None:
            with self._lock:
                self.messages.append((topic, kind, received))
                if topic not in self._seen:
                    self._seen.add(topic)
                    print(f"topic {topic}", flush=True)

        return take

    def write(self, path: Path) -> None:
        """As an MCAP with the definitions of ROS 2; log times are those at which messages came."""
        from mcap.writer import Writer

        with self._lock, path.open("wb") as file:
            writer, ends = Writer(file), dict[str, int]()
            writer.start(profile="ros2")
            for topic, kind, received in self.messages:
                if topic not in ends:
                    schema = writer.register_schema(kind, "ros2msg", definition(kind))
                    ends[topic] = writer.register_channel(topic, "cdr", schema)
                at = round(1e9 * received.at)
                writer.add_message(ends[topic], at, received.content, at)
            writer.finish()


def main(middleware: Any, address: str, domain: int, path: Path) -> None:
    node = open_node(NodeRequest(middleware, domain, "", address, "jazzy"), "recorder")
    kept = Kept()
    ends = [node.subscribe(topic, kind, qos, kept.taker(topic, kind)) for topic, kind, qos in published()]
    print("ready", flush=True)
    sys.stdin.read()
    lost = sum(end.lost + end.overrun for end in ends)
    node.close()
    kept.write(path)
    print(f"kept {len(kept.messages)} messages, {lost} lost", flush=True)


if __name__ == "__main__":
    main(sys.argv[1], sys.argv[2], int(sys.argv[3]), Path(sys.argv[4]))
