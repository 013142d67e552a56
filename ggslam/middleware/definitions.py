# SPDX-License-Identifier: Apache-2.0
"""Definitions, in ROS's language, of public messages and services that rosbags does not bring."""

from __future__ import annotations

from typing import Final

EMPTY_FIELD: Final = "structure_needs_at_least_one_member"
"""The only field, uint8 and 0, of a message that has none."""

MESSAGES: Final = {
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
"""vision_msgs 4 and map_msgs."""

SERVICES: Final = {
    "std_srvs/srv/Empty": ("", ""),
    "std_srvs/srv/Trigger": ("", "bool success\nstring message\n"),
    "std_srvs/srv/SetBool": ("bool data\n", "bool success\nstring message\n"),
    "nav_msgs/srv/GetPlan": (
        "geometry_msgs/PoseStamped start\ngeometry_msgs/PoseStamped goal\nfloat32 tolerance\n",
        "nav_msgs/Path plan\n",
    ),
}
"""Requests and responses of services."""


def request_of(service: str) -> str:
    """Type of a service's requests: `std_srvs/srv/Trigger_Request`."""
    return service + "_Request"


def response_of(service: str) -> str:
    """Type of a service's responses."""
    return service + "_Response"


def event_of(service: str) -> str:
    """Type of what introspection of a service sends."""
    return service + "_Event"
