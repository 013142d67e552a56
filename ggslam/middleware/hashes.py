# SPDX-License-Identifier: Apache-2.0
"""Hashes of types, RIHS01 as REP 2016 defines them: SHA-256 of a type's description in JSON with all it refers to."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Mapping
from typing import Any, Final

from ggslam.middleware.definitions import event_of, request_of, response_of

NESTED: Final = 1
BOUNDED_STRING: Final = 21
BASES: Final = {
    "int8": 2, "uint8": 3, "int16": 4, "uint16": 5, "int32": 6, "uint32": 7, "int64": 8, "uint64": 9, "float32": 10,
    "float64": 11, "float128": 12, "char": 3, "bool": 15, "byte": 16, "octet": 16, "string": 17,
}  # fmt: skip
"""Numbers of the basic types in type_description_interfaces. `char` of a .msg file is uint8 in its .idl file."""
ARRAY, BOUNDED_SEQUENCE, SEQUENCE = 48, 96, 144
EVENT_INFO: Final = "service_msgs/msg/ServiceEventInfo"
TIME: Final = "builtin_interfaces/msg/Time"

Description = dict[str, Any]


def base(name: str, number: int, capacity: int = 0, string_capacity: int = 0, nested: str = "") -> Description:
    """A field in a description."""
    kind = {"type_id": number, "capacity": capacity, "string_capacity": string_capacity, "nested_type_name": nested}
    return {"name": name, "type": kind}


def message_hash(kind: str, fields: Mapping[str, Any]) -> str:
    """Hash of a message by its definition and those it refers to: (constants, fields) by type, as rosbags has them."""
    known: dict[str, Description] = {}
    describe(kind, fields, known)
    return digest(kind, known)


def service_hash(kind: str, fields: Mapping[str, Any]) -> str:
    """Hash of a service: of a struct of its request, its response, and its event, that introspection sends."""
    known: dict[str, Description] = {}
    request, response, event = request_of(kind), response_of(kind), event_of(kind)
    for name in (request, response):
        describe(name, fields, known)
    known[TIME] = {"type_name": TIME, "fields": [base("sec", BASES["int32"]), base("nanosec", BASES["uint32"])]}
    info = [
        base("event_type", BASES["uint8"]),
        base("stamp", NESTED, nested=TIME),
        base("client_gid", ARRAY + BASES["char"], 16),
        base("sequence_number", BASES["int64"]),
    ]
    known[EVENT_INFO] = {"type_name": EVENT_INFO, "fields": info}
    parts = [
        base("info", NESTED, nested=EVENT_INFO),
        base("request", BOUNDED_SEQUENCE + NESTED, 1, nested=request),
        base("response", BOUNDED_SEQUENCE + NESTED, 1, nested=response),
    ]
    known[event] = {"type_name": event, "fields": parts}
    whole = [
        base("request_message", NESTED, nested=request),
        base("response_message", NESTED, nested=response),
        base("event_message", NESTED, nested=event),
    ]
    known[kind] = {"type_name": kind, "fields": whole}
    return digest(kind, known)


def describe(kind: str, fields: Mapping[str, Any], known: dict[str, Description]) -> None:
    """Adds the description of a type and of all it refers to."""
    if kind not in known:
        known[kind] = {"type_name": kind, "fields": []}
        listed = [describe_field(name, desc, fields, known) for name, desc in fields[kind][1]]
        known[kind]["fields"] = listed or [base("structure_needs_at_least_one_member", BASES["uint8"])]


def describe_field(name: str, desc: Any, fields: Mapping[str, Any], known: dict[str, Description]) -> Description:
    """The description of a field by rosbags' one: (node, rest), where nodes are BASE 1, NAME 2, ARRAY 3, SEQUENCE 4."""
    node, rest = int(desc[0]), desc[1]
    number = capacity = 0
    if node in (3, 4):
        capacity = rest[1]
        number = ARRAY if node == 3 else BOUNDED_SEQUENCE if capacity else SEQUENCE
        node, rest = int(rest[0][0]), rest[0][1]
    if node == 2:
        describe(rest, fields, known)
        return base(name, number + NESTED, capacity, nested=rest)
    bounded = rest[0] == "string" and rest[1]
    kind = BOUNDED_STRING if bounded else BASES[rest[0]]
    return base(name, number + kind, capacity, rest[1] if bounded else 0)


def digest(kind: str, known: dict[str, Description]) -> str:
    """RIHS01 of descriptions."""
    others = [known[name] for name in sorted(known) if name != kind]
    text = json.dumps({"type_description": known[kind], "referenced_type_descriptions": others})
    return "RIHS01_" + hashlib.sha256(text.encode()).hexdigest()
