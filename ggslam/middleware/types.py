# SPDX-License-Identifier: Apache-2.0
"""Types of ROS 2's messages, and CDR: by the package rosbags, whose definitions are those of a distribution."""

from __future__ import annotations

import os
import threading
from functools import cache
from typing import Any, Final

from ggslam.errors import MiddlewareError, MissingDependency

DISTRIBUTIONS: Final = ("humble", "iron", "jazzy", "kilted")
DEFAULT_DISTRIBUTION: Final = "jazzy"
WITHOUT_HASHES: Final = ("humble",)
"""Distributions whose types have no hash."""

ADDED: Final = {
    "map_msgs/msg/OccupancyGridUpdate": """
std_msgs/Header header
int32 x
int32 y
uint32 width
uint32 height
int8[] data
""",
    "vision_msgs/msg/Point2D": "float64 x\nfloat64 y\n",
    "vision_msgs/msg/ObjectHypothesis": "string class_id\nfloat64 score\n",
    "vision_msgs/msg/ObjectHypothesisWithPose": """
vision_msgs/ObjectHypothesis hypothesis
geometry_msgs/PoseWithCovariance pose
""",
    "vision_msgs/msg/BoundingBox3D": "geometry_msgs/Pose center\ngeometry_msgs/Vector3 size\n",
    "vision_msgs/msg/Detection3D": """
std_msgs/Header header
vision_msgs/ObjectHypothesisWithPose[] results
vision_msgs/BoundingBox3D bbox
string id
""",
    "vision_msgs/msg/Detection3DArray": "std_msgs/Header header\nvision_msgs/Detection3D[] detections\n",
}
"""Definitions of public messages that rosbags does not bring (vision_msgs 4, map_msgs)."""


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
        for kind, text in ADDED.items():
            if kind not in self._store.types:
                self._store.register(get_types_from_msg(text, kind))

    def register(self, definitions: dict[str, str]) -> None:
        """Adds types by their definitions in ROS's language, such as those of services."""
        from rosbags.typesys import get_types_from_msg

        with self._lock:
            for kind, text in definitions.items():
                if kind not in self._store.types:
                    self._store.register(get_types_from_msg(text, kind))

    def make(self, kind: str, **fields: Any) -> Any:
        """A message; raises MiddlewareError if there is no such type."""
        if kind not in self._store.types:
            raise MiddlewareError(f"no message type {kind} is known")
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
        """RIHS01 hash of a type; "TypeHashNotSupported" where the distribution has none."""
        if self.distribution in WITHOUT_HASHES:
            return "TypeHashNotSupported"
        with self._lock:
            return str(self._store.hash_rihs01(kind))


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
