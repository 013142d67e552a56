# SPDX-License-Identifier: Apache-2.0
"""Functions of a map: over HTTP and over ROS 2 they answer the same, and bad requests get a line."""

from __future__ import annotations

import base64
import http.client
import json
import urllib.error
import urllib.request
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from shutil import copytree
from typing import Any
from urllib.parse import urlsplit

import cv2
import numpy as np
import pytest
from serve_tools import KeptOutlet, LocalNetwork

from ggslam.errors import ConfigError
from ggslam.jobs.serve.http_face import serve_functions
from ggslam.jobs.serve.publishing import MapPublisher
from ggslam.jobs.serve.ros_face import GET_PLAN, LOCALIZE, QUERY, SAVE_MAP, SET_BOOL, TRIGGER, RosFace
from ggslam.jobs.serve.run_contents import RunContents
from ggslam.jobs.serve.run_functions import RunFunctions
from ggslam.jobs.serve.run_volumes import RunVolumes
from ggslam.jobs.serve.services import FUNCTIONS, MapServices, ServiceTuning
from ggslam.jobs.volumes.fuse_volumes import fuse_volumes
from ggslam.middleware.definitions import request_of
from ggslam.runs.folder import RunFolder
from ggslam.runs.recordings import open_recording_of
from ggslam.scene.frame import Frame
from ggslam.scene.poses import separation
from ggslam.viewer.access import AccessTuning
from ggslam.viewer.page_server import PageServer


@pytest.fixture(scope="module")
def run(room_run: RunFolder, tmp_path_factory: pytest.TempPathFactory) -> RunFolder:
    """With volumes."""
    folder = RunFolder.open(copytree(room_run.path, tmp_path_factory.mktemp("served") / "run"))
    fuse_volumes(folder.path, esdf=True, objects=False, voxel=0.04)
    return folder


@contextmanager
def functions_of(run: RunFolder) -> Iterator[MapServices]:
    volumes = RunVolumes(run)
    contents = RunContents(run, volumes)
    publisher = MapPublisher([(KeptOutlet(everybody=0), False)], contents.channels())
    functions = RunFunctions(contents, publisher)
    yield MapServices(functions.functions(), functions.locate)
    functions.close()
    publisher.close()
    volumes.close()


@dataclass
class Faces:
    """Both faces of one map."""

    server: PageServer
    services: MapServices
    network: LocalNetwork
    types: Any

    def http(self, name: str, content: bytes | None = None, token: str | None = None) -> tuple[int, Any]:
        """Status and answer; `content` None: a GET."""
        address, _, own = self.server.address.partition("?token=")
        url = f"{address}{name}?token={own if token is None else token}"
        try:
            with urllib.request.urlopen(urllib.request.Request(url, content), timeout=30) as answer:
                return answer.status, json.load(answer)
        except urllib.error.HTTPError as error:
            text = error.read().decode()
            return error.code, json.loads(text) if text.startswith("{") else text

    def post(self, name: str, /, **values: Any) -> Any:
        """The answer to a question."""
        return self.http(name, json.dumps(values).encode())[1]

    def ros(self, name: str, kind: str, /, **fields: Any) -> Any:
        """The response of a service."""
        client = self.network.node("client")
        return client.call(f"ggslam/{name}", kind, self.types.make(request_of(kind), **fields), 30.0)


@pytest.fixture(scope="module")
def faces(run: RunFolder) -> Iterator[Faces]:
    pytest.importorskip("rosbags")
    from ggslam.middleware.types import MessageTypes

    network, types = LocalNetwork(), MessageTypes("jazzy")
    with functions_of(run) as services:
        RosFace(network.node("ggslam"), types, services)
        server = serve_functions(services, "127.0.0.1", 0)
        yield Faces(server, services, network, types)
        server.close()


def frame_of(run: RunFolder, index: int) -> Frame:
    return open_recording_of(run).frame(index, masks=False)


def png(image: np.ndarray) -> str:
    return base64.b64encode(cv2.imencode(".png", image)[1].tobytes()).decode()


def header(types: Any, frame: str) -> Any:
    stamp = types.make("builtin_interfaces/msg/Time", sec=0, nanosec=0)
    return types.make("std_msgs/msg/Header", stamp=stamp, frame_id=frame)


def image(types: Any, encoding: str, pixels: np.ndarray) -> Any:
    rows = np.frombuffer(np.ascontiguousarray(pixels).tobytes(), np.uint8)
    return types.make(
        "sensor_msgs/msg/Image", header=header(types, "camera"), height=pixels.shape[0], width=pixels.shape[1],
        encoding=encoding, is_bigendian=0, step=len(rows) // pixels.shape[0], data=rows,
    )  # fmt: skip


def no_camera(types: Any) -> Any:
    roi = types.make("sensor_msgs/msg/RegionOfInterest", x_offset=0, y_offset=0, height=0, width=0, do_rectify=False)
    return types.make(
        "sensor_msgs/msg/CameraInfo", header=header(types, ""), height=0, width=0, distortion_model="", d=np.zeros(0),
        k=np.zeros(9), r=np.zeros(9), p=np.zeros(12), binning_x=0, binning_y=0, roi=roi,
    )  # fmt: skip


def test_distances_are_the_same_on_both_faces(faces: Faces, run: RunFolder) -> None:
    places = [[0.0, 0.0, 1.0], [0.1, -0.1, 1.4], [50.0, 0.0, 0.0]]
    told = faces.post("query_distance", points=places)
    field = RunVolumes(run).field().query(np.array(places))
    assert told["ok"] and told["known"] == [True, True, False] and told["distance"][2] is None
    np.testing.assert_allclose(told["distance"][:2], field.distance[:2], rtol=1e-6)
    types = faces.types
    points = [types.make("geometry_msgs/msg/Point", x=x, y=y, z=z) for x, y, z in places]
    response = faces.ros("query_distance", QUERY, header=header(types, "map"), points=points)
    assert response.success
    np.testing.assert_allclose(response.distances, [*told["distance"][:2], np.nan], rtol=1e-6)
    found = [[g.x, g.y, g.z] for g in response.gradients]
    np.testing.assert_allclose(found, told["gradient"], rtol=1e-6)


def test_points_of_the_floors_frame(faces: Faces, run: RunFolder) -> None:
    T_floor_map = RunVolumes(run).floor()
    place = T_floor_map @ [0.0, 0.0, 1.0, 1.0]
    level = faces.post("query_distance", points=[place[:3].tolist()], frame="floor")
    tilted = faces.post("query_distance", points=[[0, 0, 1]])
    np.testing.assert_allclose(level["distance"], tilted["distance"], rtol=1e-4)
    np.testing.assert_allclose(level["gradient"][0], T_floor_map[:3, :3] @ tilted["gradient"][0], atol=1e-3)


def test_an_image_is_localised(faces: Faces, run: RunFolder) -> None:
    frame = frame_of(run, 4)
    depth = np.round(frame.depth * 1000).astype(np.uint16)
    told = faces.post("localize", color=png(frame.color[..., ::-1]), depth=png(depth))
    assert told["ok"] and told["located"], told
    true = run.keyframes().poses()[4]
    moved, turned = separation(np.array(told["T_map_optical"]), true)
    assert moved < 0.03 and turned < 1.0
    types = faces.types
    response = faces.ros("localize", LOCALIZE, color=image(types, "rgb8", frame.color),
                         depth=image(types, "16UC1", depth), camera=no_camera(types))  # fmt: skip
    assert response.success, response.message
    at = response.pose.pose.position
    np.testing.assert_allclose([at.x, at.y, at.z], told["position"], atol=1e-9)
    wall = faces.post("localize", color=png(np.full((120, 160, 3), 90, np.uint8)), depth=png(np.full_like(depth, 1500)))
    assert wall["ok"] and wall["located"] is False and wall["reason"]


def test_a_path_is_planned(faces: Faces) -> None:
    told = faces.post("plan", start=[0, 0, 0], goal=[0.2, 0.2, 0], frame="floor")
    assert told["ok"] and (told["found"] or told["reason"])
    types, stamped = faces.types, []
    for x, y in ((0.0, 0.0), (0.2, 0.2)):
        point = types.make("geometry_msgs/msg/Point", x=x, y=y, z=0.0)
        turn = types.make("geometry_msgs/msg/Quaternion", x=0.0, y=0.0, z=0.0, w=1.0)
        pose = types.make("geometry_msgs/msg/Pose", position=point, orientation=turn)
        stamped.append(types.make("geometry_msgs/msg/PoseStamped", header=header(types, "floor"), pose=pose))
    response = faces.ros("plan", GET_PLAN, start=stamped[0], goal=stamped[1], tolerance=0.0)
    assert response.plan.header.frame_id == "floor" or not told["found"]
    assert len(response.plan.poses) == len(told["points"])


def test_status_verdicts_and_saving(faces: Faces, run: RunFolder) -> None:
    assert faces.http("status")[1]["frames"] == 10
    assert faces.http("")[1]["functions"].keys() == set(faces.services.names)
    verdicts = faces.http("verdicts")[1]["verdicts"]
    response = faces.ros("verdicts", TRIGGER)
    assert response.success and json.loads(response.message)["verdicts"] == verdicts
    assert [v["name"] for v in verdicts][:2] == ["ggslam: run", "ggslam: tracked"]
    response = faces.ros("save_map", SAVE_MAP, name="copy")
    assert response.success and Path(response.message) == run.path.resolve().parent / "copy"
    assert len(RunFolder.open(run.path.parent / "copy").gaussians()) == len(run.gaussians())
    again = faces.post("save_map", name="copy")
    assert again == {"ok": False, "error": f"name: {run.path.resolve().parent / 'copy'} is there already"}
    response = faces.ros("pause", SET_BOOL, data=True)
    assert not response.success and "cannot do that" in response.message


BAD = [
    ("query_distance", {"points": [[0, 0, float("nan")]]}, "finite"),
    ("query_distance", {"points": [[0, 0, 1e300]]}, "finite"),
    ("query_distance", {"points": [[0, 0]]}, "three"),
    ("query_distance", {"points": []}, "points"),
    ("query_distance", {"points": {"a": 1}}, "points"),
    ("query_distance", {}, "nothing"),
    ("query_distance", {"points": [[0, 0, 0]] * (ServiceTuning.most_points + 1)}, "20000"),
    ("query_distance", {"points": [[0, 0, True]]}, "finite"),
    ("query_distance", {"points": [[0, 0, 1]], "frame": "odom"}, "map or floor"),
    ("query_distance", {"dots": [[0, 0, 1]]}, "no argument"),
    ("plan", {"start": [0, 0, 0], "goal": "there"}, "goal"),
    ("plan", {"start": [0, 0, 0], "goal": [0, 0, 0], "robot": "huge"}, "huge"),
    ("save_map", {"name": "../elsewhere"}, "name"),
    ("save_map", {"name": ".hidden"}, "name"),
    ("save_map", {"name": 7}, "text"),
    ("localize", {}, "base64"),
    ("localize", {"color": "?", "depth": "?"}, "no base64"),
    ("localize", {"color": "aGFsbG8=", "depth": "aGFsbG8="}, "color"),
    ("localize", {"color": png(np.zeros((8, 8, 3), np.uint8)), "depth": png(np.zeros((8, 8), np.uint8))}, "16 bits"),
    ("localize", {"color": png(np.zeros((8, 8, 3), np.uint8)), "depth": png(np.zeros((8, 4), np.uint16))}, "size"),
    ("localize", {"color": png(np.zeros((8, 9, 3), np.uint8)), "depth": png(np.zeros((8, 9), np.uint16))}, "160x120"),
    ("status", [1, 2], "names and values"),
    ("pause", {"on": "yes"}, "cannot do that"),
]


@pytest.mark.parametrize(("name", "values", "said"), BAD)
def test_bad_requests_get_a_line(faces: Faces, name: str, values: Any, said: str) -> None:
    status, answer = faces.http(name, json.dumps(values).encode())
    assert status == 400 and answer["ok"] is False and said in answer["error"] and "\n" not in answer["error"], answer


def status_of_claim(faces: Faces, length: int) -> int:
    """What a request gets whose body is said to be so long; it is refused before it is read."""
    address = urlsplit(faces.server.address)
    connection = http.client.HTTPConnection("127.0.0.1", faces.server.port, timeout=10)
    connection.putrequest("POST", f"/query_distance?{address.query}")
    connection.putheader("Content-Length", str(length))
    connection.endheaders()
    status = connection.getresponse().status
    connection.close()
    return status


def test_what_is_no_request(faces: Faces) -> None:
    assert faces.http("query_distance", b"{garbage")[0] == 400
    assert faces.http("query_distance", b"[" * 100_000)[0] == 400
    assert status_of_claim(faces, AccessTuning.max_message_bytes + 1) == 413
    assert faces.http("status", token="wrong")[0] == 403
    assert faces.http("query_distance")[0] == 405
    assert faces.http("elsewhere")[0] == 404
    assert faces.http("elsewhere", b"{}")[0] == 400
    assert faces.http("status")[0] == 200  # and it goes on


def test_each_function_says_what_it_takes() -> None:
    services = MapServices({})
    for name in FUNCTIONS:
        with pytest.raises(ConfigError, match="cannot do that"):
            services.call(name)
        with pytest.raises(ConfigError, match="no argument"):
            services.call(name, {"nonsense": 1})
