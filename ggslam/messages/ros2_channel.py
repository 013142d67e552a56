# SPDX-License-Identifier: Apache-2.0
"""A channel over ROS 2: the topics that it is sent to, and the messages of a content."""

from __future__ import annotations

from collections.abc import Callable
from typing import Final

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
from ggslam.messages.marker_ids import MarkerIds
from ggslam.messages.ros2_geometry import (
    PATH,
    POSE,
    TRANSFORMS,
    Edge,
    path_message,
    pose_message,
    transforms_message,
)
from ggslam.messages.ros2_grids import GRID, GRID_UPDATE, grid_message, grid_update_message
from ggslam.messages.ros2_images import (
    CAMERA_INFO,
    COMPRESSED,
    IMAGE,
    camera_info_message,
    compressed_message,
    image_message,
)
from ggslam.messages.ros2_lists import DETECTIONS, DIAGNOSTICS, detections_message, diagnostics_message
from ggslam.messages.ros2_markers import (
    DELETE_ALL,
    MARKERS,
    Marker,
    markers_message,
    mesh_marker,
    thing_deletions,
    thing_markers,
)
from ggslam.messages.ros2_points import CLOUD, cloud_message
from ggslam.messages.sound_content import plain_text
from ggslam.middleware.node import LATCHED, Node, Publisher, Qos
from ggslam.middleware.types import MessageTypes
from ggslam.system.tuning import Tuning


class Ros2QueueTuning(Tuning):
    """Messages that wait for slow subscribers."""

    transforms = 100
    """Of /tf, as tf2 has it."""
    pictures = 2
    """Of images: newer ones are wanted."""
    updates = 100
    """Of parts of grids: none may be left out."""
    mesh_parts = 50
    """Of parts of meshes; of a latched channel who joins late gets as many."""
    others = 10
    """Of everything else."""


TOPICS: Final[dict[type, tuple[tuple[str, str], ...]]] = {
    Transforms: (("", TRANSFORMS),),
    Pose: (("", POSE),),
    Path: (("", PATH),),
    Picture: (("", IMAGE), ("/compressed", COMPRESSED), ("/compressedDepth", COMPRESSED)),
    Lens: (("", CAMERA_INFO),),
    Points: (("", CLOUD),),
    Splats: (("", CLOUD),),
    Mesh: (("", MARKERS),),
    Grid: (("", GRID), ("_updates", GRID_UPDATE)),
    Things: (("", DETECTIONS), ("/markers", MARKERS)),
    Verdicts: (("", DIAGNOSTICS),),
}
"""What follows the channel's name, and the type, of each topic of a kind of content."""
Messages = list[tuple[str, bytes]]
"""What follows the channel's name, and CDR."""


def topic_qos(channel: Channel, end: str) -> Qos:
    """What a topic of a channel promises. All are reliable: those who want less get it, too."""
    if channel.kind is Mesh:
        return Qos(latched=channel.latched, depth=Ros2QueueTuning.mesh_parts)
    if channel.kind is Grid and end:
        return Qos(depth=Ros2QueueTuning.updates)
    if channel.latched:
        return LATCHED
    depths = {Transforms: Ros2QueueTuning.transforms, Picture: Ros2QueueTuning.pictures}
    return Qos(depth=depths.get(channel.kind, Ros2QueueTuning.others))


class Ros2Channel:
    """One channel. Remembers what viewers hold of it, so that what went away is deleted there.

    Attributes:
        channel: which one.
        publishers: of its topics, by what follows the channel's name.
    """

    def __init__(self, node: Node, types: MessageTypes, channel: Channel) -> None:
        self.channel = channel
        self.publishers: dict[str, Publisher] = {
            end: node.publisher(channel.name + end, kind, topic_qos(channel, end))
            for end, kind in TOPICS[channel.kind]
        }
        self._types = types
        self._ids = MarkerIds()
        self._fixed: dict[str, Edge] = {}
        self._shown: set[int] = set()
        self._begun = False

    def listeners(self) -> int:
        """How many listen to its topics."""
        return sum(publisher.subscribers for publisher in self.publishers.values())

    def messages(self, content: Content, stamp: float) -> Messages:
        """The messages that tell a content, by topic."""
        writers: dict[type, Callable[..., Messages]] = {
            Transforms: self._transforms,
            Picture: self._picture,
            Grid: self._grid,
            Things: self._things,
            Mesh: self._mesh,
        }
        return writers.get(type(content), self._single)(content, stamp)

    def _single(self, content: Content, stamp: float) -> Messages:
        """Contents of one topic."""
        if isinstance(content, Pose):
            return [("", pose_message(content, stamp))]
        if isinstance(content, Path):
            return [("", path_message(content, stamp))]
        if isinstance(content, Lens):
            return [("", self._types.encode(CAMERA_INFO, camera_info_message(self._types, content, stamp)))]
        if isinstance(content, Points | Splats):
            return [("", cloud_message(self._types, content, stamp))]
        assert isinstance(content, Verdicts), content
        return [("", diagnostics_message(self._types, content, stamp))]

    def _transforms(self, content: Transforms, stamp: float) -> Messages:
        """Fixed ones all in one message: a latched topic keeps the last one only."""
        edges: list[Edge] = [(*edge, stamp) for edge in content.edges]
        if content.fixed:
            self._fixed |= {child: (parent, child, T, at) for parent, child, T, at in edges}
            edges = list(self._fixed.values())
        return [("", transforms_message(edges))]

    def _picture(self, content: Picture, stamp: float) -> Messages:
        """As images and compressed, as somebody listens; if nobody is known to, as the content says."""
        packed = "/compressed" if content.image.ndim == 3 else "/compressedDepth"
        wanted = {end for end in ("", packed) if self.publishers[end].subscribers}
        wanted = wanted or {packed if content.compressed else ""}
        made: Messages = []
        if "" in wanted:
            made.append(("", self._types.encode(IMAGE, image_message(self._types, content, stamp))))
        if packed in wanted:
            made.append((packed, self._types.encode(COMPRESSED, compressed_message(self._types, content, stamp))))
        return made

    def _grid(self, content: Grid, stamp: float) -> Messages:
        if content.at is None:
            return [("", grid_message(self._types, content, stamp))]
        return [("_updates", grid_update_message(self._types, content, stamp))]

    def _things(self, content: Things, stamp: float) -> Messages:
        frame = plain_text(content.frame)
        markers = self._first_marker(frame)
        shown = set()
        for thing in content.things:
            number = self._ids.of(thing.id)
            shown.add(number)
            markers += thing_markers(frame, thing, number, content.up)
        for number in sorted(self._shown - shown):
            markers += thing_deletions(frame, number)
        self._shown = shown
        return [
            ("", detections_message(self._types, content, stamp)),
            ("/markers", markers_message(markers, stamp)),
        ]

    def _mesh(self, content: Mesh, stamp: float) -> Messages:
        markers = self._first_marker(plain_text(content.frame))
        return [("", markers_message([*markers, mesh_marker(content, self._ids.of(content.part))], stamp))]

    def _first_marker(self, frame: str) -> list[Marker]:
        """What clears viewers of what an earlier process sent."""
        first, self._begun = not self._begun, True
        return [Marker(frame, "", 0, action=DELETE_ALL)] if first else []

    def close(self) -> None:
        """Sends no more."""
        for publisher in self.publishers.values():
            publisher.close()
