# SPDX-License-Identifier: Apache-2.0
"""Names of ROS 2 on the network: full names of topics, what is a name, and how types are written in DDS."""

from __future__ import annotations

import re
from typing import Final

from ggslam.errors import MiddlewareError

LONGEST: Final = 255
"""Characters of the longest name of a topic that DDS takes, with the prefix of two letters that ROS 2 adds."""
TOKEN: Final = re.compile(r"[A-Za-z_][A-Za-z0-9_]*")
KIND: Final = re.compile(r"([a-zA-Z][a-zA-Z0-9_]*)/(msg|srv|action)/([A-Za-z][A-Za-z0-9_]*)")
DDS_KIND: Final = re.compile(r"([A-Za-z0-9_]+)::(msg|srv|action)::dds_::([A-Za-z0-9_]+?)_")


def check_node_name(name: str) -> str:
    """The name of a node; raises MiddlewareError if it is none."""
    if not TOKEN.fullmatch(name):
        raise MiddlewareError(f"`{name}` is no name of a node: expected letters, digits and _, no digit first")
    return name


def full_namespace(namespace: str) -> str:
    """With a slash first and none at the end: `/` or `/robot1`; raises MiddlewareError if it is no namespace."""
    inner = namespace.strip("/")
    return check_full("/" + inner, "namespace") if inner else "/"


def full_name(namespace: str, topic: str) -> str:
    """The full name of a topic or service: in the namespace unless it begins with a slash.

    Raises:
        MiddlewareError: it is not a name that ROS 2 takes.
    """
    if topic.startswith("/"):
        return check_full(topic, "topic")
    return check_full(full_namespace(namespace).rstrip("/") + "/" + topic, "topic")


def check_full(name: str, what: str) -> str:
    """A full name; raises MiddlewareError if it is none."""
    if not name.startswith("/") or not all(TOKEN.fullmatch(token) for token in name[1:].split("/")):
        raise MiddlewareError(f"`{name}` is no name of a {what}: expected /words of letters, digits and _")
    if "__" in name:
        raise MiddlewareError(f"`{name}` is no name of a {what}: ROS 2 forbids two underscores in a row")
    if len(name) > LONGEST - len("rt"):
        raise MiddlewareError(f"`{name[:40]}...` is no name of a {what}: longer than {LONGEST - 2} characters")
    return name


def check_kind(kind: str) -> str:
    """A type as `sensor_msgs/msg/Image`; raises MiddlewareError if it is none."""
    if not KIND.fullmatch(kind):
        raise MiddlewareError(f"`{kind}` is no type: expected as sensor_msgs/msg/Image")
    return kind


def dds_kind(kind: str) -> str:
    """The type's name in DDS: `sensor_msgs::msg::dds_::Image_` of `sensor_msgs/msg/Image`."""
    package, group, name = check_kind(kind).split("/")
    return f"{package}::{group}::dds_::{name}_"


def ros_kind(kind: str) -> str | None:
    """The type by its name in DDS; None where it is none of ROS 2."""
    found = DDS_KIND.fullmatch(kind)
    return "/".join(found.groups()) if found else None
