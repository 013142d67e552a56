# SPDX-License-Identifier: Apache-2.0
"""ROS 1 bags (one file) and ROS 2 bags (a folder with metadata.yaml, or one .db3 or .mcap): colour, depth, camera_info.

Needs the package rosbags, no ROS. The bag is read through once for the times of its images; images are decoded when
their frame comes. Depth of a camera beside the colour camera is registered by /tf_static.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from ggslam.errors import SequenceError
from ggslam.scene.camera import Camera
from ggslam.scene.poses import is_valid_pose
from ggslam.sequences.association import pair_images, poses_at
from ggslam.sequences.camera_files.lens_models import distortion_of
from ggslam.sequences.formats.ros_images import color_image, depth_in_unit, in_metres
from ggslam.sequences.formats.ros_messages import Bag, BagImage
from ggslam.sequences.formats.ros_topics import (
    REGISTERED,
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
from ggslam.sequences.recording import (
    NO_OPTIONS,
    DepthCamera,
    FrameFiles,
    OwnCamera,
    ReadOptions,
    Recording,
)
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
    lens = options.recorded_camera(lambda: _color_lens(bag, topics)) or _Lens(None)
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
    while not (np.asarray(_value(info, "k"), float).reshape(-1)[0] > 0 and info.width > 0):
        number += 1
        try:
            info = bag.message(topic, number)
        except SequenceError:
            return first
    return info


def _value(info: Any, name: str) -> Any:
    """Field of a camera_info: ROS 1 writes K, D, P in capitals."""
    return getattr(info, name) if hasattr(info, name) else getattr(info, name.upper())


@dataclass(frozen=True)
class _Lens:
    """The content of a camera_info message."""

    camera: Camera | None
    distortion: np.ndarray | None = None
    fisheye: bool = False


def _color_lens(bag: Bag, topics: Topics) -> _Lens:
    if topics.color_info is None:
        raise SequenceError(f"{bag.path}: no camera_info belongs to {topics.color}; `topics` color_info=TOPIC names it")
    info, rectified = _first_info(bag, topics.color_info), is_rectified(topics.color)
    place = f"{bag.path}, {topics.color_info}"
    camera = _camera(place, info, rectified)
    return _Lens(camera) if rectified else _Lens(camera, *_distortion(place, info))


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


def _camera(place: str, info: Any, rectified: bool) -> Camera:
    K = np.asarray(_value(info, "p" if rectified else "k"), float).reshape(3, -1)
    numbers = (float(K[0, 0]), float(K[1, 1]), float(K[0, 2]), float(K[1, 2]))
    camera = camera_of(place, int(info.width), int(info.height), *numbers)
    region = info.roi
    sizes = (int(region.width), int(region.height))
    if sizes == (camera.width, camera.height) or min(sizes) <= 0 or region.width > camera.width:
        return camera
    # K and P are those of the whole sensor; the images are a part of it.
    cx, cy = camera.cx - int(region.x_offset), camera.cy - int(region.y_offset)
    return camera_of(place, *sizes, camera.fx, camera.fy, cx, cy)


def _distortion(place: str, info: Any) -> tuple[np.ndarray | None, bool]:
    return distortion_of(place, str(info.distortion_model), np.asarray(_value(info, "d"), float).reshape(-1))


def _place_depth(recording: Recording, bag: Bag, topics: Topics, own: OwnCamera | None) -> None:
    """Tells whether depth is registered, or how the depth camera stands to the colour camera, or warns."""
    if topics.depth_info is None or any(word in topics.depth for word in REGISTERED):
        return
    camera = _color_camera(recording, bag, topics, own)
    if camera is None:
        return
    place = f"{bag.path}, {topics.depth_info}"
    info = _first_info(bag, topics.depth_info)
    depth_camera = _camera(place, info, is_rectified(topics.depth))
    depth_frame = bag.message(topics.depth, 0).header.frame_id
    color_frame = bag.message(topics.color, 0).header.frame_id
    if depth_frame == color_frame and np.allclose(
        depth_camera.resize(camera.width, camera.height).matrix(), camera.matrix(), atol=0.5
    ):
        return
    T = np.eye(4) if depth_frame == color_frame else static_transform(bag, color_frame, depth_frame)
    if T is not None and is_valid_pose(T):
        distortion, fisheye = (None, False) if is_rectified(topics.depth) else _distortion(place, info)
        recording.depth_camera = DepthCamera(depth_camera, T, distortion, fisheye)
        return
    recording.warnings.append(
        f"depth ({depth_frame}) is of another camera than colour ({color_frame}), and /tf_static does not tell where "
        "it is: taken as if both stood at one place (`depth_camera` tells it)"
    )
    recording.depth_camera = DepthCamera(depth_camera, np.eye(4))


def _add_poses(recording: Recording, bag: Bag, topic: str) -> None:
    times, poses = poses_of(bag, topic)
    recording.take_poses(poses_at(recording.timestamps, times, poses), topic)
