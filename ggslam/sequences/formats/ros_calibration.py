# SPDX-License-Identifier: Apache-2.0
"""Calibration in messages of ROS: camera_info, and how a depth camera stands to the colour camera."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np

from ggslam.scene.camera import Camera
from ggslam.scene.poses import is_valid_pose
from ggslam.sequences.camera_files.lens_models import distortion_of
from ggslam.sequences.formats.ros_topics import REGISTERED
from ggslam.sequences.json_files import camera_of
from ggslam.sequences.recording import DepthCamera


@dataclass(frozen=True)
class Lens:
    """The content of a camera_info message; see `Recording`."""

    camera: Camera | None
    distortion: np.ndarray | None = None
    fisheye: bool = False


@dataclass(frozen=True)
class DepthInfo:
    """A camera_info of depth: where it comes from, for messages, the message, and whether the images are rectified."""

    place: str
    info: Any
    rectified: bool


@dataclass(frozen=True)
class DepthStand:
    """How depth stands to colour. `camera`: of depth that is to be registered, None: it is; `doubt`: what is not known
    about it, a sentence."""

    camera: DepthCamera | None
    doubt: str = ""


def value_of(info: Any, name: str) -> Any:
    """Field of a camera_info: ROS 1 writes K, D, P in capitals."""
    return getattr(info, name) if hasattr(info, name) else getattr(info, name.upper())


def is_calibrated(info: Any) -> bool:
    """Whether a camera_info tells a camera: drivers send zeros before they have read their calibration."""
    return bool(np.asarray(value_of(info, "k"), float).reshape(-1)[0] > 0 and info.width > 0)


def is_registered(topic: str) -> bool:
    """Whether a topic says that its depth is registered to colour."""
    return any(word in topic for word in REGISTERED)


def lens_of(place: str, info: Any, rectified: bool) -> Lens:
    """Camera and distortion of a camera_info; of images that are rectified its P alone.

    Raises:
        SequenceError: it is no camera that is known; names `place`.
    """
    return Lens(_camera(place, info, rectified), *_distortion(place, info, rectified))


def _distortion(place: str, info: Any, rectified: bool) -> tuple[np.ndarray | None, bool]:
    if rectified:
        return None, False
    return distortion_of(place, str(info.distortion_model), np.asarray(value_of(info, "d"), float).reshape(-1))


def _camera(place: str, info: Any, rectified: bool) -> Camera:
    K = np.asarray(value_of(info, "p" if rectified else "k"), float).reshape(3, -1)
    numbers = (float(K[0, 0]), float(K[1, 1]), float(K[0, 2]), float(K[1, 2]))
    camera = camera_of(place, int(info.width), int(info.height), *numbers)
    region = info.roi
    sizes = (int(region.width), int(region.height))
    if sizes == (camera.width, camera.height) or min(sizes) <= 0 or region.width > camera.width:
        return camera
    # K and P are those of the whole sensor; the images are a part of it.
    cx, cy = camera.cx - int(region.x_offset), camera.cy - int(region.y_offset)
    return camera_of(place, *sizes, camera.fx, camera.fy, cx, cy)


def place_of_depth(
    color: Camera, depth: DepthInfo, color_frame: str, depth_frame: str,
    transform: Callable[[str, str], np.ndarray | None],
) -> DepthStand:  # fmt: skip
    """Tells whether depth is registered, or how the depth camera stands to the colour camera.

    Args:
        color: camera of colour.
        depth: camera_info of depth.
        color_frame, depth_frame: frames of their images.
        transform: T_to_from [4, 4] of two frames, (to, from); None where it is not known.

    Raises:
        SequenceError: the camera_info of depth is of no camera that is known.
    """
    camera = _camera(depth.place, depth.info, depth.rectified)
    same = depth_frame == color_frame
    if same and np.allclose(camera.resize(color.width, color.height).matrix(), color.matrix(), atol=0.5):
        return DepthStand(None)
    T = np.eye(4) if same else transform(color_frame, depth_frame)
    if T is not None and is_valid_pose(T):
        return DepthStand(DepthCamera(camera, T, *_distortion(depth.place, depth.info, depth.rectified)))
    doubt = (
        f"depth ({depth_frame}) is of another camera than colour ({color_frame}), and /tf_static does not tell where "
        "it is: taken as if both stood at one place"
    )
    return DepthStand(DepthCamera(camera, np.eye(4)), doubt)
