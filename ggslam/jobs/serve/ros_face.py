# SPDX-License-Identifier: Apache-2.0
"""The functions of a map as services of ROS 2, `ggslam/NAME` in the node's namespace.

    ggslam/status, ggslam/verdicts, ggslam/reset    std_srvs/srv/Trigger; the message is JSON
    ggslam/pause                                    std_srvs/srv/SetBool
    ggslam/save_map                                 ggslam_msgs/srv/SaveMap
    ggslam/query_distance                           ggslam_msgs/srv/QueryDistance
    ggslam/localize                                 ggslam_msgs/srv/Localize
    ggslam/plan                                     nav_msgs/srv/GetPlan; no path: one without poses
"""

from __future__ import annotations

import json
import logging
from collections.abc import Callable
from functools import partial
from typing import Any, Final

import numpy as np

from ggslam.errors import ConfigError, GgslamError
from ggslam.jobs.serve.channels import MAP
from ggslam.jobs.serve.services import MapServices
from ggslam.messages.ros2_geometry import pose
from ggslam.middleware.definitions import response_of
from ggslam.middleware.node import Node
from ggslam.middleware.types import MessageTypes
from ggslam.scene.camera import Camera
from ggslam.sequences.formats.ros_images import color_image, depth_in_unit
from ggslam.system.json_files import json_ready

_log = logging.getLogger(__name__)
TRIGGER: Final = "std_srvs/srv/Trigger"
SET_BOOL: Final = "std_srvs/srv/SetBool"
GET_PLAN: Final = "nav_msgs/srv/GetPlan"
SAVE_MAP: Final = "ggslam_msgs/srv/SaveMap"
QUERY: Final = "ggslam_msgs/srv/QueryDistance"
LOCALIZE: Final = "ggslam_msgs/srv/Localize"
OWN: Final = {
    SAVE_MAP: ("string name\n", "bool success\nstring message\n"),
    QUERY: (
        "std_msgs/Header header\ngeometry_msgs/Point[] points\n",
        "bool success\nstring message\nfloat32[] distances\ngeometry_msgs/Vector3[] gradients\n",
    ),
    LOCALIZE: (
        "sensor_msgs/Image color\nsensor_msgs/Image depth\nsensor_msgs/CameraInfo camera\n",
        "bool success\nstring message\ngeometry_msgs/PoseStamped pose\nfloat32 overlap\n",
    ),
}  # fmt: skip
"""Our own services: requests and responses. Distances are NaN where nothing is known. A camera of width 0 is the
run's; the pose is that of the optical frame."""


class RosFace:
    """Offers functions over a node, until it is closed.

    Args:
        node: that offers them.
        types: of messages; our own are added.
        services: that answer.
    """

    def __init__(self, node: Node, types: MessageTypes, services: MapServices) -> None:
        self._types, self._services = types, services
        for kind, (request, response) in OWN.items():
            types.register_service(kind, request, response)
        for name in ("status", "verdicts", "reset"):
            node.offer(f"ggslam/{name}", TRIGGER, partial(self._trigger, name))
        node.offer("ggslam/pause", SET_BOOL, self._pause)
        node.offer("ggslam/save_map", SAVE_MAP, self._save_map)
        node.offer("ggslam/query_distance", QUERY, self._query)
        node.offer("ggslam/localize", LOCALIZE, self._localize)
        node.offer("ggslam/plan", GET_PLAN, self._plan)

    def _call(self, name: str, values: Callable[[], dict[str, Any]]) -> tuple[dict[str, Any], str]:
        """What a function returns, and why it does not."""
        return self._try(name, lambda: self._services.call(name, values()))

    def _try(self, name: str, function: Callable[[], dict[str, Any]]) -> tuple[dict[str, Any], str]:
        """The same; nothing that is asked makes it raise."""
        try:
            return function(), ""
        except GgslamError as error:
            return {}, str(error)
        except Exception as error:  # whoever asked is to be told, too
            _log.exception("a service failed")
            return {}, f"{name} failed: {type(error).__name__}"

    def _trigger(self, name: str, request: Any) -> Any:
        found, error = self._call(name, dict)
        message = error or json.dumps(json_ready(found))
        return self._types.make(response_of(TRIGGER), success=not error, message=message)

    def _pause(self, request: Any) -> Any:
        found, error = self._call("pause", lambda: {"on": bool(request.data)})
        message = error or json.dumps(json_ready(found))
        return self._types.make(response_of(SET_BOOL), success=not error, message=message)

    def _save_map(self, request: Any) -> Any:
        found, error = self._call("save_map", lambda: {"name": str(request.name)})
        return self._types.make(response_of(SAVE_MAP), success=not error, message=error or found["path"])

    def _query(self, request: Any) -> Any:
        def values() -> dict[str, Any]:
            frame = request.header.frame_id or MAP
            return {"points": [[p.x, p.y, p.z] for p in request.points], "frame": frame}

        found, error = self._call("query_distance", values)
        distances = [np.nan if d is None else d for d in found.get("distance", [])]
        gradients = [self._vector(*g) for g in found.get("gradient", [])]
        return self._types.make(
            response_of(QUERY), success=not error, message=error, distances=np.array(distances, np.float32),
            gradients=gradients,
        )  # fmt: skip

    def _plan(self, request: Any) -> Any:
        def values() -> dict[str, Any]:
            frames = {end.header.frame_id or MAP for end in (request.start, request.goal)}
            if len(frames) != 1:
                raise ConfigError("plan: start and goal are in different frames")
            start, goal = (end.pose.position for end in (request.start, request.goal))
            return {"start": [start.x, start.y, start.z], "goal": [goal.x, goal.y, goal.z], "frame": frames.pop()}

        found, error = self._call("plan", values)
        if error or not found["found"]:
            _log.warning("plan: %s", error or found["reason"])
        frame = found.get("frame", MAP)
        poses = []
        for point in found.get("points", []):
            T = np.eye(4)
            T[:3, 3] = point
            poses.append(self._pose_in(frame, T))
        path = self._types.make("nav_msgs/msg/Path", header=self._header(frame), poses=poses)
        return self._types.make(response_of(GET_PLAN), plan=path)

    def _localize(self, request: Any) -> Any:
        def locate() -> dict[str, Any]:
            color, depth = color_image("color", request.color), depth_in_unit("depth", request.depth, True)
            return self._services.locate(color, depth, _camera(request.camera))

        found, error = self._try("localize", locate)
        error = error or ("" if found["located"] else found["reason"])
        T = np.array(found.get("T_map_optical", np.eye(4)))
        return self._types.make(
            response_of(LOCALIZE), success=not error, message=error, pose=self._pose_in(MAP, T),
            overlap=float(found.get("overlap", 0.0)),
        )  # fmt: skip

    # --- messages ----------------------------------------------------------------------------------------------------

    def _header(self, frame: str) -> Any:
        time = self._types.make("builtin_interfaces/msg/Time", sec=0, nanosec=0)
        return self._types.make("std_msgs/msg/Header", stamp=time, frame_id=frame)

    def _pose_in(self, frame: str, T: np.ndarray) -> Any:
        made = pose(self._types, T)
        return self._types.make("geometry_msgs/msg/PoseStamped", header=self._header(frame), pose=made)

    def _vector(self, x: float, y: float, z: float) -> Any:
        return self._types.make("geometry_msgs/msg/Vector3", x=x, y=y, z=z)


def _camera(info: Any) -> Camera | None:
    """Of sensor_msgs/CameraInfo; None: it says none."""
    if not info.width:
        return None
    fx, _, cx, _, fy, cy, *_ = np.asarray(info.k, float).ravel().tolist()
    try:
        return Camera(int(info.width), int(info.height), fx, fy, cx, cy)
    except Exception:
        raise ConfigError("camera: expected width, height, fx, fy, cx, cy of a camera") from None
