# SPDX-License-Identifier: Apache-2.0
"""A node on DDS, as rmw_cyclonedds_cpp puts ROS 2 on it."""

from __future__ import annotations

import itertools
import secrets
import threading
from collections.abc import Callable
from typing import Any

from ggslam.middleware.dds_domain import DOMAINS
from ggslam.middleware.dds_presence import Presence
from ggslam.middleware.dds_services import DdsClient, DdsOffered
from ggslam.middleware.dds_topics import READ_DEPTH, DdsPublisher, DdsSubscription, Reading, dds_qos
from ggslam.middleware.dds_types import RawTypes
from ggslam.middleware.definitions import request_of, response_of
from ggslam.middleware.leaving import close_at_exit
from ggslam.middleware.names import check_kind, check_node_name, full_name, full_namespace, ros_kind
from ggslam.middleware.node import NodeRequest, Qos, Received
from ggslam.middleware.services import SERVICE_QOS, Answers
from ggslam.middleware.types import message_types

TOPIC, REQUEST, REPLY = "rt", "rq", "rr"
"""Prefixes of ROS 2 to names of topics in DDS."""
MANY = 10_000


class DdsNode:
    """A node; its participant is its own. See `ggslam.middleware.node.Node`."""

    def __init__(self, request: NodeRequest, name: str) -> None:
        self.name = check_node_name(name)
        self.namespace = full_namespace(request.namespace)
        self.types = message_types(request.distribution)
        self._raw = RawTypes(self.types)
        self._domain = request.domain
        self._participant = DOMAINS.join(request.domain, request.address)
        self._lock = threading.Lock()
        self._ends: list[Any] = []
        self._topics: dict[tuple[str, str], Any] = {}
        self._clients: dict[tuple[str, str], DdsClient] = {}
        self._numbers = itertools.count(1)
        self._closed = False
        self._graph = self._builtin_readers()
        self._reading = Reading(self._participant, name)
        self._presence = Presence(self._participant, self.types, self._raw, self.namespace, name)
        close_at_exit(self)

    def publisher(self, topic: str, kind: str, qos: Qos) -> DdsPublisher:
        """Begins to send."""
        name = full_name(self.namespace, topic)
        writer = self._writer(TOPIC + name, kind, qos, self._mark(kind))
        return self._keep(DdsPublisher(name, kind, writer, self._raw.raw(kind)))

    def subscribe(self, topic: str, kind: str, qos: Qos, take: Callable[[Received], None]) -> DdsSubscription:
        """Begins to take."""
        name = full_name(self.namespace, topic)
        reader = self._reader(TOPIC + name, kind, qos, self._mark(kind))
        return self._keep(DdsSubscription(name, kind, qos, reader, self._reading, take))

    def offer(self, service: str, kind: str, answer: Callable[[Any], Any]) -> None:
        """Offers a service."""
        name = full_name(self.namespace, service)
        asked, answered = request_of(check_kind(kind)), response_of(kind)
        mark = f"serviceid={self._unique()};"
        writer = self._writer(f"{REPLY}{name}Reply", answered, SERVICE_QOS, mark + self._mark(answered))
        reader = self._reader(f"{REQUEST}{name}Request", asked, SERVICE_QOS, mark + self._mark(asked))
        answers = Answers(name, self.types, kind, answer)
        self._keep(DdsOffered(reader, writer, self._raw.raw(answered), self._reading, answers))

    def call(self, service: str, kind: str, request: Any, timeout_s: float = 5.0) -> Any:
        """Calls a service."""
        name = full_name(self.namespace, service)
        content = self.types.encode(request_of(check_kind(kind)), request)
        with self._lock:
            client = self._clients.get((name, kind))
        if client is None:
            client = self._client(name, kind)
        return self.types.decode(response_of(kind), client.call(content, timeout_s))

    def topics(self) -> dict[str, str]:
        """Topics that can be seen now, with their types."""
        found = {}
        for reader, condition in self._graph:
            for endpoint in reader.read(MANY, condition):
                kind = ros_kind(endpoint.type_name)
                if kind and endpoint.topic_name.startswith(TOPIC + "/"):
                    found[endpoint.topic_name[len(TOPIC) :]] = kind
        return found

    def close(self) -> None:
        """Leaves the network."""
        with self._lock:
            if self._closed:
                return
            self._closed = True
            ends, self._ends = self._ends, []
        for end in ends:
            end.close()
        self._reading.close()
        DOMAINS.leave(self._domain, self._participant)

    def _client(self, name: str, kind: str) -> DdsClient:
        asked, answered = request_of(kind), response_of(kind)
        mark = f"clientid={self._unique()};"
        writer = self._writer(f"{REQUEST}{name}Request", asked, SERVICE_QOS, mark + self._mark(asked))
        reader = self._reader(f"{REPLY}{name}Reply", answered, SERVICE_QOS, mark + self._mark(answered))
        client = self._keep(DdsClient(name, reader, writer, self._raw.raw(asked), self._reading))
        with self._lock:
            self._clients[name, kind] = client
        return client

    def _writer(self, name: str, kind: str, qos: Qos, mark: str) -> Any:
        from cyclonedds.pub import DataWriter

        writer = DataWriter(self._participant, self._topic(name, kind), dds_qos(qos, qos.depth, mark))
        self._presence.add_writer(writer)
        return writer

    def _reader(self, name: str, kind: str, qos: Qos, mark: str) -> Any:
        from cyclonedds.sub import DataReader

        depth = qos.depth if qos.latched else max(qos.depth, READ_DEPTH)
        reader = DataReader(self._participant, self._topic(name, kind), dds_qos(qos, depth, mark))
        self._presence.add_reader(reader)
        return reader

    def _topic(self, name: str, kind: str) -> Any:
        from cyclonedds.topic import Topic

        raw = self._raw.raw(check_kind(kind))
        with self._lock:
            if (name, kind) not in self._topics:
                self._topics[name, kind] = Topic(self._participant, name, raw)
            return self._topics[name, kind]

    def _builtin_readers(self) -> list[tuple[Any, Any]]:
        """Readers of who is there, with what they read."""
        from cyclonedds import builtin
        from cyclonedds.core import InstanceState, ReadCondition, SampleState, ViewState

        made = []
        for topic in (builtin.BuiltinTopicDcpsPublication, builtin.BuiltinTopicDcpsSubscription):
            reader = builtin.BuiltinDataReader(self._participant, topic)
            made.append((reader, ReadCondition(reader, SampleState.Any | ViewState.Any | InstanceState.Alive)))
        return made

    def _mark(self, kind: str) -> str:
        """What ROS 2 says of a type in the user data of readers and writers."""
        found = self.types.hash(kind)
        return f"typehash={found};" if found.startswith("RIHS") else ""

    def _unique(self) -> str:
        return ".".join(f"{part:x}" for part in (*secrets.token_bytes(12), 0, 0, 0, next(self._numbers) & 255))

    def _keep(self, end: Any) -> Any:
        with self._lock:
            self._ends.append(end)
        return end
