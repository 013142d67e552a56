# SPDX-License-Identifier: Apache-2.0
"""The robot's own body is cut out of depth images and scans, with exact geometry."""

from __future__ import annotations

import re
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest

from ggslam.driving.body import Body, BodyShape, CameraBody
from ggslam.driving.body_options import read_body
from ggslam.driving.urdf import read_urdf
from ggslam.errors import ConfigError, FormatError
from ggslam.scene.camera import Camera
from ggslam.scene.frame import Frame
from ggslam.scene.poses import se3_exp
from ggslam.volumes.occupancy import FREE, OCCUPIED, UNKNOWN, OccupancyMap
from ggslam.volumes.settings import TsdfSettings
from ggslam.volumes.tsdf import TsdfMap

CAMERA = Camera(64, 48, 40.0, 40.0, 31.5, 23.5)
POSE = se3_exp(np.array([0.1, 0.4, 1.0, 0.3, -0.2, 0.5]))


def inside(shape: BodyShape, points: np.ndarray, margin: float) -> np.ndarray:
    """From the definition of the shape."""
    T = np.linalg.inv(shape.T_sensor_shape)
    own, half = points @ T[:3, :3].T + T[:3, 3], np.array(shape.half) + margin
    if shape.kind == "box":
        return (np.abs(own) <= half).all(1)
    if shape.kind == "sphere":
        return np.linalg.norm(own, axis=1) <= half[0]
    return (np.hypot(own[:, 0], own[:, 1]) <= half[0]) & (np.abs(own[:, 2]) <= half[2])


@pytest.mark.parametrize("kind", ["box", "cylinder", "sphere"])
@pytest.mark.parametrize("margin", [0.0, 0.05])
def test_rays_are_hidden_from_where_they_enter(kind: str, margin: float) -> None:
    """Against samples along each ray."""
    shape = BodyShape(kind, (0.3, 0.3, 0.2) if kind != "box" else (0.3, 0.1, 0.2), POSE)  # type: ignore[arg-type]
    random = np.random.default_rng(0)
    ends = random.normal(size=(3000, 3)) * 0.8 + POSE[:3, 3] * 0.9
    steps = np.linspace(0, 1, 1500)
    entered = np.array([inside(shape, steps[:, None] * end, margin).any() for end in ends])
    found = Body((shape,), margin).hides(ends)
    assert 200 < entered.sum() < 2800
    assert (found != entered).mean() < 0.002  # grazed between two samples
    assert found[inside(shape, ends, margin)].all()


def test_a_shape_around_the_sensor_hides_what_ends_in_it() -> None:
    body = Body((BodyShape("box", (0.4, 0.4, 0.4), np.eye(4)),), 0.03)
    ends = np.array([[0.0, 0, 0.42], [0.0, 0, 0.44], [0.1, 0.2, 0.3], [-2.0, 0, 0], [0, 0, 1e-9]])
    assert body.hides(ends).tolist() == [True, False, True, False, True]
    assert body.without(np.c_[ends, np.arange(5)])[:, 3].tolist() == [1, 3]


@pytest.mark.parametrize("axis", [0, 1, 2])
def test_rays_along_a_cylinder_and_along_a_wall(axis: int) -> None:
    T = np.eye(4)
    T[2, 3] = 1.0
    way = np.eye(3)[axis]
    cylinder, box = BodyShape("cylinder", (0.2, 0.2, 0.3), T), BodyShape("box", (0.2, 0.2, 0.3), T)
    for shape in (cylinder, box):
        found = Body((shape,), 0.0).hides(np.array([0.69, 0.71, 5.0])[:, None] * way)
        assert found.tolist() == ([False, True, True] if axis == 2 else [False] * 3)
    assert not Body((cylinder,), 0.0).hides(np.zeros((1, 3))).any()
    assert not Body((cylinder,), 0.0).hides(np.array([[0, 0, -3.0]])).any()  # behind the sensor


def depth_of(body: Body, room: float = 3.0) -> tuple[np.ndarray, np.ndarray]:
    """A depth image of a wall with the body before it, and where the body is seen."""
    depth, seen = np.full((48, 64), room, np.float32), np.zeros((48, 64), bool)
    for z in np.arange(room, 0.05, -0.002):
        on = body.hides(CAMERA.rays() * z) & ~body.hides(CAMERA.rays() * (z - 0.002))
        depth[on], seen = z, seen | on
    return depth, seen


def arm() -> Body:
    """A box at the lower right and a rod from the left."""
    box, rod = np.eye(4), se3_exp(np.array([0, 0, 0, 0, np.pi / 2, 0]))
    box[:3, 3], rod[:3, 3] = (0.25, 0.25, 0.5), (-0.3, 0.05, 0.7)
    return Body((BodyShape("box", (0.1, 0.1, 0.1), box), BodyShape("cylinder", (0.02, 0.02, 0.2), rod)), 0.0)


def test_depth_images_and_scans_are_cut_alike() -> None:
    body = arm()
    depth, seen = depth_of(body)
    assert 100 < seen.sum() < 1500
    cut = Body(body.shapes, 0.03)
    hidden = cut.hidden_depth(depth, CAMERA)
    assert hidden[seen].all() and hidden.mean() < 0.6
    assert np.array_equal(hidden, cut.hides(CAMERA.back_project(depth).astype(float)))
    nothing = np.full_like(depth, np.inf)
    assert np.array_equal(cut.hidden_depth(nothing, CAMERA), hidden)  # nor does nothing found behind it tell anything
    assert not cut.hidden_depth(np.zeros_like(depth), CAMERA).any()
    assert not cut.hidden_depth(np.full_like(depth, 0.2), CAMERA).any()  # before the body


def frame_of(depth: np.ndarray, no_return: np.ndarray | None = None) -> Frame:
    return Frame(0, 0, 0.0, np.zeros((48, 64, 3), np.uint8), depth, CAMERA, no_return=no_return)


def test_the_body_is_neither_an_obstacle_nor_free_space() -> None:
    body = arm()
    depth, seen = depth_of(body)
    own = CameraBody(Body(body.shapes, 0.03))
    tsdf, occupancy = TsdfMap(TsdfSettings(voxel=0.04)), OccupancyMap(0.04)
    frame = own.without(frame_of(depth))
    for _ in range(4):
        tsdf.integrate(frame.depth_or_infinity(), CAMERA, np.eye(4))
        occupancy.insert_depth(frame.depth_or_infinity(), CAMERA, np.eye(4))
    on_body = CAMERA.back_project(depth)[seen].astype(float)
    assert not (occupancy.states(on_body) == OCCUPIED).any()
    blocks = tsdf.blocks()
    dense = blocks.coordinates[blocks.dense]
    held = tsdf.read(dense)
    near = (held.weight > 0) & (np.abs(held.value) < 16000)
    assert near.any() and (dense[np.nonzero(near)[0], 2] * 8 * 0.04 > 2).all()  # only the wall
    hidden = own.hidden_pixels(depth, CAMERA).astype(np.uint8)
    inner, outer = cv2.erode(hidden, np.ones((5, 5))) > 0, cv2.dilate(hidden, np.ones((5, 5))) == 0
    behind = (CAMERA.rays() * 2.0).astype(float)  # a metre before the wall
    assert inner.sum() > 50 and (occupancy.states(behind[inner]) == UNKNOWN).all()
    assert outer.sum() > 500 and (occupancy.states(behind[outer]) == FREE).mean() > 0.8  # pixels are 5 cm apart


def test_where_nothing_was_found_is_cut_too() -> None:
    body, everywhere = CameraBody(arm()), np.ones((48, 64), bool)
    frame = body.without(frame_of(np.zeros((48, 64), np.float32), everywhere))
    assert frame.no_return is not None and 0.5 < frame.no_return.mean() < 0.95
    clear = frame_of(np.full((48, 64), 0.2, np.float32))
    assert body.without(clear) is clear


def test_a_rig_has_one_body() -> None:
    """Its second camera looks back: what is before the first one is behind it."""
    back = np.diag([-1.0, 1.0, -1.0, 1.0])
    body = CameraBody(arm(), np.stack([np.eye(4), back]))
    depth = np.full((48, 64), 3.0, np.float32)
    assert body.hidden_pixels(depth, CAMERA, 0).any() and not body.hidden_pixels(depth, CAMERA, 1).any()
    second = replace(frame_of(depth), camera_number=1)
    assert body.without(second) is second


URDF = """<?xml version="1.0"?>
<robot name="cart">
  <link name="base"><collision><origin xyz="0 0 0.1"/><geometry><box size="0.6 0.4 0.2"/></geometry></collision></link>
  <link name="mast">
    <visual><origin rpy="0 1.5707963267948966 0" xyz="0 0 0.25"/>
      <geometry><cylinder radius="0.02" length="0.5"/></geometry></visual>
  </link>
  <link name="camera"/>
  <joint name="a" type="fixed"><parent link="base"/><child link="mast"/><origin xyz="0.3 0 0.2"/></joint>
  <joint name="b" type="fixed"><parent link="mast"/><child link="camera"/>
    <origin xyz="0 0 0.6" rpy="-1.5707963267948966 0 -1.5707963267948966"/></joint>
  <gazebo/>
</robot>
"""


def test_a_urdf_is_read_in_the_cameras_frame(tmp_path: Path) -> None:
    (tmp_path / "cart.urdf").write_text(URDF)
    box, rod = read_urdf(tmp_path / "cart.urdf", "camera")
    assert (box.kind, box.half) == ("box", (0.3, 0.2, 0.1)) and (rod.kind, rod.half) == ("cylinder", (0.02, 0.02, 0.25))
    # The camera looks along the base's x, from (0.3, 0, 0.8): right is -y, down is -z.
    np.testing.assert_allclose(box.T_sensor_shape[:3, 3], [0, 0.7, -0.3], atol=1e-9)
    np.testing.assert_allclose(box.T_sensor_shape[:3, :3], [[0, -1, 0], [0, 0, -1], [1, 0, 0]], atol=1e-9)
    np.testing.assert_allclose(rod.T_sensor_shape[:3, 3], [0, 0.35, 0], atol=1e-9)
    np.testing.assert_allclose(np.abs(rod.T_sensor_shape[:3, 2]), [0, 0, 1], atol=1e-9)  # the rod lies along x
    body = read_body([str(tmp_path / "cart.urdf"), "-1,-1,0.1,1,1,0.2"], "camera")
    assert body is not None and len(body.shapes) == 3
    assert read_body([]) is None


@pytest.mark.parametrize(
    ("old", "new", "words"),
    [
        ('type="fixed"><parent link="base"', 'type="revolute"><parent link="base"', "joint 'a'.*fixed.*revolute"),
        ('<box size="0.6 0.4 0.2"/>', '<mesh filename="a.stl"/>', "link 'base'.*<mesh>"),
        ('size="0.6 0.4 0.2"', 'size="0.6 0.4"', "size.*3 numbers.*'0.6 0.4'"),
        ('size="0.6 0.4 0.2"', 'size="0.6 nan 0.2"', "size.*3 numbers"),
        ('radius="0.02"', 'radius="-1"', "link 'mast'.*above 0"),
        ('child link="mast"', 'child link="mist"', "joint 'a'.*no child link 'mist'"),
        ('<parent link="mast"/>', "", "joint 'b'.*no parent link"),
        ('parent link="base"', 'parent link="camera"', "one link without a parent.*circle|circle"),
        ('link name="camera"', 'link name="mast"', "two links 'mast'"),
        ("</robot>", "", "no element found|mismatched"),
        ("<robot ", "<robit ", "mismatched|<robit>"),
        ("<gazebo/>", "<gazebo>" + "<a>" * 80 + "</a>" * 80 + "</gazebo>", "within one another"),
        ('<?xml version="1.0"?>', '<!DOCTYPE robot [<!ENTITY a "aaaa"><!ENTITY b "&a;&a;&a;&a;">]>', "DTD"),
        ('<?xml version="1.0"?>', '<!DOCTYPE robot SYSTEM "file:///etc/passwd">', "DTD"),
        ("<gazebo/>", "&passwd;", "undefined entity"),
        ('<link name="camera"/>', "<link/>", "<link> without a name"),
        ('rpy="0 1.57', 'rpy="x 1.57', "rpy"),
    ],
)  # fmt: skip
def test_damaged_files_are_refused_by_name(tmp_path: Path, old: str, new: str, words: str) -> None:
    assert old in URDF
    path = tmp_path / "cart.urdf"
    path.write_text(URDF.replace(old, new, 1))
    with pytest.raises(FormatError, match=f"(?s){words}") as caught:
        read_urdf(path, "camera")
    assert str(caught.value).startswith(f"{path}: ") and "\n" not in str(caught.value)


def test_other_mistakes_are_told(tmp_path: Path) -> None:
    (tmp_path / "cart.urdf").write_text(URDF)
    with pytest.raises(FormatError, match="no link 'optical'; there are base, camera, mast"):
        read_urdf(tmp_path / "cart.urdf", "optical")
    with pytest.raises(ConfigError, match="body_frame"):
        read_body([str(tmp_path / "cart.urdf")])
    with pytest.raises(ConfigError, match="no file"):
        read_body(["-1,-1,0,1,1,1"], "camera")
    with pytest.raises(FormatError, match="no.urdf"):
        read_body([str(tmp_path / "no.urdf")], "camera")
    for text in ("1,2,3", "0,0,0,1,1,0", "0,0,0,1,1,nan", "1,1,1,0,0,0"):
        with pytest.raises(ConfigError, match="XMIN"):
            read_body([text])
    (tmp_path / "bare.urdf").write_text('<robot><link name="camera"/></robot>')
    with pytest.raises(FormatError, match="no link has"):
        read_urdf(tmp_path / "bare.urdf", "camera")


@pytest.mark.parametrize(
    ("text", "reason"),
    [
        ('<robot xmlns:xacro="x"><xacro:include filename="a"/></robot>', "has no <link>; of a xacro file make a URDF"),
        (URDF.replace(' length="', ' long="'), "<cylinder>: length: expected 1 number within 1000, found none"),
    ],
)
def test_what_is_missing_is_named(tmp_path: Path, text: str, reason: str) -> None:
    (tmp_path / "cart.urdf").write_text(text)
    with pytest.raises(FormatError, match=re.escape(reason)):
        read_urdf(tmp_path / "cart.urdf", "camera")
