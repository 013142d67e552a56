# SPDX-License-Identifier: Apache-2.0
"""What a page needs to know of a map besides its splats, for JSON; the same for a page of one file and a served one."""

from __future__ import annotations

import base64
import json
import struct
from dataclasses import asdict
from typing import Any

import cv2
import numpy as np

from ggslam.rendering.types import focal_of
from ggslam.system.json_files import json_ready
from ggslam.system.tuning import Tuning
from ggslam.viewer.cameras import CameraTuning, best_view, top_view, vertical_fov, view_of_pose
from ggslam.viewer.model import Box, ListedObject, ShownChange, ShownMover, ViewedMap


class SceneValuesTuning(Tuning):
    """How much of a recording a page is told."""

    max_path_points = 2000
    """Most points of each path."""
    max_keyframes = 1000
    """Most keyframes that are marked."""
    max_frames = 2000
    """Most frames that can be gone to."""
    pictures_in_file = 24
    """Most frames with pictures in a page of one file."""
    jpeg_quality = 80
    """Quality of JPEG, of 100."""


def scene_values(model: ViewedMap, title: str, caption: str = "") -> dict[str, Any]:
    """What is in a map.

    Args:
        model: the map.
        title: of the page.
        caption: a line below the map; "": none.
    """
    poses = np.stack(list(model.frame_poses.values()))
    centers, fov = model.centers(), vertical_fov(model.camera)
    start = view_of_pose(poses[0], CameraTuning.look_ahead_m)
    top = top_view(centers, poses[:, :3, 3], poses[0, :3, 2], model.up, fov)
    frames = list(model.frame_poses)
    shown = [frames[i] for i in _spread(len(frames), SceneValuesTuning.max_frames)]
    step = max(1, len(poses) // SceneValuesTuning.max_path_points)
    keyframes = model.keyframe_poses[:: max(1, len(model.keyframe_poses) // SceneValuesTuning.max_keyframes)]
    camera = model.camera
    values = {
        "title": title, "caption": caption, "about": model.describe(), "up": model.up, "fov": fov,
        "floor": {"height": model.floor, "found": model.floor is not None},
        "camera": {"width": camera.width, "height": camera.height, "fx": camera.fx, "fy": camera.fy,
                   "cx": camera.cx, "cy": camera.cy},
        "trained_focals": [focal_of(camera) for camera in model.training_cameras],
        "objects": [_object_values(record) for record in model.objects()],
        "views": {"Start": asdict(start), "Top": asdict(top)},
        "path": [walk[::step].round(4) for walk in model.walks],
        "keyframes": [T.round(5).ravel() for T in keyframes],
        "frames": [
            {"frame": frame, "T": model.frame_poses[frame].round(6).ravel(),
             "view": asdict(view_of_pose(model.frame_poses[frame], CameraTuning.look_ahead_m))}
            for frame in shown
        ],
        "movers": [_mover_values(mover) for mover in model.movers()],
        "changes": [_change_values(change, model) for change in model.changes()],
    }  # fmt: skip
    return dict(json_ready(values))


def _spread(count: int, most: int) -> list[int]:
    return [int(i) for i in np.unique(np.linspace(0, count - 1, most).round().astype(int))]


def _object_values(record: ListedObject) -> dict[str, Any]:
    return {
        "id": record.id, "name": record.name, "color": record.color, "gaussians": record.gaussians,
        "center": record.center, "axes": record.axes, "size": record.size, "centroid": record.centroid,
    }  # fmt: skip


def _mover_values(mover: ShownMover) -> dict[str, Any]:
    boxes = {str(frame): _box_values(box) for frame, box in mover.boxes.items()}
    return {"way": mover.way.round(4), "boxes": boxes, "color": mover.color}


def _change_values(change: ShownChange, model: ViewedMap) -> dict[str, Any]:
    view = best_view(change.boxes(), list(model.frame_poses.values()), model.camera, 0.05)
    return {
        "text": change.text, "old": _box_values(change.old), "new": _box_values(change.new), "view": asdict(view),
        "picture": None if change.picture is None else jpeg_address(change.picture),
    }  # fmt: skip


def _box_values(box: Box | None) -> dict[str, Any] | None:
    return None if box is None else {"center": box[0], "axes": box[1], "size": box[2]}


def packed_chunk(header: dict[str, Any], content: bytes) -> bytes:
    """Splats for a page: the length of the header (uint32, little-endian), the header as JSON, and the packed bytes."""
    text = json.dumps(json_ready(header)).encode()
    return struct.pack("<I", len(text)) + text + content


def jpeg(picture: np.ndarray) -> bytes:
    """A picture uint8 [H, W, 3] as a JPEG file."""
    quality = [cv2.IMWRITE_JPEG_QUALITY, SceneValuesTuning.jpeg_quality]
    return cv2.imencode(".jpg", picture[..., ::-1], quality)[1].tobytes()


def jpeg_address(picture: np.ndarray) -> str:
    """A picture uint8 [H, W, 3] as an address that holds it."""
    return "data:image/jpeg;base64," + base64.b64encode(jpeg(picture)).decode("ascii")
