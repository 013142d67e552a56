# SPDX-License-Identifier: Apache-2.0
"""Messages that are written by hand or whose arrays are, read by the deserialiser of Cyclone DDS."""

# no annotations of the future: Cyclone DDS reads them as types
from dataclasses import dataclass

import numpy as np
import pytest
from message_samples import STAMP, sample_contents, sample_grid, sample_mesh, sample_points

from ggslam.messages.pose_numbers import position_and_quaternion
from ggslam.messages.ros2_geometry import path_message
from ggslam.messages.ros2_grids import grid_message
from ggslam.messages.ros2_markers import markers_message, mesh_marker
from ggslam.messages.ros2_points import cloud_message
from ggslam.messages.stamps import whole_nanoseconds
from ggslam.middleware.types import message_types

pytest.importorskip("rosbags")
pytest.importorskip("cyclonedds")

from cyclonedds.idl import IdlStruct, types as t  # noqa: E402, I001


@dataclass
class Time(IdlStruct, typename="Time"):
    sec: t.int32
    nanosec: t.uint32


@dataclass
class Header(IdlStruct, typename="Header"):
    stamp: Time
    frame_id: str


@dataclass
class Numbers3(IdlStruct, typename="Numbers3"):
    x: t.float64
    y: t.float64
    z: t.float64


@dataclass
class Numbers4(IdlStruct, typename="Numbers4"):
    x: t.float64
    y: t.float64
    z: t.float64
    w: t.float64


@dataclass
class Pose(IdlStruct, typename="Pose"):
    position: Numbers3
    orientation: Numbers4


@dataclass
class PoseStamped(IdlStruct, typename="PoseStamped"):
    header: Header
    pose: Pose


@dataclass
class Path(IdlStruct, typename="Path"):
    header: Header
    poses: t.sequence[PoseStamped]


@dataclass
class PointField(IdlStruct, typename="PointField"):
    name: str
    offset: t.uint32
    datatype: t.uint8
    count: t.uint32


@dataclass
class PointCloud2(IdlStruct, typename="PointCloud2"):
    header: Header
    height: t.uint32
    width: t.uint32
    fields: t.sequence[PointField]
    is_bigendian: bool
    point_step: t.uint32
    row_step: t.uint32
    data: t.sequence[t.uint8]
    is_dense: bool


@dataclass
class MetaData(IdlStruct, typename="MetaData"):
    map_load_time: Time
    resolution: t.float32
    width: t.uint32
    height: t.uint32
    origin: Pose


@dataclass
class OccupancyGrid(IdlStruct, typename="OccupancyGrid"):
    header: Header
    info: MetaData
    data: t.sequence[t.int8]


@dataclass
class Rgba(IdlStruct, typename="Rgba"):
    r: t.float32
    g: t.float32
    b: t.float32
    a: t.float32


@dataclass
class Compressed(IdlStruct, typename="Compressed"):
    header: Header
    format: str
    data: t.sequence[t.uint8]


@dataclass
class Uv(IdlStruct, typename="Uv"):
    u: t.float32
    v: t.float32


@dataclass
class MeshFile(IdlStruct, typename="MeshFile"):
    filename: str
    data: t.sequence[t.uint8]


@dataclass
class Marker(IdlStruct, typename="Marker"):
    header: Header
    ns: str
    id: t.int32
    type: t.int32
    action: t.int32
    pose: Pose
    scale: Numbers3
    color: Rgba
    lifetime: Time
    frame_locked: bool
    points: t.sequence[Numbers3]
    colors: t.sequence[Rgba]
    texture_resource: str
    texture: Compressed
    uv_coordinates: t.sequence[Uv]
    text: str
    mesh_resource: str
    mesh_file: MeshFile
    mesh_use_embedded_materials: bool


@dataclass
class MarkerArray(IdlStruct, typename="MarkerArray"):
    markers: t.sequence[Marker]


def test_path() -> None:
    content = next(content for channel, content in sample_contents().items() if channel.name == "path")
    message = Path.deserialize(path_message(content, STAMP))
    assert len(message.poses) == len(content.poses)
    for stamped, T, stamp in zip(message.poses, content.poses, content.stamps, strict=True):
        p, q = stamped.pose.position, stamped.pose.orientation
        assert np.abs(np.array([p.x, p.y, p.z, q.x, q.y, q.z, q.w]) - position_and_quaternion(T)).max() < 1e-12
        assert stamped.header.stamp.sec * 10**9 + stamped.header.stamp.nanosec == whole_nanoseconds(stamp)


def test_cloud() -> None:
    content = sample_points(40)
    message = PointCloud2.deserialize(cloud_message(message_types("jazzy"), content, STAMP))
    assert [f.name for f in message.fields] == ["x", "y", "z", "rgb", "id", "distance"]
    data = np.array(message.data, np.uint8).reshape(40, message.point_step)
    assert data[:, :12].tobytes() == content.xyz.tobytes()


def test_grid() -> None:
    content = sample_grid()
    message = OccupancyGrid.deserialize(grid_message(message_types("jazzy"), content, STAMP))
    assert np.array_equal(np.array(message.data).reshape(content.cells.shape), content.cells)
    assert message.info.origin.orientation.w == 1


def test_markers() -> None:
    parts = [sample_mesh("a"), sample_mesh("b", triangles=0), sample_mesh("c", 5, 3, colored=False)]
    content = markers_message([mesh_marker(part, k) for k, part in enumerate(parts)], STAMP)
    found = MarkerArray.deserialize(content).markers
    assert [(m.id, m.action) for m in found] == [(0, 0), (1, 2), (2, 0)]
    for marker, part in zip(found, parts, strict=True):
        points = np.array([[p.x, p.y, p.z] for p in marker.points]).reshape(-1, 3)
        assert np.array_equal(points, part.vertices[part.triangles].reshape(-1, 3))
    assert len(found[0].colors) == 180
