# SPDX-License-Identifier: Apache-2.0
"""Nodes that meet in memory: what the middleware promises, without a network.

    network = LocalNetwork()
    a, b = network.node("a"), network.node("b")
    b.subscribe("/chatter", "std_msgs/msg/String", Qos(), got.append)
    a.publisher("/chatter", "std_msgs/msg/String", Qos()).send(content)
    network.settle()  # until all that was sent is taken
"""

from __future__ import annotations

import itertools
import threading
import time
from collections import deque
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from concurrent.futures import TimeoutError as Late
from dataclasses import dataclass, field
from typing import Any

from ggslam.errors import MiddlewareError
from ggslam.middleware.delivery import Delivery, Gaps
from ggslam.middleware.names import check_kind, check_node_name, full_name, full_namespace
from ggslam.middleware.node import Qos, Received


class LocalNetwork:
    """A network of nodes in one process. `LocalNetwork().node("a")` joins it."""

    def __init__(self) -> None:
        self.lock = threading.RLock()
        self.publishers: list[LocalPublisher] = []
        self.subscriptions: list[LocalSubscription] = []
        self.services: dict[str, tuple[str, Callable[[Any], Any]]] = {}
        self.numbers = itertools.count()
        self.pool = ThreadPoolExecutor(4, "services")

    def node(self, name: str, namespace: str = "") -> LocalNode:
        return LocalNode(self, check_node_name(name), full_namespace(namespace))

    def settle(self, timeout_s: float = 5.0) -> None:
        """Waits until everything that was sent is taken."""
        deadline = time.monotonic() + timeout_s
        with self.lock:
            listed = list(self.subscriptions)
        for subscription in listed:
            assert subscription.delivery.wait_idle(deadline - time.monotonic()), subscription.topic


def fits(publisher: LocalPublisher, subscription: LocalSubscription) -> bool:
    """Whether a subscription gets what a publisher sends, as DDS matches them."""
    offered, wanted = publisher.qos, subscription.qos
    same = (publisher.topic, publisher.kind) == (subscription.topic, subscription.kind)
    return same and (offered.reliable or not wanted.reliable) and (offered.latched or not wanted.latched)


@dataclass(eq=False)
class LocalPublisher:
    network: LocalNetwork
    topic: str
    kind: str
    qos: Qos
    writer: str
    number: int = 0
    kept: deque[Received] = field(default_factory=deque)
    left_out: int = 0
    closed: bool = False

    @property
    def subscribers(self) -> int:
        with self.network.lock:
            return sum(fits(self, subscription) for subscription in self.network.subscriptions)

    def send(self, content: bytes) -> None:
        with self.network.lock:
            if self.closed:
                raise MiddlewareError(f"`{self.topic}`: its publisher is closed")
            self.number += 1
            received = Received(bytes(content), time.time(), self.writer, self.number)
            if self.qos.latched:
                self.kept.append(received)
                while len(self.kept) > self.qos.depth:
                    self.kept.popleft()
            for subscription in self.network.subscriptions:
                if fits(self, subscription):
                    subscription.put(received)

    def close(self) -> None:
        with self.network.lock:
            self.closed = True
            if self in self.network.publishers:
                self.network.publishers.remove(self)


class LocalSubscription:
    def __init__(
        self, network: LocalNetwork, topic: str, kind: str, qos: Qos, take: Callable[[Received], None]
    ) -> None:
        self.network, self.topic, self.kind, self.qos = network, topic, kind, qos
        self.delivery = Delivery(topic, qos.depth, take)
        self.gaps = Gaps()

    def put(self, received: Received) -> None:
        if self.gaps.note(received.writer, received.number):
            self.delivery.put(received)

    @property
    def lost(self) -> int:
        return self.gaps.lost

    @property
    def overrun(self) -> int:
        return self.delivery.overrun

    @property
    def failures(self) -> int:
        return self.delivery.failures

    def close(self) -> None:
        with self.network.lock:
            if self in self.network.subscriptions:
                self.network.subscriptions.remove(self)
        self.delivery.close()


class LocalNode:
    """A Node (ggslam.middleware.node) of a LocalNetwork."""

    def __init__(self, network: LocalNetwork, name: str, namespace: str) -> None:
        self.network, self.name, self.namespace = network, name, namespace
        self._ends: list[LocalPublisher | LocalSubscription] = []
        self._services: list[str] = []

    def publisher(self, topic: str, kind: str, qos: Qos) -> LocalPublisher:
        writer = f"{self.name}-{next(self.network.numbers)}"
        made = LocalPublisher(self.network, full_name(self.namespace, topic), check_kind(kind), qos, writer)
        with self.network.lock:
            self.network.publishers.append(made)
        self._ends.append(made)
        return made

    def subscribe(self, topic: str, kind: str, qos: Qos, take: Callable[[Received], None]) -> LocalSubscription:
        made = LocalSubscription(self.network, full_name(self.namespace, topic), check_kind(kind), qos, take)
        with self.network.lock:
            self.network.subscriptions.append(made)
            for publisher in self.network.publishers:
                if made.qos.latched and fits(publisher, made):
                    for received in list(publisher.kept)[-qos.depth :]:
                        made.put(received)
        self._ends.append(made)
        return made

    def offer(self, service: str, kind: str, answer: Callable[[Any], Any]) -> None:
        name = full_name(self.namespace, service)
        with self.network.lock:
            self.network.services[name] = (check_kind(kind), answer)
        self._services.append(name)

    def call(self, service: str, kind: str, request: Any, timeout_s: float = 5.0) -> Any:
        name = full_name(self.namespace, service)
        found_kind, answer = self.network.services.get(name, ("", None))
        if answer is None or found_kind != kind:
            raise MiddlewareError(f"`{name}`: nobody answered in {timeout_s:g} s")
        try:
            return self.network.pool.submit(answer, request).result(timeout_s)
        except Late:
            raise MiddlewareError(f"`{name}`: nobody answered in {timeout_s:g} s") from None
        except Exception as error:  # as over a network: what the other side raised does not come here
            raise MiddlewareError(f"`{name}`: nobody answered in {timeout_s:g} s") from error

    def topics(self) -> dict[str, str]:
        with self.network.lock:
            return {end.topic: end.kind for end in [*self.network.publishers, *self.network.subscriptions]}

    def close(self) -> None:
        for name in self._services:
            self.network.services.pop(name, None)
        for end in self._ends:
            end.close()
