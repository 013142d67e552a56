# SPDX-License-Identifier: Apache-2.0
"""Types of ROS 2's messages, and CDR: by the package rosbags, whose definitions are those of a distribution."""

from __future__ import annotations

import os
import threading
from functools import cache
from typing import Any, Final

from ggslam.errors import MiddlewareError, MissingDependency
from ggslam.middleware.definitions import EMPTY_FIELD, MESSAGES, SERVICES, request_of, response_of
from ggslam.middleware.hashes import message_hash, service_hash
from ggslam.middleware.names import KIND

DISTRIBUTIONS: Final = ("humble", "iron", "jazzy", "kilted")
DEFAULT_DISTRIBUTION: Final = "jazzy"
WITHOUT_HASHES: Final = ("humble",)
"""Distributions whose types have no hash."""


class MessageTypes:
    """The message types of a distribution of ROS 2. May be used from several threads.

    Attributes:
        distribution: its name.
    """

    def __init__(self, distribution: str) -> None:
        try:
            from rosbags.typesys import Stores, get_types_from_msg, get_typestore
        except ImportError as error:
            raise MissingDependency(f"messages of ROS 2 need rosbags: pip install 'ggslam[ros2]' ({error})") from None
        self.distribution = distribution
        self._lock = threading.Lock()
        self._store = get_typestore(Stores[f"ROS2_{distribution.upper()}"])
        self._parse = get_types_from_msg
        self._hashes: dict[str, str] = {}
        self.register(MESSAGES)
        for service, (request, response) in SERVICES.items():
            self.register_service(service, request, response)

    def register(self, definitions: dict[str, str]) -> None:
        """Adds messages by their definitions in ROS's language; types that are known stay as they are.

        Raises:
            MiddlewareError: a definition or its name is none.
        """
        for kind, text in definitions.items():
            self._add(kind, text)

    def register_service(self, service: str, request: str, response: str) -> None:
        """Adds a service such as `std_srvs/srv/Trigger` by the definitions of its request and its response; they are
        types of their own, `std_srvs/srv/Trigger_Request` and `..._Response`.

        Raises:
            MiddlewareError: a definition or its name is none.
        """
        self._add(request_of(service), request)
        self._add(response_of(service), response)

    def _add(self, kind: str, text: str) -> None:
        found = KIND.fullmatch(kind)
        if not found:
            raise MiddlewareError(f"`{kind}` is no type: expected as sensor_msgs/msg/Image")
        package, group, name = found.groups()
        with self._lock:
            if kind in self._store.types:
                return
            lines = [line.split("#")[0].strip() for line in text.splitlines()]
            if not any(line and "=" not in line.split("<=")[0] for line in lines):
                text += f"\nuint8 {EMPTY_FIELD}\n"
            try:  # the package reads a name with another group than msg as a package's
                parsed = self._parse(text, f"{package}/msg/{name}")[f"{package}/msg/{name}"]
                for other in references(parsed[1]):
                    if other not in self._store.types:
                        raise MiddlewareError(f"no message type {other} is known")
                self._store.register({kind: parsed})
            except Exception as error:  # the package raises many types
                raise MiddlewareError(f"`{kind}`: its definition cannot be read: {error}") from None

    def fields(self, kind: str) -> list[tuple[str, Any]]:
        """Names and types of a message's fields, as rosbags describes them; raises MiddlewareError if it is unknown."""
        if kind not in self._store.fielddefs:
            raise MiddlewareError(f"no message type {kind} is known")
        return list(self._store.fielddefs[kind][1])

    def make(self, kind: str, **fields: Any) -> Any:
        """A message; raises MiddlewareError if there is no such type."""
        if kind not in self._store.types:
            raise MiddlewareError(f"no message type {kind} is known")
        if not fields and [name for name, _ in self._store.fielddefs[kind][1]] == [EMPTY_FIELD]:
            fields = {EMPTY_FIELD: 0}
        return self._store.types[kind](**fields)

    def encode(self, kind: str, message: Any) -> bytes:
        """CDR, little-endian, with its header of four bytes."""
        with self._lock:
            return bytes(self._store.serialize_cdr(message, kind))

    def decode(self, kind: str, content: bytes) -> Any:
        """The message in CDR.

        Raises:
            MiddlewareError: it is damaged, or of another type.
        """
        if kind not in self._store.types:
            raise MiddlewareError(f"no message type {kind} is known")
        try:
            with self._lock:
                return self._store.deserialize_cdr(content, kind)
        except Exception as error:  # the package raises many types
            raise MiddlewareError(f"{len(content)} bytes are no {kind}: {error or type(error).__name__}") from None

    def hash(self, kind: str) -> str:
        """RIHS01 hash of a message or of a service; "TypeHashNotSupported" where the distribution has none."""
        if self.distribution in WITHOUT_HASHES:
            return "TypeHashNotSupported"
        with self._lock:
            if kind not in self._hashes:
                defined = self._store.fielddefs
                if kind in defined:
                    self._hashes[kind] = message_hash(kind, defined)
                elif request_of(kind) in defined and response_of(kind) in defined:
                    self._hashes[kind] = service_hash(kind, defined)
                else:
                    raise MiddlewareError(f"no type {kind} is known")
            return self._hashes[kind]


def references(fields: list[tuple[str, Any]]) -> set[str]:
    """Types that fields refer to, as rosbags describes them: (node, rest), where nodes are BASE 1, NAME 2, ARRAY 3 and
    SEQUENCE 4."""
    inner = [desc[1][0] if int(desc[0]) in (3, 4) else desc for _, desc in fields]
    return {desc[1] for desc in inner if int(desc[0]) == 2}


@cache
def message_types(distribution: str | None = None) -> MessageTypes:
    """Those of a distribution; None: of ROS_DISTRO, else of jazzy.

    Raises:
        MiddlewareError: there is no such distribution.
        MissingDependency: rosbags is not installed.
    """
    name = (distribution or os.environ.get("ROS_DISTRO") or DEFAULT_DISTRIBUTION).lower()
    if name not in DISTRIBUTIONS:
        raise MiddlewareError(f"{name}: expected a distribution of ROS 2: {', '.join(DISTRIBUTIONS)}")
    return MessageTypes(name)
