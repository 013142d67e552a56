# SPDX-License-Identifier: Apache-2.0
"""ROS 1 bags (one file) and ROS 2 bags (a folder with metadata.yaml, or one .db3 or .mcap): colour, depth, camera_info.

Needs the package rosbags, no ROS. The bag is read through once for the times of its images; images are decoded when
their frame comes. Depth of a camera beside the colour camera is registered by /tf_static.
"""

from __future__ import annotations

from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from ggslam.errors import SequenceError
from ggslam.scene.camera import Camera
from ggslam.sequences.association import pair_images, poses_at
from ggslam.sequences.formats.ros_calibration import (
    DepthInfo,
    Lens,
    is_calibrated,
    is_registered,
    lens_of,
    place_of_depth,
)
from ggslam.sequences.formats.ros_images import color_image, depth_in_unit, in_metres
from ggslam.sequences.formats.ros_messages import Bag, BagImage
from ggslam.sequences.formats.ros_topics import (
    Topics,
    check_holds_poses,
    find_topics,
    is_rectified,
    poses_of,
    static_transform,
)
from ggslam.sequences.images import read_color
from ggslam.sequences.json_files import camera_of
from ggslam.sequences.pixel_grid import image_size
from ggslam.sequences.recording import NO_OPTIONS, FrameFiles, OwnCamera, ReadOptions, Recording
from ggslam.system.untrusted_files import open_untrusted

STORAGES = (".db3", ".mcap", ".db3.zstd", ".mcap.zstd")
"""Ends of the names of files that ROS 2 stores messages in."""
BAG_START = b"#ROSBAG V2.0"


class Ros1Format:
    """One .bag file."""

    name = "ros1"
    layout = "one file .bag of ROS 1 with colour and depth images and camera_info (needs rosbags)"

    def matches(self, path: Path) -> bool:
        if not path.is_file() or path.suffix.lower() != ".bag":
            return False
        with open_untrusted(path, SequenceError) as file:
            return file.read(len(BAG_START)) == BAG_START

    def read(self, path: Path, options: ReadOptions = NO_OPTIONS) -> Recording:
        return _read(self.name, path, Bag(path), options)


class Ros2Format:
    """A folder that `ros2 bag record` wrote, or the one storage file in it."""

    name = "ros2"
    layout = "folder with metadata.yaml and *.db3 or *.mcap of ROS 2, or one such file (needs rosbags)"

    def matches(self, path: Path) -> bool:
        if path.is_file():
            return _is_storage(path)
        return (path / "metadata.yaml").is_file() and any(map(_is_storage, path.iterdir()))

    def read(self, path: Path, options: ReadOptions = NO_OPTIONS) -> Recording:
        return _read(self.name, path, Bag(_whole_bag(path)), options)


def _is_storage(path: Path) -> bool:
    return path.name.lower().endswith(STORAGES)


def _whole_bag(path: Path) -> Path:
    """The folder of a bag whose only file this is, for metadata.yaml tells how it is compressed; else the path."""
    if not path.is_file() or not (path.parent / "metadata.yaml").is_file():
        return path
    return path.parent if sum(map(_is_storage, path.parent.iterdir())) == 1 else path


def _read(name: str, path: Path, bag: Bag, options: ReadOptions) -> Recording:
    topics = find_topics(bag, options.topics)
    color_times, depth_times, time_source = _times(bag, topics)
    pairs, warnings = pair_images(path, color_times, depth_times, (topics.color, topics.depth))
    metres = in_metres(bag.message(topics.depth, 0))
    read_depth = partial(depth_in_unit, metres=metres)
    pairs.sort(key=lambda pair: color_times[pair[0]])
    files = [
        FrameFiles(
            BagImage(bag, topics.color, i, float(color_times[i]), color_image),
            BagImage(bag, topics.depth, j, float(depth_times[j]), read_depth),
        )
        for i, j in pairs
    ]
    lens = options.recorded_camera(lambda: _color_lens(bag, topics)) or Lens(None)
    recording = Recording(
        name, path, files, color_times[[i for i, _ in pairs]],
        1.0 if metres else 1000.0, lens.camera, time_source=time_source, warnings=warnings,
        depth_delays=np.array([depth_times[j] - color_times[i] for i, j in pairs]),
        distortion=lens.distortion, fisheye=lens.fisheye,
    )  # fmt: skip
    options.recorded_depth_camera(lambda: _place_depth(recording, bag, topics, options.own_camera))
    pose = topics.pose
    if pose is not None:
        check_holds_poses(bag, pose)
        options.add_truth(recording, lambda: _add_poses(recording, bag, pose))
    return recording


def _times(bag: Bag, topics: Topics) -> tuple[np.ndarray, np.ndarray, str]:
    """Times of colour and depth, float64 [n], [m], seconds, and where they come from: the headers, or where a driver
    left those zero, when the messages were recorded."""
    color, depth = bag.stamps(topics.color), bag.stamps(topics.depth)
    for topic, times in ((topics.color, color), (topics.depth, depth)):
        if not len(times):
            raise SequenceError(f"{bag.path}: topic {topic} holds no messages")
    if color.any() and depth.any():
        return color, depth, f"headers of {topics.color}"
    source = "when messages were recorded: their headers have no time"
    return bag.log_times(topics.color), bag.log_times(topics.depth), source


def _first_info(bag: Bag, topic: str) -> Any:
    """The first camera_info of a topic that is one: drivers send zeros before they have read their calibration. Where
    all are zeros, the first."""
    first = info = bag.message(topic, 0)
    number = 0
    while not is_calibrated(info):
        number += 1
        try:
            info = bag.message(topic, number)
        except SequenceError:
            return first
    return info


def _color_lens(bag: Bag, topics: Topics) -> Lens:
    if topics.color_info is None:
        raise SequenceError(f"{bag.path}: no camera_info belongs to {topics.color}; `topics` color_info=TOPIC names it")
    info = _first_info(bag, topics.color_info)
    return lens_of(f"{bag.path}, {topics.color_info}", info, is_rectified(topics.color))


def _color_camera(recording: Recording, bag: Bag, topics: Topics, own: OwnCamera | None) -> Camera | None:
    """The camera that depth is compared with: as the bag tells it, else the user; None: neither tells it."""
    if topics.color_info is not None:
        try:
            return _color_lens(bag, topics).camera
        except SequenceError:  # what a user tells stands for it
            pass
    if own is None or own.camera is not None:
        return None if own is None else own.camera
    width, height = image_size(read_color(recording.files[0].color))
    return None if own.calibration is None else camera_of(own.source, width, height, *own.calibration)


def _place_depth(recording: Recording, bag: Bag, topics: Topics, own: OwnCamera | None) -> None:
    """Tells whether depth is registered, or how the depth camera stands to the colour camera, or warns."""
    if topics.depth_info is None or is_registered(topics.depth):
        return
    camera = _color_camera(recording, bag, topics, own)
    if camera is None:
        return
    info = _first_info(bag, topics.depth_info)
    told = DepthInfo(f"{bag.path}, {topics.depth_info}", info, is_rectified(topics.depth))
    frames = [str(bag.message(topic, 0).header.frame_id) for topic in (topics.color, topics.depth)]
    stand = place_of_depth(camera, told, frames[0], frames[1], partial(static_transform, bag))
    recording.depth_camera = stand.camera
    recording.warnings += [f"{stand.doubt} (`depth_camera` tells it)"] if stand.doubt else []


def _add_poses(recording: Recording, bag: Bag, topic: str) -> None:
    times, poses = poses_of(bag, topic)
    recording.take_poses(poses_at(recording.timestamps, times, poses), topic)
