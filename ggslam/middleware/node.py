# SPDX-License-Identifier: Apache-2.0
"""A node of ROS 2, whichever middleware carries its messages. Content is CDR, as ROS 2 sends it."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, Final, Literal, Protocol

Middleware = Literal["zenoh", "dds"]


HIGHEST_DOMAIN: Final = 232
"""Largest ROS_DOMAIN_ID: DDS has no ports for higher ones."""


@dataclass(frozen=True)
class NodeRequest:
    """How to join the network.

    Attributes:
        middleware: as rmw_zenoh_cpp, or as rmw_cyclonedds_cpp does.
        domain: ROS_DOMAIN_ID.
        namespace: of topics that have none, such as `/robot1`.
        address: of Zenoh's router or of another peer, such as `tcp/192.168.1.2:7447`, and with `listen:` in front one
            to listen on; several are separated by commas; empty: a router on this machine whenever there is one, and
            peers nearby. Of DDS the address or name of the network interface; 127.0.0.1 leaves multicast off.
        distribution: of ROS 2; None: of ROS_DISTRO.
    """

    middleware: Middleware = "zenoh"
    domain: int = 0
    namespace: str = ""
    address: str = ""
    distribution: str | None = None


@dataclass(frozen=True)
class Qos:
    """What a topic promises, in ROS 2's words.

    Attributes:
        reliable: lost messages are sent again; else best effort.
        latched: who joins late gets the last `depth` messages (transient local); else volatile.
        depth: most messages that wait for somebody slow; older ones make room.
    """

    reliable: bool = True
    latched: bool = False
    depth: int = 10


SENSOR_DATA = Qos(reliable=False, depth=5)
"""ROS 2's profile for sensors."""
LATCHED = Qos(latched=True, depth=1)
"""Of maps and /tf_static."""


@dataclass(frozen=True)
class Received:
    """A message as it came.

    Attributes:
        content: CDR with its header of four bytes.
        at: when it came, seconds since 1970.
        writer: tells writers of a topic apart.
        number: that its writer gave it, one more each time; None: the middleware does not tell.
    """

    content: bytes
    at: float
    writer: str = ""
    number: int | None = None


class Publisher(Protocol):
    """Sends messages of one topic."""

    topic: str
    kind: str

    @property
    def subscribers(self) -> int:
        """How many listen, as far as the middleware tells; one that only knows whether somebody does says 0 or 1."""

    def send(self, content: bytes) -> None:
        """Sends CDR with its header; never waits for somebody slow: what cannot be taken is left out and counted."""

    @property
    def left_out(self) -> int:
        """Messages that the middleware did not take."""

    def close(self) -> None:
        """Sends no more."""


class Subscription(Protocol):
    """Takes messages of one topic.

    Attributes:
        lost: messages that were sent and did not come.
        overrun: messages that came and had to make room for newer ones before they were taken.
        failures: messages whose `take` raised. The first is written to the log.
    """

    topic: str
    kind: str
    lost: int

    @property
    def overrun(self) -> int: ...

    @property
    def failures(self) -> int: ...

    def close(self) -> None:
        """Takes no more."""


class Node(Protocol):
    """A node. Names of topics are full (`/camera/color`) and types as `sensor_msgs/msg/Image`."""

    name: str
    namespace: str

    def publisher(self, topic: str, kind: str, qos: Qos) -> Publisher:
        """Begins to send."""

    def subscribe(self, topic: str, kind: str, qos: Qos, take: Callable[[Received], None]) -> Subscription:
        """Begins to take; `take` is called in a thread of the middleware, one message at a time."""

    def offer(self, service: str, kind: str, answer: Callable[[Any], Any]) -> None:
        """Offers a service: `answer` gets the decoded request and returns the response. What it raises is told to
        nobody over ROS 2, which has no word for it: responses have fields for that."""

    def call(self, service: str, kind: str, request: Any, timeout_s: float = 5.0) -> Any:
        """Calls a service; raises MiddlewareError where nobody answers in time."""

    def topics(self) -> dict[str, str]:
        """Topics that can be seen now, with their types."""

    def close(self) -> None:
        """Leaves the network."""
