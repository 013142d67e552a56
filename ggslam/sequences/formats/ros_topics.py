# SPDX-License-Identifier: Apache-2.0
"""Which topics of a bag hold colour, depth and their calibration, and where the two cameras are to each other."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

from ggslam.errors import SequenceError
from ggslam.scene.poses import inverse, quaternion_to_matrix
from ggslam.sequences.formats.ros_images import COLOR, DEPTH, is_depth, pixel_encoding
from ggslam.sequences.formats.ros_messages import NO_MESSAGE, Bag

ROLES = ("color", "depth", "color_info", "depth_info", "pose")
"""What a topic can be given for by name; the poses are of the colour camera (optical axes), to the world."""
IMAGE_TYPES = ("sensor_msgs/Image", "sensor_msgs/CompressedImage")
INFO_TYPE = "sensor_msgs/CameraInfo"
STATIC_FRAMES = "/tf_static"
UNKNOWN = ", which is not supported"
REGISTERED = ("aligned_depth", "depth_registered", "depth_to_color", "depth_to_rgb")
"""Parts of names of topics whose depth images are registered to colour already."""


@dataclass(frozen=True)
class Topics:
    """Topics by role; `color_info`, `depth_info` and `pose` may be absent."""

    color: str
    depth: str
    color_info: str | None
    depth_info: str | None
    pose: str | None


def find_topics(bag: Bag, given: Mapping[str, str]) -> Topics:
    """The topics of a recording: those given by name, the others by the type and encoding of their messages.

    Raises:
        SequenceError: a given topic is not there, or none or several fit a role.
    """
    for role, topic in given.items():
        if topic not in bag.types:
            raise SequenceError(f"{bag.path}: no topic {topic} (for {role}); it holds {', '.join(sorted(bag.types))}")
        wanted = IMAGE_TYPES if role in ("color", "depth") else (INFO_TYPE,) if role.endswith("_info") else ()
        if wanted and bag.types[topic] not in wanted:
            expected = " or ".join(wanted)
            raise SequenceError(f"{bag.path}: {topic} (for {role}) holds {bag.types[topic]}, expected {expected}")
    kinds: dict[str, tuple[bool | None, str]] = {}
    if not {"color", "depth"} <= set(given):
        kinds = {topic: _kind(bag, topic) for topic, name in bag.types.items() if name in IMAGE_TYPES}
    colors = {topic: _color_score(topic) for topic, (holds_depth, _) in kinds.items() if holds_depth is False}
    depths = {topic: _depth_score(topic) for topic, (holds_depth, _) in kinds.items() if holds_depth}
    held = {topic: kind for topic, (_, kind) in kinds.items()}
    color = given.get("color") or _best(bag, "color", colors, held)
    depth = given.get("depth") or _best(bag, "depth", depths, held)
    color_info = given.get("color_info") or info_above(color, bag.types)
    depth_info = given.get("depth_info") or info_above(depth, bag.types)
    return Topics(color, depth, color_info, depth_info, given.get("pose"))


def _kind(bag: Bag, topic: str) -> tuple[bool | None, str]:
    """Whether images are depth (None: neither depth nor colour that is known), and what is in the topic, in words."""
    try:
        message = bag.message(topic, 0)
    except SequenceError as error:  # none to choose
        return None, "no messages" if str(error).endswith(NO_MESSAGE) else "damaged"
    holds_depth = is_depth(message)
    return holds_depth, f"encoding '{pixel_encoding(message)}'{UNKNOWN if holds_depth is None else ''}"


def is_rectified(topic: str) -> bool:
    """Whether a topic says that its images are rectified, as `image_rect`, `image_rect_color` or `rectified` do."""
    names = topic.removesuffix("/compressed").removesuffix("/compressedDepth").rsplit("/", 1)[-1].split("_")
    return "rect" in names or "rectified" in names


def _color_score(topic: str) -> float:
    score = 2.0 * any(word in topic for word in ("color", "rgb")) - 2.0 * any(
        word in topic for word in ("depth", "infra", "ir/", "confidence", "mask", "left", "right", "fisheye")
    )
    return score + 0.5 * is_rectified(topic) - 0.25 * topic.endswith("compressed")


def _depth_score(topic: str) -> float:
    score = 2.0 * ("depth" in topic) + any(word in topic for word in REGISTERED)
    return score - 4.0 * ("confidence" in topic or "infra" in topic) - 0.25 * topic.endswith("compressedDepth")


def _best(bag: Bag, role: str, scores: dict[str, float], kinds: dict[str, str]) -> str:
    """The topic that suits a role best; `kinds` tells for messages what is in each topic of images."""
    if not scores:
        held = ", ".join(f"{topic} ({kinds.get(topic, name)})" for topic, name in sorted(bag.types.items()))
        if not held:
            raise SequenceError(f"{bag.path}: is a bag without any topic: nothing was recorded")
        known = ", ".join(COLOR if role == "color" else DEPTH)
        read = f"; {role} is read as {known}, JPEG or PNG" if UNKNOWN in held else ""
        raise SequenceError(f"{bag.path}: no topic of {role} images; it holds {held}{read}")
    ranked = sorted(scores, key=lambda topic: (-scores[topic], topic))
    if len(ranked) > 1 and scores[ranked[0]] == scores[ranked[1]]:
        raise SequenceError(
            f"{bag.path}: several topics may be {role}: {', '.join(ranked[:4])}; choose with `topics` {role}=TOPIC"
        )
    return ranked[0]


def info_above(topic: str, types: Mapping[str, str]) -> str | None:
    """The camera_info nearest above an image topic: /camera/color/image_raw -> /camera/color/camera_info. `types`:
    topic -> type of its messages, without /msg/."""
    parts = topic.split("/")
    for end in range(len(parts) - 1, 0, -1):
        base = "/".join(parts[:end])
        for name in (f"{base}/camera_info", f"{base}/info/camera_info"):
            if types.get(name) == INFO_TYPE:
                return name
    return None


def pose_of(transform: Any) -> np.ndarray:
    """Pose [4, 4] of a geometry_msgs Pose or Transform; NaN if it is none."""
    place = transform.position if hasattr(transform, "position") else transform.translation
    turn = transform.orientation if hasattr(transform, "orientation") else transform.rotation
    quaternion = np.array([turn.w, turn.x, turn.y, turn.z])
    T = np.full((4, 4), np.nan)
    if np.isfinite(quaternion).all() and np.linalg.norm(quaternion) > 0.5:
        T = np.eye(4)
        T[:3, :3], T[:3, 3] = quaternion_to_matrix(quaternion), (place.x, place.y, place.z)
    return T


def poses_of(bag: Bag, topic: str) -> tuple[np.ndarray, np.ndarray]:
    """Times float64 [n] and poses float64 [n, 4, 4] of PoseStamped, Odometry or TransformStamped messages.

    Raises:
        SequenceError: the topic holds messages of another type.
    """
    times, poses = [], []
    logged = bag.log_times(topic)
    for message in bag.messages(topic):
        held = _pose_in(message)
        if held is None:
            raise SequenceError(f"{bag.path}, {topic}: {bag.types[topic]} holds no pose")
        stamp = message.header.stamp
        times.append(float(stamp.sec + 1e-9 * stamp.nanosec))
        poses.append(pose_of(held))
    found = np.array(times) if any(times) else logged  # without stamps: when they were recorded
    return found, np.array(poses).reshape(-1, 4, 4)


def check_holds_poses(bag: Bag, topic: str) -> None:
    """Raises SequenceError if a topic that a user names for poses is of another kind; an empty one passes."""
    try:
        message = bag.message(topic, 0)
    except SequenceError:  # empty or damaged: then there are no poses
        return
    if _pose_in(message) is None:
        raise SequenceError(f"{bag.path}, {topic}: {bag.types[topic]} holds no pose")


def _pose_in(message: Any) -> Any | None:
    """What holds position and turn in a PoseStamped, Odometry or TransformStamped; None in another message."""
    held = message
    while hasattr(held, "pose"):  # PoseStamped holds one, Odometry and PoseWithCovarianceStamped two
        held = held.pose
    held = getattr(held, "transform", held)
    is_pose = hasattr(message, "header") and (hasattr(held, "orientation") or hasattr(held, "rotation"))
    return held if is_pose else None


def static_transform(bag: Bag, to_frame: str, from_frame: str) -> np.ndarray | None:
    """T_to_from [4, 4] by the fixed frames of the bag; None if they do not connect the two."""
    if STATIC_FRAMES not in bag.types:
        return None
    return fixed_transform(bag.messages(STATIC_FRAMES), to_frame, from_frame)


def fixed_transform(messages: Iterable[Any], to_frame: str, from_frame: str) -> np.ndarray | None:
    """T_to_from [4, 4] by messages of /tf_static; None if they do not connect the two."""
    steps: dict[str, list[tuple[str, np.ndarray]]] = {}
    for message in messages:
        for link in message.transforms:
            parent, child = link.header.frame_id.lstrip("/"), link.child_frame_id.lstrip("/")
            T = pose_of(link.transform)
            steps.setdefault(child, []).append((parent, T))
            steps.setdefault(parent, []).append((child, inverse(T)))
    reached = {from_frame.lstrip("/"): np.eye(4)}
    waiting = list(reached)
    while waiting:
        frame = waiting.pop()
        for other, T in steps.get(frame, []):
            if other not in reached:
                reached[other] = T @ reached[frame]
                waiting.append(other)
    return reached.get(to_frame.lstrip("/"))
