# SPDX-License-Identifier: Apache-2.0
"""What rmw_zenoh_cpp writes beside messages: key expressions, tokens by which it shows the graph, and attachments."""

from __future__ import annotations

import hashlib
import struct
from dataclasses import dataclass
from typing import Final, Literal

from ggslam.middleware.names import dds_kind, ros_kind
from ggslam.middleware.node import Qos

SPACE: Final = "@ros2_lv"
"""Prefix of all tokens."""
GID_BYTES: Final = 16
ATTACHMENT: Final = struct.Struct(f"<qqB{GID_BYTES}s")
"""Number, nanoseconds since 1970, length of the sender's id, and the id."""

Entity = Literal["NN", "MP", "MS", "SS", "SC"]
"""Node, publisher, subscription, service, client."""


def key(domain: int, name: str, kind: str, type_hash: str) -> str:
    """Key expression of a topic or service by its full name; "*" as hash means any."""
    return f"{domain}/{name.strip('/')}/{dds_kind(kind)}/{type_hash}"


def qos_text(qos: Qos) -> str:
    """Quality of service as tokens have it: reliability, durability, history and depth as numbers of rmw, the default
    ones (reliable, volatile, keep last) left out; deadline, lifespan and liveliness are the defaults."""
    return f"{'' if qos.reliable else 2}:{1 if qos.latched else ''}:,{qos.depth}:,:,:,,"


def mangle(name: str) -> str:
    """A name as one part of a token."""
    return name.replace("/", "%") or "%"


@dataclass(frozen=True)
class NodeMark:
    """What tokens of a node begin with."""

    domain: int
    session: str
    namespace: str
    name: str

    def node_token(self) -> str:
        """The node's token."""
        return self._token(0, "NN")

    def token(self, number: int, entity: Entity, name: str, kind: str, type_hash: str, qos: Qos) -> str:
        """Token of something of the node; numbers of a node are different."""
        return f"{self._token(number, entity)}/{mangle(name)}/{dds_kind(kind)}/{type_hash}/{qos_text(qos)}"

    def _token(self, number: int, entity: Entity) -> str:
        place = f"{SPACE}/{self.domain}/{self.session}/0/{number}/{entity}"
        return f"{place}/%/{mangle(self.namespace)}/{mangle(self.name)}"


@dataclass(frozen=True)
class Shown:
    """What a token of somebody tells: kinds of others than ROS 2's are not shown."""

    entity: str
    name: str
    kind: str
    type_hash: str


def read_token(token: str) -> Shown | None:
    """What a token tells of a topic or service; None: of nothing such."""
    parts = token.split("/")
    if len(parts) < 13 or parts[0] != SPACE or parts[5] not in ("MP", "MS", "SS", "SC"):
        return None
    kind = ros_kind(parts[10])
    return Shown(parts[5], parts[9].replace("%", "/"), kind, parts[11]) if kind else None


def gid_of(token: str) -> bytes:
    """An id of 16 bytes for whoever has a token. Peers only compare it."""
    return hashlib.blake2b(token.encode(), digest_size=GID_BYTES).digest()


def attachment(number: int, stamp_ns: int, gid: bytes) -> bytes:
    """What goes with each message, request and response."""
    return ATTACHMENT.pack(number, stamp_ns, GID_BYTES, gid)


def read_attachment(content: bytes) -> tuple[int, int, bytes] | None:
    """(number, nanoseconds since 1970, id of the sender); None: it is none."""
    if len(content) != ATTACHMENT.size:
        return None
    number, stamp_ns, length, gid = ATTACHMENT.unpack(content)
    return (number, stamp_ns, gid) if length == GID_BYTES and number >= 0 else None
