# SPDX-License-Identifier: Apache-2.0
"""Publishers and subscriptions on Zenoh."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable
from typing import TYPE_CHECKING, Any, Final

from ggslam.errors import MiddlewareError
from ggslam.middleware import zenoh_keys as keys
from ggslam.middleware.delivery import Delivery, Gaps
from ggslam.middleware.node import Qos, Received

if TYPE_CHECKING:
    from ggslam.middleware.zenoh_graph import Graph

HEARTBEAT_S: Final = 0.5
"""How often a latched, reliable publisher tells the number of its last message where that is new."""


class ZenohPublisher:
    """Sends messages of a topic. Zenoh drops a message that does not fit into the queue of a slow link, of reliable
    publishers, too: nobody waits. It does not tell of that: `left_out` counts only what Zenoh refused, the rest is seen
    by the subscriber."""

    def __init__(
        self, session: Any, graph: Graph, topic: str, kind: str, qos: Qos, where: str, token: str
    ) -> None:
        import zenoh

        self.topic, self.kind = topic, kind
        self.left_out = 0
        self._graph = graph
        self._gid = keys.gid_of(token)
        self._number = 0
        self._lock = threading.Lock()
        common = {
            "encoding": "application/cdr",
            "congestion_control": zenoh.CongestionControl.DROP,
            "reliability": zenoh.Reliability.RELIABLE if qos.reliable else zenoh.Reliability.BEST_EFFORT,
        }
        if qos.latched:
            self._publisher = self._declare_latched(session, where, qos, common)
        else:
            self._publisher = session.declare_publisher(where, **common)
        self._token = session.liveliness().declare_token(token)
        self._closed = False

    @staticmethod
    def _declare_latched(session: Any, where: str, qos: Qos, common: dict[str, Any]) -> Any:
        from zenoh import ext

        misses = ext.MissDetectionConfig(heartbeat=None, sporadic_heartbeat=HEARTBEAT_S) if qos.reliable else None
        return ext.declare_advanced_publisher(
            session, where, cache=ext.CacheConfig(qos.depth), publisher_detection=True,
            sample_miss_detection=misses, **common,
        )  # fmt: skip

    @property
    def subscribers(self) -> int:
        """How many listen: subscriptions of ROS 2 by their tokens; others count as one together."""
        shown = len(self._graph.hashes("MS", self.topic, self.kind))
        if shown or not hasattr(self._publisher, "matching_status"):
            return shown
        return int(self._publisher.matching_status.matching)

    def send(self, content: bytes) -> None:
        """Sends CDR with its header; waits for nobody slow."""
        import zenoh

        with self._lock:
            if self._closed:
                raise MiddlewareError(f"`{self.topic}`: its publisher is closed")
            self._number += 1
            try:
                self._publisher.put(content, attachment=keys.attachment(self._number, time.time_ns(), self._gid))
            except zenoh.ZError:
                self.left_out += 1

    def close(self) -> None:
        """Sends no more."""
        with self._lock:
            if not self._closed:
                self._closed = True
                self._token.undeclare()
                self._publisher.undeclare()


class ZenohSubscription:
    """Takes messages of a topic.

    Attributes:
        lost: messages that were sent and did not come.
    """

    def __init__(
        self, session: Any, topic: str, kind: str, qos: Qos, where: str, token: str, take: Callable[[Received], None]
    ) -> None:
        self.topic, self.kind = topic, kind
        self.lost = 0
        self._gaps = Gaps()
        self._delivery = Delivery(topic, qos.depth, take)
        if qos.latched:
            self._subscriber = self._declare_latched(session, where, qos)
        else:
            self._subscriber = session.declare_subscriber(where, self._put)
        self._token = session.liveliness().declare_token(token)
        self._closed = False

    def _declare_latched(self, session: Any, where: str, qos: Qos) -> Any:
        from zenoh import ext

        return ext.declare_advanced_subscriber(
            session, where, self._put, subscriber_detection=True,
            history=ext.HistoryConfig(detect_late_publishers=True, max_samples=qos.depth),
            recovery=ext.RecoveryConfig(periodic_queries=None, heartbeat=True) if qos.reliable else None,
        )  # fmt: skip

    def _put(self, sample: Any) -> None:
        at = time.time()
        found = keys.read_attachment(sample.attachment.to_bytes()) if sample.attachment is not None else None
        number, _, gid = found or (None, 0, b"")
        if self._gaps.note(gid.hex(), number):
            self._delivery.put(Received(sample.payload.to_bytes(), at, gid.hex(), number))
            self.lost = self._gaps.lost

    @property
    def overrun(self) -> int:
        """Messages that came and had to make room before they were taken."""
        return self._delivery.overrun

    @property
    def failures(self) -> int:
        """Messages whose taking raised."""
        return self._delivery.failures

    def close(self) -> None:
        """Takes no more."""
        if not self._closed:
            self._closed = True
            self._token.undeclare()
            self._subscriber.undeclare()
            self._delivery.close()
