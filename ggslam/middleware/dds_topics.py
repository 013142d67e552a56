# SPDX-License-Identifier: Apache-2.0
"""Publishers and subscriptions on DDS, and the thread that reads."""

from __future__ import annotations

import logging
import threading
import time
from collections.abc import Callable
from typing import Any, Final

from ggslam.errors import MiddlewareError
from ggslam.middleware.dds_domain import delete
from ggslam.middleware.delivery import Delivery
from ggslam.middleware.node import Qos, Received

log = logging.getLogger(__name__)
READ_DEPTH: Final = 16
"""Messages that wait, at least, for the thread that reads; those beyond the topic's depth are counted as lost there."""
READ_ONCE: Final = 8
CLOSE_S: Final = 2.0
FOREVER_NS: Final = 2**62
PAUSE_S: Final = 0.1
"""After an error of DDS, so that one that comes again does not take the processor."""


def dds_qos(qos: Qos, depth: int, user_data: str) -> Any:
    """Policies as rmw_cyclonedds_cpp sets them, but that a writer never waits. CDR is of the first version."""
    from cyclonedds.core import Policy
    from cyclonedds.core import Qos as Policies

    history = Policy.History.KeepLast(depth)
    policies = [
        Policy.Reliability.Reliable(0) if qos.reliable else Policy.Reliability.BestEffort,
        Policy.Durability.TransientLocal if qos.latched else Policy.Durability.Volatile,
        history,
        Policy.WriterDataLifecycle(autodispose=False),
        Policy.DataRepresentation(use_cdrv0_representation=True),
        Policy.Userdata(user_data.encode()),
    ]
    if qos.latched:
        policies.append(Policy.DurabilityService(0, history, -1, -1, -1))
    return Policies(*policies)


class Reading:
    """One thread of a node that waits for samples of all its readers, and hands them over."""

    def __init__(self, participant: Any, name: str) -> None:
        from cyclonedds.core import GuardCondition, WaitSet

        self._lock = threading.Lock()
        self._readers: dict[Any, tuple[Any, Callable[[Any], None]]] = {}
        self._waitset = WaitSet(participant)
        self._guard = GuardCondition(participant)
        self._waitset.attach(self._guard)
        self._closed = False
        self._thread = threading.Thread(target=self._run, name=f"read {name}", daemon=True)
        self._thread.start()

    def add(self, reader: Any, take: Callable[[Any], None]) -> Any:
        """Has `take` called with each sample of a reader, in the thread that reads; what to `remove`."""
        from cyclonedds.core import InstanceState, ReadCondition, SampleState, ViewState

        condition = ReadCondition(reader, SampleState.NotRead | ViewState.Any | InstanceState.Any)
        with self._lock:
            self._readers[condition] = (reader, take)
            self._waitset.attach(condition)
        return condition

    def remove(self, condition: Any) -> None:
        """Reads a reader no more and ends it; the thread is in none of its calls afterwards."""
        with self._lock:
            reader, _ = self._readers.pop(condition)
            self._waitset.detach(condition)
            delete(condition)
            delete(reader)

    def close(self) -> None:
        """Reads no more."""
        self._closed = True
        self._guard.set(True)
        if threading.current_thread() is not self._thread:
            self._thread.join(CLOSE_S)

    def _run(self) -> None:
        from cyclonedds.core import DDSException

        while not self._closed:
            try:
                self._waitset.wait(FOREVER_NS)
                with self._lock:
                    for condition, (reader, take) in self._readers.items():
                        self._take_all(reader, condition, take)
            except DDSException as error:
                log.warning("DDS: messages could not be read: %s", error.msg)
                time.sleep(PAUSE_S)

    def _take_all(self, reader: Any, condition: Any, take: Callable[[Any], None]) -> None:
        while not self._closed:
            samples = reader.take(READ_ONCE, condition)
            for sample in samples:
                if sample.sample_info.valid_data:
                    take(sample)
            if len(samples) < READ_ONCE:
                return


class DdsPublisher:
    """Sends messages of a topic. Those that nobody slow has fetched make room for newer ones, which DDS does not tell;
    `left_out` counts what it did not take at all."""

    def __init__(self, topic: str, kind: str, writer: Any, raw: type) -> None:
        self.topic, self.kind = topic, kind
        self.left_out = 0
        self._writer, self._raw = writer, raw
        self._lock = threading.Lock()
        self._closed = False

    @property
    def subscribers(self) -> int:
        """How many listen."""
        return 0 if self._closed else len(self._writer.get_matched_subscriptions())

    def send(self, content: bytes) -> None:
        """Sends CDR with its header; waits for nobody slow."""
        from cyclonedds.core import DDSException

        with self._lock:
            if self._closed:
                raise MiddlewareError(f"`{self.topic}`: its publisher is closed")
            try:
                self._writer.write(self._raw(content))
            except DDSException:
                self.left_out += 1

    def close(self) -> None:
        """Sends no more."""
        with self._lock:
            if not self._closed:
                self._closed = True
                delete(self._writer)


class DdsSubscription:
    """Takes messages of a topic. DDS gives no numbers of messages to Python; it counts itself what was lost.

    Attributes:
        lost: messages that DDS knows were sent and did not come, counted when a message comes.
    """

    def __init__(
        self, topic: str, kind: str, qos: Qos, reader: Any, reading: Reading, take: Callable[[Received], None]
    ) -> None:
        self.topic, self.kind = topic, kind
        self._reader, self._reading = reader, reading
        self._delivery = Delivery(topic, qos.depth, take)
        self.lost = 0
        self._condition = reading.add(reader, self._put)
        self._closed = False

    def _put(self, sample: Any) -> None:
        writer = f"{sample.sample_info.publication_handle & (1 << 64) - 1:016x}"
        self._delivery.put(Received(sample.content, time.time(), writer))
        self.lost = int(self._reader.get_sample_lost_status().total_count)

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
            self._reading.remove(self._condition)
            self._delivery.close()
