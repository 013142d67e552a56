# SPDX-License-Identifier: Apache-2.0
"""A node of ROS 2 that keeps what is sent, for tests."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

from ggslam.middleware.names import full_name
from ggslam.middleware.node import Qos


@dataclass
class KeptPublisher:
    topic: str
    kind: str
    qos: Qos
    subscribers: int = 0
    left_out: int = 0
    sent: list[bytes] = field(default_factory=list)
    closed: bool = False

    def send(self, content: bytes) -> None:
        assert not self.closed
        self.sent.append(content)

    def close(self) -> None:
        self.closed = True


class KeptNode:
    """`publishers` by full topic."""

    def __init__(self, namespace: str = "/") -> None:
        self.name, self.namespace = "kept", namespace
        self.publishers: dict[str, KeptPublisher] = {}

    def publisher(self, topic: str, kind: str, qos: Qos) -> KeptPublisher:
        name = full_name(self.namespace, topic)
        assert name not in self.publishers
        self.publishers[name] = KeptPublisher(name, kind, qos)
        return self.publishers[name]

    def subscribe(self, *_: Any) -> Any:
        raise NotImplementedError

    def offer(self, *_: Any) -> None:
        raise NotImplementedError

    def call(self, *_: Any) -> Any:
        raise NotImplementedError

    def topics(self) -> dict[str, str]:
        return {name: publisher.kind for name, publisher in self.publishers.items()}

    def close(self) -> None:
        pass
