# SPDX-License-Identifier: Apache-2.0
"""Every message of Foxglove says, read by protobuf with the schemas of the file, what was to be told."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from message_samples import (
    HUGE,
    STAMP,
    random_pose,
    sample_contents,
    sample_grid,
    sample_mesh,
    sample_points,
    sample_splats,
    sample_things,
)
from second_readers import cloud_table, numbers_of, read_foxglove, stamp_ns

from ggslam.errors import InputError
from ggslam.messages.contents import Channel, Content, Grid, Mesh, Picture, Points, Pose, Splats, Things, Transforms
from ggslam.messages.contents import Path as PathContent
from ggslam.messages.foxglove_outlet import FileOutlet
from ggslam.messages.pose_numbers import position_and_quaternion
from ggslam.messages.stamps import whole_nanoseconds

pytest.importorskip("foxglove")
pytest.importorskip("mcap")
pytest.importorskip("google.protobuf")


def told(folder: Path, channel: Channel, *contents: Content) -> list[Any]:
    """What contents of one channel, all of one time, say, as read from a file."""
    outlet = FileOutlet(folder / "told.mcap", overwrite=True)
    outlet.open(channel)
    for content in contents:
        outlet.send(channel, content, STAMP)
    outlet.close()
    (messages,) = read_foxglove(folder / "told.mcap").values()
    return messages


def sample(name: str) -> tuple[Channel, Any]:
    return next((channel, content) for channel, content in sample_contents().items() if channel.name == name)


def test_all_kinds_are_in_one_file(tmp_path: Path) -> None:
    outlet = FileOutlet(tmp_path / "all.mcap")
    contents = sample_contents()
    for channel in contents:
        outlet.open(channel)
        assert outlet.listeners(channel) == 1
    sizes = [outlet.send(channel, content, STAMP) for channel, content in contents.items()]
    outlet.close()
    outlet.close()
    assert min(sizes) > 0
    assert set(read_foxglove(tmp_path / "all.mcap")) == {"/" + c.name.lstrip("/") for c in contents}
    with pytest.raises(InputError, match="is there already"):
        FileOutlet(tmp_path / "all.mcap")
    with pytest.raises(InputError, match="cannot be written"):
        FileOutlet(tmp_path / "nowhere" / "all.mcap")


def test_transforms(tmp_path: Path) -> None:
    channel, content = sample("/tf")
    (message,) = told(tmp_path, channel, content)
    assert [(t.parent_frame_id, t.child_frame_id) for t in message.transforms] == [e[:2] for e in content.edges]
    for transform, edge in zip(message.transforms, content.edges, strict=True):
        assert stamp_ns(transform.timestamp) == whole_nanoseconds(STAMP)
        t, q = transform.translation, transform.rotation
        assert np.abs(np.array([t.x, t.y, t.z, q.x, q.y, q.z, q.w]) - position_and_quaternion(edge[2])).max() < 1e-12
    fixed = Transforms((("map", "a", np.eye(4)),), True), Transforms((("map", "b", np.eye(4)),), True)
    messages = told(tmp_path, Channel("/tf_static", Transforms, True), *fixed)
    assert [[t.child_frame_id for t in m.transforms] for m in messages] == [["a"], ["a", "b"]]


@pytest.mark.parametrize("count", [0, 1, 9])
def test_pose_and_path(tmp_path: Path, count: int) -> None:
    rng = np.random.default_rng(0)
    poses = np.array([random_pose(rng) for _ in range(count)]).reshape(-1, 4, 4)
    (message,) = told(tmp_path, Channel("path", PathContent), PathContent("map", poses, np.arange(count) / 30))
    assert (message.frame_id, len(message.poses)) == ("map", count)
    for pose, T in zip(message.poses, poses, strict=True):
        assert np.abs(numbers_of(pose) - position_and_quaternion(T)).max() < 1e-12
    (message,) = told(tmp_path, Channel("pose", Pose), Pose("map", random_pose(rng)))
    assert stamp_ns(message.timestamp) == whole_nanoseconds(STAMP)


def test_pictures(tmp_path: Path) -> None:
    channel, content = sample("image")
    lossy, exact = told(tmp_path, channel, content, Picture("camera", content.image, compressed=False))
    images = [cv2.imdecode(np.frombuffer(m.data, np.uint8), cv2.IMREAD_COLOR)[..., ::-1] for m in (lossy, exact)]
    assert (lossy.format, exact.format) == ("jpeg", "png")
    assert np.abs(images[0].astype(int) - content.image).max() <= 8  # JPEG of a smooth image
    assert np.array_equal(images[1], content.image)
    channel, content = sample("depth")
    (message,) = told(tmp_path, channel, content)
    millimetres = cv2.imdecode(np.frombuffer(message.data, np.uint8), cv2.IMREAD_UNCHANGED)
    assert np.array_equal(millimetres, np.rint(content.image * 1000))


def test_lens(tmp_path: Path) -> None:
    channel, content = sample("camera_info")
    (message,) = told(tmp_path, channel, content)
    assert np.array_equal(np.array(message.K).reshape(3, 3), content.camera.matrix())
    assert (message.width, message.height, message.frame_id) == (64, 48, "camera")


@pytest.mark.parametrize("count", [0, 1, 300])
def test_points(tmp_path: Path, count: int) -> None:
    content = sample_points(count)
    (message,) = told(tmp_path, Channel("points", Points), content)
    table = cloud_table(message)
    assert len(table) == count
    assert message.pose.orientation.w == 1
    assert np.array_equal(np.stack([table[n] for n in "xyz"], 1).view(np.uint32), content.xyz.view(np.uint32))
    assert np.array_equal(np.stack([table[n] for n in ("red", "green", "blue")], 1), content.rgb)
    assert (table["alpha"] == 255).all()
    for name, column in content.values.items():
        assert np.array_equal(table[name], column)


def test_splats(tmp_path: Path) -> None:
    content = sample_splats()
    (message,) = told(tmp_path, Channel("splats", Splats), content)
    table = cloud_table(message)
    assert np.abs(np.exp(table["scale_2"]) - content.scales[:, 2]).max() < 1e-6
    assert np.abs(table["alpha"] / 255 - content.opacities).max() < 0.5 / 255 + 1e-6
    assert np.array_equal(table["rot_0"], content.quaternions[:, 0])
    assert np.array_equal(table["f_rest_8"], content.sh[:, 3, 2])
    gray = 0.28209479177387814 * content.sh[:, 0, 1] + 0.5
    assert np.abs(table["green"] / 255 - gray.clip(0, 1)).max() < 0.5 / 255 + 1e-6


@pytest.mark.parametrize(("vertices", "triangles", "colored"), [(40, 60, True), (40, 60, False), (700, 1, True)])
def test_mesh(tmp_path: Path, vertices: int, triangles: int, colored: bool) -> None:
    content = sample_mesh("tile_1", vertices, triangles, colored)
    (message,) = told(tmp_path, Channel("mesh", Mesh), content)
    (entity,) = message.entities
    (mesh,) = entity.triangles
    assert (entity.id, entity.frame_id, mesh.pose.orientation.w) == ("tile_1", "map", 1)
    assert np.array_equal([[p.x, p.y, p.z] for p in mesh.points], content.vertices)
    assert np.array_equal(np.array(mesh.indices).reshape(-1, 3), content.triangles)
    if content.rgb is None:
        assert not mesh.colors
    else:
        assert np.array_equal(np.rint(np.array([[c.r, c.g, c.b] for c in mesh.colors]) * 255), content.rgb)
        assert all(c.a == 1 for c in mesh.colors)


def test_parts_of_a_mesh_that_went_away_are_deleted(tmp_path: Path) -> None:
    made, gone = told(tmp_path, Channel("mesh", Mesh), sample_mesh("a"), sample_mesh("a", triangles=0))
    assert [entity.id for entity in made.entities] == ["a"]
    assert not gone.entities
    assert [(d.id, d.type) for d in gone.deletions] == [("a", 0)]
    assert stamp_ns(gone.deletions[0].timestamp) > stamp_ns(made.entities[0].timestamp)


def test_things(tmp_path: Path) -> None:
    content = sample_things()
    first, second = told(tmp_path, Channel("objects", Things), content, Things("map", content.things[:1]))
    assert [entity.id for entity in first.entities] == ["5", str(HUGE), "7"]
    for entity, thing in zip(first.entities, content.things, strict=True):
        (cube,), (text,) = entity.cubes, entity.texts
        assert np.abs(numbers_of(cube.pose) - position_and_quaternion(thing.T)).max() < 1e-12
        assert np.array_equal([cube.size.x, cube.size.y, cube.size.z], thing.size)
        assert np.abs(np.array([cube.color.r, cube.color.g, cube.color.b]) * 255 - thing.rgb).max() < 1e-9
        assert text.text and "\0" not in text.text
        assert len(entity.arrows) == (thing.velocity is not None)
    assert {deletion.id for deletion in second.deletions} == {str(HUGE), "7"}
    assert stamp_ns(second.deletions[0].timestamp) > stamp_ns(first.entities[0].timestamp)
    assert [entity.id for entity in second.entities] == ["5"]


def test_grid_and_parts_of_it(tmp_path: Path) -> None:
    whole, part = sample_grid(), sample_grid(2, 3, at=(4, 5))
    outside = sample_grid(2, 3, at=(6, 9))
    first, second, third = told(tmp_path, Channel("grid", Grid), whole, part, outside)
    assert np.array_equal(np.frombuffer(first.data, np.int8).reshape(7, -1), whole.cells)
    assert (first.column_count, first.row_stride, first.cell_stride) == (11, 11, 1)
    assert (first.cell_size.x, first.cell_size.y) == (0.05, 0.05)
    assert np.array_equal(numbers_of(first.pose)[:3], [-1.5, 2.5, 0.1])
    expected = whole.cells.copy()
    expected[4:6, 5:8] = part.cells
    assert np.array_equal(np.frombuffer(second.data, np.int8).reshape(7, -1), expected)
    expected[6:, 9:] = outside.cells[:1, :2]
    assert np.array_equal(np.frombuffer(third.data, np.int8).reshape(7, -1), expected)


def test_verdicts(tmp_path: Path) -> None:
    channel, content = sample("/diagnostics")
    (message,) = told(tmp_path, channel, content)
    assert [status["level"] for status in message["status"]] == [0, 2]
    assert message["status"][1]["values"] == [{"key": "frames", "value": "7"}]


def test_two_files_of_a_process_do_not_mix(tmp_path: Path) -> None:
    channel = Channel("points", Points)
    outlets = [FileOutlet(tmp_path / f"{k}.mcap") for k in range(2)]
    for k, outlet in enumerate(outlets):
        outlet.open(channel)
        outlet.send(channel, sample_points(k + 1), STAMP)
    for k, outlet in enumerate(outlets):
        outlet.close()
        (messages,) = read_foxglove(tmp_path / f"{k}.mcap").values()
        assert [len(cloud_table(message)) for message in messages] == [k + 1]
