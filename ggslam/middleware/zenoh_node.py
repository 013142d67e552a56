# SPDX-License-Identifier: Apache-2.0
"""A node on Zenoh, as rmw_zenoh_cpp puts ROS 2 on it."""

from __future__ import annotations

import contextlib
import itertools
import queue
import threading
import time
from collections.abc import Callable
from typing import Any, Final

from ggslam.errors import MiddlewareError
from ggslam.middleware import zenoh_keys as keys
from ggslam.middleware.definitions import request_of, response_of
from ggslam.middleware.leaving import close_at_exit
from ggslam.middleware.names import check_kind, check_node_name, full_name, full_namespace
from ggslam.middleware.node import NodeRequest, Qos, Received
from ggslam.middleware.services import SERVICE_QOS, Answers
from ggslam.middleware.types import message_types
from ggslam.middleware.zenoh_graph import Graph
from ggslam.middleware.zenoh_session import open_session
from ggslam.middleware.zenoh_topics import ZenohPublisher, ZenohSubscription

LOOK_S: Final = 0.01
"""How often a client looks whether Zenoh knows the way to a service that shows itself."""


class ZenohNode:
    """A node; its session is its own. See `ggslam.middleware.node.Node`."""

    def __init__(self, request: NodeRequest, name: str) -> None:
        self.name = check_node_name(name)
        self.namespace = full_namespace(request.namespace)
        self.types = message_types(request.distribution)
        self._domain = request.domain
        self._session = open_session(request.address)
        self._mark = keys.NodeMark(request.domain, str(self._session.zid()), self.namespace, name)
        self._numbers = itertools.count(1)
        self._lock = threading.Lock()
        self._ends: list[Any] = []
        self._clients: dict[tuple[str, str], tuple[Any, bytes]] = {}
        self._tokens = [self._session.liveliness().declare_token(self._mark.node_token())]
        self._graph = Graph(self._session, request.domain)
        close_at_exit(self)

    def publisher(self, topic: str, kind: str, qos: Qos) -> ZenohPublisher:
        """Begins to send."""
        name, type_hash = full_name(self.namespace, topic), self.types.hash(check_kind(kind))
        token = self._mark.token(next(self._numbers), "MP", name, kind, type_hash, qos)
        where = keys.key(self._domain, name, kind, type_hash)
        made = ZenohPublisher(self._session, self._graph, name, kind, qos, where, token)
        self._keep(made)
        return made

    def subscribe(self, topic: str, kind: str, qos: Qos, take: Callable[[Received], None]) -> ZenohSubscription:
        """Begins to take, from publishers of any hash of the type."""
        name, type_hash = full_name(self.namespace, topic), self.types.hash(check_kind(kind))
        token = self._mark.token(next(self._numbers), "MS", name, kind, type_hash, qos)
        where = keys.key(self._domain, name, kind, "*")
        made = ZenohSubscription(self._session, name, kind, qos, where, token, take)
        self._keep(made)
        return made

    def offer(self, service: str, kind: str, answer: Callable[[Any], Any]) -> None:
        """Offers a service, to clients of any hash of the type."""
        name, type_hash = full_name(self.namespace, service), self.types.hash(check_kind(kind))
        answers = Answers(name, self.types, kind, answer)
        concrete = keys.key(self._domain, name, kind, type_hash)

        def reply(query: Any) -> None:
            with query:  # afterwards the client waits no longer
                sent = query.attachment.to_bytes() if query.attachment is not None else b""
                found = keys.read_attachment(sent)
                if found is None or query.payload is None:
                    answers.refuse("a request is not as rmw_zenoh_cpp sends it")
                    return
                response = answers.response(query.payload.to_bytes())
                if response is not None:
                    # a client that asks for any hash takes ours, one that asks for its own takes only that
                    where = concrete if "*" in str(query.key_expr) else query.key_expr
                    number, _, gid = found
                    query.reply(where, response, attachment=keys.attachment(number, time.time_ns(), gid))

        queryable = self._session.declare_queryable(
            keys.key(self._domain, name, kind, "*"), lambda query: answers.put(lambda: reply(query)), complete=True
        )
        token = self._mark.token(next(self._numbers), "SS", name, kind, type_hash, SERVICE_QOS)
        self._keep(Offered(queryable, answers, self._session.liveliness().declare_token(token)))

    def call(self, service: str, kind: str, request: Any, timeout_s: float = 5.0) -> Any:
        """Calls a service, of any hash of the type."""
        name = full_name(self.namespace, service)
        content = self.types.encode(request_of(check_kind(kind)), request)
        gid = self._client(name, kind)
        deadline = time.monotonic() + timeout_s
        offered = self._graph.wait_for("SS", name, kind, deadline)
        if offered:
            where = keys.key(self._domain, name, kind, sorted(offered)[0])
            attached = keys.attachment(next(self._numbers), time.time_ns(), gid)
            response = self._ask(where, content, attached, deadline)
            if response is not None:
                return self.types.decode(response_of(kind), response)
        raise MiddlewareError(f"`{name}`: nobody answered in {timeout_s:g} s")

    def _ask(self, where: str, content: bytes, attached: bytes, deadline: float) -> bytes | None:
        """The response to a request, which is sent once; None: there is none by the deadline of the monotonic clock."""
        import zenoh

        replies: queue.SimpleQueue[Any] = queue.SimpleQueue()
        querier = self._session.declare_querier(
            where, target=zenoh.QueryTarget.ALL_COMPLETE, consolidation=zenoh.ConsolidationMode.NONE,
            timeout=max(LOOK_S, deadline - time.monotonic()),
        )  # fmt: skip
        with querier, contextlib.suppress(queue.Empty):
            while not querier.matching_status.matching:
                if time.monotonic() > deadline:
                    return None
                time.sleep(LOOK_S)
            taking = zenoh.handlers.Callback(replies.put, lambda: replies.put(None))
            querier.get(taking, payload=content, attachment=attached)
            while (reply := replies.get(timeout=max(0.0, deadline - time.monotonic()))) is not None:
                if reply.ok is not None:
                    return bytes(reply.ok.payload.to_bytes())
        return None

    def topics(self) -> dict[str, str]:
        """Topics that can be seen now, with their types."""
        return self._graph.topics()

    def close(self) -> None:
        """Leaves the network."""
        with self._lock:
            ends, self._ends = self._ends, []
        for end in ends:
            end.close()
        self._graph.close()
        if not self._session.is_closed():
            self._session.close()

    def _keep(self, end: Any) -> None:
        with self._lock:
            self._ends.append(end)

    def _client(self, name: str, kind: str) -> bytes:
        """Shows others that this node calls a service; the id of the caller."""
        with self._lock:
            if (name, kind) not in self._clients:
                number, type_hash = next(self._numbers), self.types.hash(kind)
                token = self._mark.token(number, "SC", name, kind, type_hash, SERVICE_QOS)
                self._clients[name, kind] = (self._session.liveliness().declare_token(token), keys.gid_of(token))
            return self._clients[name, kind][1]


class Offered:
    """A service that a node offers."""

    def __init__(self, queryable: Any, answers: Answers, token: Any) -> None:
        self._parts = (queryable, token)
        self._answers = answers

    def close(self) -> None:
        """Offers it no more."""
        for part in self._parts:
            part.undeclare()
        self._answers.close()
