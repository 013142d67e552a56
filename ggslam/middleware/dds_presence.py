# SPDX-License-Identifier: Apache-2.0
"""Tells others on DDS which node has which readers and writers: DDS itself knows no nodes of ROS 2."""

from __future__ import annotations

import threading
from typing import Any, Final

import numpy as np

from ggslam.middleware.dds_topics import dds_qos
from ggslam.middleware.dds_types import RawTypes
from ggslam.middleware.node import LATCHED
from ggslam.middleware.types import MessageTypes

TOPIC: Final = "ros_discovery_info"
PACKAGE: Final = "rmw_dds_common/msg"


class Presence:
    """A node as `ros2 node list` shows it."""

    def __init__(self, participant: Any, types: MessageTypes, raw: RawTypes, namespace: str, name: str) -> None:
        from cyclonedds.pub import DataWriter
        from cyclonedds.topic import Topic

        kind = f"{PACKAGE}/ParticipantEntitiesInfo"
        self._participant, self._types, self._kind = participant, types, kind
        self._place = {"node_namespace": namespace, "node_name": name}
        self._raw = raw.raw(kind)
        self._writer: Any = DataWriter(participant, Topic(participant, TOPIC, self._raw), dds_qos(LATCHED, 1, ""))
        self._lock = threading.Lock()
        self._gids: dict[str, list[Any]] = {"reader_gid_seq": [], "writer_gid_seq": []}
        self._tell()

    def add_reader(self, reader: Any) -> None:
        """Tells of one more."""
        self._add("reader_gid_seq", reader)

    def add_writer(self, writer: Any) -> None:
        """Tells of one more."""
        self._add("writer_gid_seq", writer)

    def _add(self, which: str, entity: Any) -> None:
        with self._lock:
            self._gids[which].append(self._gid(entity))
            self._tell()

    def _gid(self, entity: Any) -> Any:
        """The id of an entity; longer ones, of older distributions, end with zeros."""
        kind = f"{PACKAGE}/Gid"
        length = self._types.fields(kind)[0][1][1][1]
        return self._types.make(kind, data=np.frombuffer(entity.guid.bytes.ljust(length, b"\0"), np.uint8))

    def _tell(self) -> None:
        node = self._types.make(f"{PACKAGE}/NodeEntitiesInfo", **self._place, **self._gids)
        seen = self._types.make(self._kind, gid=self._gid(self._participant), node_entities_info_seq=[node])
        self._writer.write(self._raw(self._types.encode(self._kind, seen)))
