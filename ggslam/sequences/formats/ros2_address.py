# SPDX-License-Identifier: Apache-2.0
"""Addresses of live topics of ROS 2, as `ros2://camera/color,camera/depth?middleware=dds&domain=3`."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Final
from urllib.parse import parse_qsl, urlencode

from ggslam.errors import SequenceError
from ggslam.middleware.names import full_name
from ggslam.middleware.node import HIGHEST_DOMAIN
from ggslam.middleware.opening import NodeRequest
from ggslam.sequences.association import PairingTuning

SCHEME: Final = "ros2"
TOPIC_ROLES: Final = ("color", "depth", "color_info", "depth_info")
"""In the order in which an address names topics; each may also be named as ROLE=TOPIC."""
WAIT_S: Final = 10.0
"""Seconds that the first messages are waited for, if the address does not say."""
_LAYOUT: Final = "expected ros2://COLOR,DEPTH[,CAMERA_INFO], as ros2://camera/color,camera/depth"


@dataclass(frozen=True)
class TopicsAddress:
    """Which topics to read, and how.

    Attributes:
        topics: full names by role; "color" and "depth" are there.
        node: how to join the network.
        reliable: whether lost messages are asked for again (qos=reliable); else best effort, as for sensors.
        tolerance_s: largest time between colour and depth.
        wait_s: how long the first messages are waited for.
        idle_s: silence after which the frames end; None: they do not.
    """

    topics: dict[str, str]
    node: NodeRequest = field(default_factory=NodeRequest)
    reliable: bool = False
    tolerance_s: float = PairingTuning.tolerance_s
    wait_s: float = WAIT_S
    idle_s: float | None = None


def parse_address(text: str) -> TopicsAddress:
    """Reads an address; one slash after the scheme is as good as two, which paths do not keep.

    Raises:
        SequenceError: it is none; names the part.
        MiddlewareError: a topic's name is none.
    """
    scheme, _, rest = text.partition(":")
    named, _, query = rest.lstrip("/").partition("?")
    text = f"{scheme}://{rest.lstrip('/')}" if scheme == SCHEME else text
    if scheme != SCHEME or not named:
        raise SequenceError(f"{text}: {_LAYOUT}")
    values = _values(text, query)
    node = NodeRequest(**{name: values.pop(name) for name in _NODE if name in values})
    topics: dict[str, str] = {}
    for place, word in enumerate(named.split(",")):
        role, equals, topic = word.rpartition("=")
        role = role if equals else TOPIC_ROLES[place] if place < len(TOPIC_ROLES) else ""
        if role not in TOPIC_ROLES or role in topics or not topic:
            raise SequenceError(f"{text}: {_LAYOUT}, found {word!r}")
        topics[role] = full_name(node.namespace, topic)
    if not {"color", "depth"} <= set(topics):
        raise SequenceError(f"{text}: {_LAYOUT}")
    reliable = values.pop("qos", "sensor") == "reliable"
    return TopicsAddress(topics, node, reliable, **values)


def add_network(place: Path, node: NodeRequest) -> Path:
    """An address with what a request says of the network; what the address itself says counts."""
    text, plain = str(place), NodeRequest()
    named, _, query = text.partition("?")
    own = dict(parse_qsl(query))
    asked = {name: str(getattr(node, name)) for name in _NODE if getattr(node, name) != getattr(plain, name)}
    told = urlencode({**own, **{name: asked[name] for name in asked if name not in own}}, safe="/:,")
    return Path(f"{named}?{told}" if told else named)


def _values(text: str, query: str) -> dict[str, Any]:
    values: dict[str, Any] = {}
    for name, value in parse_qsl(query, keep_blank_values=True):
        if name not in _KEYS:
            raise SequenceError(f"{text}: expected one of {', '.join(_KEYS)} after the ?, found {name!r}")
        field_name, read = _KEYS[name]
        try:
            values[field_name] = read(value)
        except ValueError as error:
            raise SequenceError(f"{text}: {name}: expected {error}, found {value!r}") from None
    return values


def _one_of(*words: str) -> Callable[[str], str]:
    def read(value: str) -> str:
        if value not in words:
            raise ValueError(" or ".join(words))
        return value

    return read


def _domain(value: str) -> int:
    if not value.isdecimal() or int(value) > HIGHEST_DOMAIN:
        raise ValueError(f"a number from 0 to {HIGHEST_DOMAIN}")
    return int(value)


def _seconds(value: str) -> float:
    try:
        number = float(value)
    except ValueError:
        number = math.nan
    if not 0 < number < 1e6:
        raise ValueError("seconds, above 0")
    return number


_NODE: Final = ("middleware", "domain", "namespace", "address", "distribution")
_KEYS: Final[dict[str, tuple[str, Callable[[str], Any]]]] = {
    "middleware": ("middleware", _one_of("zenoh", "dds")), "domain": ("domain", _domain),
    "namespace": ("namespace", str), "address": ("address", str), "distribution": ("distribution", str),
    "qos": ("qos", _one_of("reliable", "sensor")), "tolerance": ("tolerance_s", _seconds),
    "wait": ("wait_s", _seconds), "idle": ("idle_s", _seconds),
}  # fmt: skip
"""What may stand after the ?: the field, and what reads it."""

