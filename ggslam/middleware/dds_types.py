# SPDX-License-Identifier: Apache-2.0
"""Types of ROS 2 as DDS has them. Samples carry CDR as it is: rosbags writes and reads it, and the serialiser of
cyclonedds, that goes through an image byte by byte, has no part in it."""

from __future__ import annotations

import re
from typing import Any, Final

from ggslam.errors import MiddlewareError
from ggslam.middleware.names import dds_kind
from ggslam.middleware.types import MessageTypes

BASES: Final = {
    "int8": "int8", "uint8": "uint8", "byte": "uint8", "char": "uint8", "int16": "int16", "uint16": "uint16",
    "int32": "int32", "uint32": "uint32", "int64": "int64", "uint64": "uint64", "float32": "float32",
    "float64": "float64",
}  # fmt: skip
"""Basic types by rosbags' names; rmw_cyclonedds_cpp, too, shows byte and char as uint8."""
SERVICE_PART: Final = re.compile(r"\w+/srv/\w+_(Request|Response)")


class RawTypes:
    """Classes of samples for cyclonedds, by the types of a distribution."""

    def __init__(self, types: MessageTypes) -> None:
        self._types = types
        self._structs: dict[str, type] = {}
        self._raw: dict[str, type] = {}

    def raw(self, kind: str) -> type:
        """The class of a type's samples: it is made of `content`, CDR with its header, and has it. Requests and
        responses of services have the header of rmw_cyclonedds_cpp in front."""
        if kind not in self._raw:
            self._raw[kind] = make_raw(self._make(kind))
        return self._raw[kind]

    def _struct(self, kind: str) -> type:
        if kind not in self._structs:
            self._structs[kind] = self._make(kind)
        return self._structs[kind]

    def _make(self, kind: str) -> type:
        from cyclonedds.idl import make_idl_struct, types

        fields = {name: self._member(desc) for name, desc in self._types.fields(kind)}
        if SERVICE_PART.fullmatch(kind):
            fields = {"header_guid": types.uint64, "header_sequence": types.int64, **fields}
        return make_idl_struct(kind.split("/")[-1], dds_kind(kind), fields)

    def _member(self, desc: Any) -> Any:
        """Type of a member by rosbags' description: (node, rest), where nodes are BASE 1, NAME 2, ARRAY 3, SEQUENCE
        4."""
        from cyclonedds.idl import types as idl

        types: Any = idl
        node, rest = int(desc[0]), desc[1]
        if node == 3:
            return types.array[self._member(rest[0]), rest[1]]
        if node == 4:
            inner = self._member(rest[0])
            return types.sequence[inner, rest[1]] if rest[1] else types.sequence[inner]
        if node == 2:
            return self._struct(rest)
        if rest[0] == "string":
            return types.bounded_str[rest[1]] if rest[1] else str
        if rest[0] == "bool":
            return bool
        if rest[0] not in BASES:
            raise MiddlewareError(f"DDS here has no type {rest[0]}")
        return getattr(types, BASES[rest[0]])


def make_raw(struct: Any) -> type:
    """Has a struct's samples carry CDR as it is."""

    def begin(self: Any, content: bytes = b"") -> None:
        self.content = content

    def serialize(self: Any, *_: Any, **__: Any) -> bytes:
        return self.content

    def deserialize(cls: Any, content: bytes, *_: Any, **__: Any) -> Any:
        return cls(content)

    struct.__init__ = begin
    struct.serialize = serialize
    struct.deserialize = classmethod(deserialize)
    struct.deserialize_key = classmethod(deserialize)
    return struct
