# SPDX-License-Identifier: Apache-2.0
"""Pictures for reports: what scoring left in `renders/`, or rendered for it."""

from __future__ import annotations

import re
from collections.abc import Iterable
from pathlib import Path
from typing import Final

import cv2
import numpy as np

from ggslam.errors import FormatError, SequenceError
from ggslam.jobs.report.run_data import FrameView
from ggslam.objects.rendered_ids import object_ids
from ggslam.rendering.cpu import CpuRasterizer
from ggslam.reporting.pictures import color_of_depth, color_of_error, color_of_ids, color_to_uint8, depth_range
from ggslam.runs.folder import RunFolder
from ggslam.runs.objects_in_parts import ObjectsInParts
from ggslam.scene.frame import Frame
from ggslam.scene.poses import inverse
from ggslam.sequences import Sequence
from ggslam.system.images import read_picture
from ggslam.system.tuning import Tuning


class ReportViewTuning(Tuning):
    """The pictures of a report."""

    views = 4
    """Frames that are shown, spread over the recording."""
    max_width = 480
    """Largest width of a picture, in pixels."""


_GAP: Final = 4
"""White pixels between the parts of a picture that `reporting.pictures.compare` wrote."""
TRUTH, RENDER, DIFFERENCE = "recorded", "rendered", "difference (white: 20 % and more)"
TRUE_DEPTH, DEPTH, DEPTH_ERROR = "measured depth", "rendered depth", "difference of depth (white: 10 cm and more)"
_CAPTIONS = (
    (TRUTH, RENDER, DIFFERENCE), (TRUE_DEPTH, DEPTH, DEPTH_ERROR),
    ("objects, masks of the recording", "objects, rendered", "identity vectors (principal components)"),
)  # fmt: skip


def saved_views(folder: RunFolder) -> list[FrameView]:
    """The pictures that scoring left, cut apart."""
    files = sorted(folder.path.glob("renders/compare*.png"))
    chosen = (
        [files[i] for i in np.unique(np.linspace(0, len(files) - 1, ReportViewTuning.views).round().astype(int))]
        if files
        else []
    )
    recording = folder.sequence() if chosen else None
    views = []
    for path in chosen:
        number = re.fullmatch(r"compare(\d+)", path.stem)
        if recording is not None and number is not None:
            camera = recording.camera_of(int(number[1]))
            views.append(FrameView(int(number[1]), _cut(path, camera.height, camera.width)))
    return views


def _cut(path: Path, height: int, width: int) -> dict[str, np.ndarray]:
    sheet = read_picture(path, 3 * (width + _GAP) * 3 * (height + _GAP))
    rows = (sheet.shape[0] + _GAP) // (height + _GAP)
    if rows not in (2, 3) or sheet.shape[1] != 3 * width + 2 * _GAP:
        raise FormatError(f"{path}: not a comparison of images of {width}x{height}")
    pictures = {}
    for r in range(rows):
        for c in range(3):
            top, left = r * (height + _GAP), c * (width + _GAP)
            pictures[_CAPTIONS[r][c]] = small(sheet[top : top + height, left : left + width])
    return pictures


def small(picture: np.ndarray) -> np.ndarray:
    """A picture no wider than a report needs."""
    height, width = picture.shape[:2]
    if width <= ReportViewTuning.max_width:
        return np.ascontiguousarray(picture)
    size = (ReportViewTuning.max_width, round(height * ReportViewTuning.max_width / width))
    return cv2.resize(np.ascontiguousarray(picture), size, interpolation=cv2.INTER_AREA)


def rendered_views(folder: RunFolder, sequence: Sequence | None, frames: Iterable[int]) -> list[FrameView]:
    """Frames of a run rendered anew: colour, depth, ids of objects; beside the recorded images if they are there.

    Args:
        folder: of the run.
        sequence: its recording, or None.
        frames: indices of frames that were located.
    """
    recording, poses = folder.sequence(), folder.keyframes().poses()
    objects = ObjectsInParts.of(folder) if folder.has_objects() else None
    parts = folder.map_in_parts() if objects is None else objects.map
    rasterizer, views = CpuRasterizer(), []
    for number in frames:
        T_camera_world, camera = inverse(poses[number]), recording.camera_of(number)
        gaussians = parts.in_view(camera, T_camera_world)
        shown = rasterizer.forward(gaussians, camera, T_camera_world, features=objects is not None)
        color = color_to_uint8(shown.image.numpy())
        depth = np.where(shown.alpha.numpy() > 0.5, shown.expected_depth.numpy(), 0)
        pictures = _beside(_recorded_frame(sequence, number), color, depth)
        if objects is not None:
            ids = object_ids(rasterizer, shown, objects.around(gaussians))
            pictures[_CAPTIONS[2][1]] = color_of_ids(ids, objects.table.palette(), outlines=True)
        views.append(FrameView(number, {name: small(picture) for name, picture in pictures.items()}))
    return views


def _recorded_frame(sequence: Sequence | None, number: int) -> Frame | None:
    if sequence is None:
        return None
    try:
        return sequence.frame(number)
    except SequenceError:  # a damaged frame; the run went on without it
        return None


def _beside(frame: Frame | None, color: np.ndarray, depth: np.ndarray) -> dict[str, np.ndarray]:
    if frame is None:
        return {RENDER: color, DEPTH: color_of_depth(depth, *depth_range(depth))}
    limits = depth_range(frame.depth)
    error = np.abs(frame.color.astype(np.float32) - color.astype(np.float32)).mean(-1) / 255
    wrong = np.where((frame.depth > 0) & (depth > 0), np.abs(frame.depth - depth), 0)
    return {
        TRUTH: frame.color, RENDER: color, DIFFERENCE: color_of_error(error, 0.2),
        TRUE_DEPTH: color_of_depth(frame.depth, *limits), DEPTH: color_of_depth(depth, *limits),
        DEPTH_ERROR: color_of_error(wrong, 0.1),
    }  # fmt: skip


def pick_frames(frames: Iterable[int], count: int = ReportViewTuning.views) -> list[int]:
    """Some of the frames, first and last among them."""
    known = sorted(frames)
    chosen = np.unique(np.linspace(0, len(known) - 1, min(count, len(known))).round().astype(int))
    return [known[i] for i in chosen] if known else []
