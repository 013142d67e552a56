# SPDX-License-Identifier: Apache-2.0
"""Pictures of movers: recorded frames with boxes around what moves, and its paths."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import cv2
import numpy as np

from ggslam.errors import GgslamError
from ggslam.jobs.report.run_data import FrameView
from ggslam.jobs.report.views import small
from ggslam.runs.records.movers import MoverRecord, mover_colors
from ggslam.scene.camera import Camera
from ggslam.scene.poses import inverse, transform_points
from ggslam.sequences import Sequence as Recording
from ggslam.system.tuning import Tuning


class MoverPictureTuning(Tuning):
    """How movers are drawn."""

    pictures = 6
    """Most frames that are shown."""
    near_m = 0.05
    """Depth from which boxes are drawn, in metres."""


_EDGES = [(i, i | bit) for i in range(8) for bit in (1, 2, 4) if not i & bit]


def mover_views(
    recording: Recording | None, movers: Sequence[MoverRecord], poses: Mapping[int, np.ndarray]
) -> list[FrameView]:
    """A frame of each mover, the one in the middle of those in which it moves and is seen well, with the boxes and ways
    of all that move in it; none without the recording.

    Args:
        recording: of the run.
        movers: of the run.
        poses: T_world_camera [4, 4] by frame.
    """
    frames = sorted(
        {
            frame
            for mover in movers[: MoverPictureTuning.pictures]
            if (frame := _telling_frame(mover, poses)) is not None
        }
    )
    if recording is None:
        return []
    found = []
    for number in frames:
        try:
            shown = recording.frame(number, masks=False)
        except GgslamError:  # one damaged frame is no reason to stop
            continue
        picture = draw_movers(shown.color, shown.camera, poses[number], movers, number)
        found.append(FrameView(number, {f"frame {number}": small(picture)}))
    return found


def _telling_frame(mover: MoverRecord, poses: Mapping[int, np.ndarray]) -> int | None:
    shown = [f for f in mover.frames if f.frame in poses and f.share > 0]
    if not shown:
        return None
    enough = float(np.median([f.share for f in shown]))
    well = [f.frame for f in shown if f.share >= enough]
    return well[len(well) // 2]


def draw_movers(
    color: np.ndarray, camera: Camera, T_world_camera: np.ndarray, movers: Sequence[MoverRecord], frame: int
) -> np.ndarray:
    """The image uint8 [H, W, 3] with boxes and ways of what moves in the frame."""
    picture, T = np.ascontiguousarray(color).copy(), inverse(T_world_camera)
    paints = mover_colors(movers)
    for mover in movers:
        here = mover.frame(frame)
        if here is None:
            continue
        corners, way = transform_points(here.corners(), T), transform_points(mover.way(), T)
        lines = [(corners[i], corners[j]) for i, j in _EDGES]
        lines += [(a, b) for a, b in zip(way[:-1], way[1:], strict=True)]
        for a, b in lines:
            if min(a[2], b[2]) > MoverPictureTuning.near_m:
                cv2.line(picture, _pixel(a, camera), _pixel(b, camera), paints[mover.id], 1, cv2.LINE_AA)
        top = corners[corners[:, 2] > MoverPictureTuning.near_m]
        if len(top):
            u, v = min((_pixel(corner, camera) for corner in top), key=lambda pixel: pixel[1])
            u, v = min(max(u, 2), camera.width - 60), min(max(v - 3, 10), camera.height - 3)
            cv2.putText(picture, mover.title, (u, v), cv2.FONT_HERSHEY_SIMPLEX, 0.35, paints[mover.id], 1, cv2.LINE_AA)
    return picture


def _pixel(point: np.ndarray, camera: Camera) -> tuple[int, int]:
    u, v = camera.fx * point[0] / point[2] + camera.cx, camera.fy * point[1] / point[2] + camera.cy
    return int(np.clip(u, -9999, 9999)), int(np.clip(v, -9999, 9999))
