# SPDX-License-Identifier: Apache-2.0
"""Things and meshes as visualization_msgs/MarkerArray. Written by hand: a mesh has thousands of points."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np

from ggslam.messages.cdr_writer import CdrWriter
from ggslam.messages.contents import Mesh, Thing
from ggslam.messages.pose_numbers import position_and_quaternion
from ggslam.messages.ros2_geometry import write_header
from ggslam.messages.sound_content import plain_text
from ggslam.messages.thing_looks import ThingTuning, arrow_pose, label, label_place, speed

MARKERS: Final = "visualization_msgs/msg/MarkerArray"
ADD, DELETE, DELETE_ALL = 0, 2, 3
ARROW, CUBE, TEXT, TRIANGLES = 0, 1, 9, 11
NOWHERE: Final = (0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 1.0)
"""The identity pose."""


@dataclass(frozen=True)
class Marker:
    """A visualization_msgs/Marker: `pose` x y z and quaternion x y z w, `rgba` 0 to 1, points float64 [n, 3], colours
    float32 [n, 4]."""

    frame: str
    family: str
    id: int
    shape: int = CUBE
    action: int = ADD
    pose: Sequence[float] | np.ndarray = NOWHERE
    scale: tuple[float, float, float] = (1.0, 1.0, 1.0)
    rgba: tuple[float, float, float, float] = (1.0, 1.0, 1.0, 1.0)
    points: np.ndarray | None = None
    colors: np.ndarray | None = None
    text: str = ""


def markers_message(markers: list[Marker], stamp: float) -> bytes:
    """visualization_msgs/MarkerArray in CDR."""
    writer = CdrWriter()
    writer.numbers("I", len(markers))
    for marker in markers:
        _write(writer, marker, stamp)
    return writer.content()


def _write(writer: CdrWriter, marker: Marker, stamp: float) -> None:
    write_header(writer, marker.frame, stamp)
    writer.text(marker.family)
    writer.numbers("i", marker.id, marker.shape, marker.action)
    writer.numbers("d", *marker.pose, *marker.scale)
    writer.numbers("f", *marker.rgba)
    writer.numbers("i", 0, 0)  # lifetime: for good
    writer.numbers("B", 0)  # frame_locked
    writer.sequence(np.zeros((0, 3)) if marker.points is None else marker.points, 8)
    writer.sequence(np.zeros((0, 4), np.float32) if marker.colors is None else marker.colors, 4)
    writer.text("")  # texture_resource
    writer.numbers("i", 0, 0)  # texture: stamp, frame, format, data
    for _ in range(2):
        writer.text("")
    writer.numbers("I", 0, 0)  # its data; uv_coordinates
    writer.text(marker.text)
    writer.text("")  # mesh_resource
    writer.text("")  # mesh_file: name, data
    writer.numbers("I", 0)
    writer.numbers("B", 0)  # mesh_use_embedded_materials


def thing_markers(
    frame: str, thing: Thing, number: int, up: tuple[float, float, float] | None = None
) -> list[Marker]:
    """A box, its name, and an arrow if it moves; those that it may have had and has no more are deleted."""
    red, green, blue = (value / 255 for value in thing.rgb)
    place = (*label_place(thing, up), 0.0, 0.0, 0.0, 1.0)
    width, depth, height = (max(float(side), ThingTuning.least_m) for side in thing.size)
    text = Marker(
        frame, "names", number, TEXT, pose=place, scale=(0.0, 0.0, ThingTuning.text_m), rgba=(1.0, 1.0, 1.0, 1.0),
        text=label(thing),
    )  # fmt: skip
    box = Marker(
        frame, "boxes", number, CUBE, pose=position_and_quaternion(thing.T), scale=(width, depth, height),
        rgba=(red, green, blue, ThingTuning.box_alpha),
    )  # fmt: skip
    if not speed(thing):
        return [box, text, Marker(frame, "velocities", number, action=DELETE)]
    shaft = (speed(thing) * ThingTuning.arrow_s, ThingTuning.arrow_m, ThingTuning.arrow_m)
    pose = position_and_quaternion(arrow_pose(thing))
    return [box, text, Marker(frame, "velocities", number, ARROW, pose=pose, scale=shaft, rgba=(red, green, blue, 1.0))]


def thing_deletions(frame: str, number: int) -> list[Marker]:
    """What takes a thing away."""
    return [Marker(frame, family, number, action=DELETE) for family in ("boxes", "names", "velocities")]


def mesh_marker(mesh: Mesh, number: int) -> Marker:
    """A part of a mesh; one without triangles is deleted."""
    frame = plain_text(mesh.frame)
    if not len(mesh.triangles):
        return Marker(frame, "mesh", number, TRIANGLES, action=DELETE)
    corners = mesh.triangles.reshape(-1)
    colors = None
    if mesh.rgb is not None:
        table = np.ones((len(mesh.rgb), 4), np.float32)
        table[:, :3] = mesh.rgb / np.float32(255)
        colors = table[corners]
    gray = ThingTuning.gray
    points = mesh.vertices[corners].astype(np.float64)
    return Marker(frame, "mesh", number, TRIANGLES, rgba=(gray, gray, gray, 1.0), points=points, colors=colors)
