# SPDX-License-Identifier: Apache-2.0
"""Finds topics of ROS 2 on the network: their types, and the camera_info that belongs to them."""

from __future__ import annotations

import time
from collections.abc import Callable
from typing import Final

from ggslam.errors import SequenceError
from ggslam.middleware.node import Node
from ggslam.sequences.formats.ros2_address import TopicsAddress
from ggslam.sequences.formats.ros_messages import short_type
from ggslam.sequences.formats.ros_topics import IMAGE_TYPES, INFO_TYPE, info_above
from ggslam.system.plurals import quantity
from ggslam.system.tuning import Tuning

TRANSPORTS: Final = {"color": "/compressed", "depth": "/compressedDepth"}
"""How image_transport names topics of compressed images."""


class DiscoveryTuning(Tuning):
    """How the network is looked at."""

    look_s = 0.05
    """Seconds between two looks."""
    told = 12
    """Topics that are named where one is missing."""


def wait_until(found: Callable[[], bool], seconds: float) -> bool:
    """Looks again and again until it is found, or time is up; whether it is."""
    end = time.monotonic() + seconds
    while not found():
        if time.monotonic() > end:
            return False
        time.sleep(DiscoveryTuning.look_s)
    return True


def find_live_topics(node: Node, address: TopicsAddress) -> dict[str, str]:
    """Full names of the topics by role, once somebody publishes them: "depth_info" may be absent. Where only compressed
    images are published beside a name, they are it.

    Raises:
        SequenceError: one is not there in time, or of another type; says which, and what is there.
    """
    topics: dict[str, str] = {}

    def look() -> bool:
        topics.update(_resolve(node.topics(), address))
        return {"color", "depth", "color_info"} <= set(topics)

    if not wait_until(look, address.wait_s):
        raise SequenceError(_what_is_missing(topics, node.topics(), address))
    kinds = node.topics()
    for role, topic in topics.items():
        wanted = IMAGE_TYPES if role in TRANSPORTS else (INFO_TYPE,)
        kind = short_type(kinds.get(topic, wanted[0]))
        if kind not in wanted:
            raise SequenceError(f"`{topic}` (for {role}): holds {kind}, expected {' or '.join(wanted)}")
    return topics


def _resolve(kinds: dict[str, str], address: TopicsAddress) -> dict[str, str]:
    """What can be seen of the topics of an address."""
    found: dict[str, str] = {}
    for role, topic in address.topics.items():
        names = [name for name in (topic, topic + TRANSPORTS.get(role, "")) if name in kinds]
        if names:
            found[role] = names[0]
    short = {topic: short_type(kind) for topic, kind in kinds.items()}
    for role in TRANSPORTS:
        info = info_above(found[role], short) if role in found else None
        if info is not None:
            found.setdefault(f"{role}_info", info)
    return found


def _what_is_missing(topics: dict[str, str], kinds: dict[str, str], address: TopicsAddress) -> str:
    missing = [topic for role, topic in address.topics.items() if role not in topics]
    if missing:
        what = f"nobody publishes {' and '.join(f'`{topic}`' for topic in missing)}"
    else:
        what = f"no camera_info belongs to `{topics['color']}`, name it as the third topic; none was seen"
    return f"{what} within {address.wait_s:g} s; seen: {seen_topics(kinds)}"


def seen_topics(kinds: dict[str, str]) -> str:
    """The topics that were seen, for messages."""
    if not kinds:
        return "no topic at all (another domain, network or middleware?)"
    listed = [f"{topic} ({short_type(kind)})" for topic, kind in sorted(kinds.items())]
    more = len(listed) - DiscoveryTuning.told
    told = listed[: DiscoveryTuning.told] + ([f"and {quantity(more, 'more')}"] if more > 0 else [])
    return ", ".join(told)
