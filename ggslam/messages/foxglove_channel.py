# SPDX-License-Identifier: Apache-2.0
"""A channel in Foxglove: its topic and schema, the messages of a content, and what who joins late gets."""

from __future__ import annotations

import threading
from collections.abc import Callable
from dataclasses import replace
from typing import Any, Final

from ggslam.messages.contents import (
    Channel,
    Content,
    Grid,
    Lens,
    Mesh,
    Path,
    Picture,
    Points,
    Pose,
    Splats,
    Things,
    Transforms,
    Verdicts,
)
from ggslam.messages.foxglove_fields import VERDICTS_SCHEMA, cloud_message, grid_message, verdicts_message
from ggslam.messages.foxglove_geometry import (
    Edge,
    lens_message,
    path_message,
    picture_message,
    pose_message,
    transforms_message,
)
from ggslam.messages.foxglove_package import foxglove_package
from ggslam.messages.foxglove_scene import mesh_entity, mesh_id, scene_message, thing_entity
from ggslam.messages.stamps import whole_nanoseconds

SCHEMAS: Final[dict[type, str]] = {
    Transforms: "FrameTransforms",
    Pose: "PoseInFrame",
    Path: "PosesInFrame",
    Picture: "CompressedImage",
    Lens: "CameraCalibration",
    Points: "PointCloud",
    Splats: "PointCloud",
    Mesh: "SceneUpdate",
    Grid: "Grid",
    Things: "SceneUpdate",
}
"""Foxglove's schema of each kind of content; verdicts are JSON."""
AFTER_S: Final = 1e-6
"""Entities are deleted if they are older than the deletion: it is stamped this much later, in seconds."""


def foxglove_topic(channel: Channel) -> str:
    """The topic of a channel: Foxglove has no namespaces."""
    return "/" + channel.name.lstrip("/")


class FoxgloveChannel:
    """One channel. Remembers what clients hold of it, so that what went away is deleted there. `send` and `resend` may
    be called from several threads."""

    def __init__(self, context: Any, channel: Channel) -> None:
        package = foxglove_package()
        self.channel = channel
        schema = SCHEMAS.get(channel.kind)
        kind = getattr(package.messages, schema).get_schema() if schema else VERDICTS_SCHEMA
        self._sink = package.Channel(
            foxglove_topic(channel), schema=kind, message_encoding="protobuf" if schema else "json", context=context
        )
        self._lock = threading.Lock()
        self._fixed: dict[str, Edge] = {}
        self._shown: set[str] = set()
        self._grid: Grid | None = None
        self._last: tuple[bytes, int] | None = None

    def send(self, content: Content, stamp: float) -> int:
        """Sends to everybody who listens; returns the bytes."""
        with self._lock:
            message = self._message(content, stamp)
            at = whole_nanoseconds(stamp)
            if self.channel.latched and not (isinstance(content, Mesh) and content.part):
                self._last = (message, at)
            self._sink.log(message, log_time=at)
        return len(message)

    def resend(self) -> None:
        """Sends the last content again, if it is latched and not a part of a mesh, of which there are many. To
        everybody: the package does not tell how to reach one."""
        with self._lock:
            if self._last is not None:
                self._sink.log(self._last[0], log_time=self._last[1])

    def _message(self, content: Content, stamp: float) -> bytes:
        writers: dict[type, Callable[..., bytes]] = {
            Transforms: self._transforms,
            Pose: pose_message,
            Path: path_message,
            Picture: picture_message,
            Lens: lens_message,
            Points: cloud_message,
            Splats: cloud_message,
            Mesh: self._mesh,
            Grid: self._grid_message,
            Things: self._things,
            Verdicts: verdicts_message,
        }
        return writers[type(content)](content, stamp)

    def _transforms(self, content: Transforms, stamp: float) -> bytes:
        edges: list[Edge] = [(*edge, stamp) for edge in content.edges]
        if content.fixed:
            self._fixed |= {child: (parent, child, T, at) for parent, child, T, at in edges}
            edges = list(self._fixed.values())
        return transforms_message(edges)

    def _things(self, content: Things, stamp: float) -> bytes:
        shown = {str(thing.id) for thing in content.things}
        gone, self._shown = sorted(self._shown - shown), shown
        entities = [thing_entity(content.frame, thing, stamp, content.up) for thing in content.things]
        return scene_message(entities, gone, stamp + AFTER_S)

    def _mesh(self, content: Mesh, stamp: float) -> bytes:
        name = mesh_id(content)
        if not len(content.triangles):
            return scene_message([], [name], stamp + AFTER_S)
        return scene_message([mesh_entity(content, stamp)])

    def _grid_message(self, content: Grid, stamp: float) -> bytes:
        """A part is put into the whole, which is sent: Foxglove has no message for parts."""
        if content.at is not None and self._grid is not None:
            (row, column), (height, width) = content.at, content.cells.shape
            whole = self._grid.cells.copy()
            place = whole[row : row + height, column : column + width]  # what lies outside has no place
            place[:] = content.cells[: place.shape[0], : place.shape[1]]
            content = replace(self._grid, cells=whole)
        if content.at is None:
            self._grid = content
        return grid_message(content, stamp)

    def close(self) -> None:
        """Sends no more."""
        self._sink.close()
