# SPDX-License-Identifier: Apache-2.0
"""Frames with poses, and object ids where they are known, of a run or a recording: what volumes are made of."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, field
from pathlib import Path

import cv2
import numpy as np

from ggslam.driving.body import Body, CameraBody
from ggslam.errors import ConfigError, RunFolderError
from ggslam.objects.rendered_ids import object_ids
from ggslam.objects.segmented_map import SegmentedMap
from ggslam.rendering.cpu import CpuRasterizer
from ggslam.runs.folder import RunFolder
from ggslam.runs.recordings import SequenceRequest, open_recording_of
from ggslam.scene.camera import Camera
from ggslam.scene.frame import Frame
from ggslam.scene.poses import inverse, is_valid_pose
from ggslam.sequences import Sequence
from ggslam.sequences.rig import RigSequence
from ggslam.system.plurals import quantity, word_for
from ggslam.system.tuning import Tuning


class FarFrameTuning(Tuning):
    """When a frame is far from the others."""

    min_distance_m = 1000.0
    """Distance from the middle of all frames, in metres..."""
    min_ratio = 100.0
    """...which is also this many times the median distance."""


@dataclass(frozen=True)
class PosedFrame:
    """A frame whose pose is known.

    Attributes:
        frame: the images.
        T_world_camera: float64 [4, 4].
        labels: object ids uint16 [H, W], 0 = none; None when this frame tells of no objects.
    """

    frame: Frame
    T_world_camera: np.ndarray
    labels: np.ndarray | None = None


@dataclass
class FrameSource:
    """Frames of a recording with their poses.

    Attributes:
        name: of the run or recording, for people.
        sequence: the recording.
        poses: T_world_camera float64 [4, 4] by frame index.
        label: object ids of a frame, None if it tells of none; None without objects.
        names: of object ids.
        notes: what a user should know.
        body: of the robot, which is left out of depth; None: nothing is.
    """

    name: str
    sequence: Sequence
    poses: dict[int, np.ndarray]
    label: Callable[[Frame, np.ndarray], np.ndarray | None] | None = None
    names: dict[int, str] = field(default_factory=dict)
    notes: list[str] = field(default_factory=list)
    body: CameraBody | None = None

    def __len__(self) -> int:
        return len(self.poses)

    def __iter__(self) -> Iterator[PosedFrame]:
        """All frames whose pose is known, in order."""
        for frame in self.sequence.stream(masks="lazy" if self.label is not None else False):
            T = self.poses.get(frame.index)
            if T is not None:
                frame = frame if self.body is None else self.body.without(frame)
                yield PosedFrame(frame, T, None if self.label is None else self.label(frame, T))


def body_of(body: Body | None, sequence: Sequence) -> CameraBody | None:
    """A body as the cameras of a recording have it."""
    if body is None:
        return None
    return CameraBody(body, sequence.rig.T_first_camera if isinstance(sequence, RigSequence) else None)


def frames_of_run(
    folder: RunFolder, recording: Path | None = None, scale: float | None = None, objects: bool = True
) -> FrameSource:
    """The frames that a run located, at its poses.

    Args:
        folder: of the run.
        recording: where the recording is now, if it was moved.
        scale: of the images; None: as the run read them.
        objects: whether object ids are wanted, if the run has any.

    Raises:
        RunFolderError, SequenceError: the run or its recording cannot be read.
    """
    sequence = open_recording_of(folder, recording, scale=scale)
    record = folder.keyframes()
    source = FrameSource(str(folder.path), sequence, record.poses())
    if not source.poses:
        raise RunFolderError(f"{folder.path}: no frame of this run was located")
    lacking = len(sequence) - len(source.poses)
    if lacking:
        source.notes.append(f"left out {quantity(lacking, 'frame')} that the run did not locate")
    far = far_away(source.poses)
    if far:
        which = f"{len(far)}, the first of frame {far[0]}"
        source.notes.append(f"poses far from all others are left out as damaged: {which}")
        source.poses = {frame: T for frame, T in source.poses.items() if frame not in far}
    if folder.mark().edits:
        source.notes.append("the run was edited; volumes show what was recorded")
    if objects and folder.has_objects():
        segmented = folder.segmented_map()
        source.names = {o.id: o.name for o in segmented.table.objects if o.name}
        if segmented.table.supervision == "masks" and sequence.has_masks:
            source.label = _own_mask
        else:
            keyframes = record.keyframe_numbers()
            source.label = _RenderedIds(segmented, folder.sequence().camera_of, keyframes)
    return source


def far_away(poses: Mapping[int, np.ndarray]) -> list[int]:
    """Frames at which the camera was much farther from the rest than anybody walks, of poses [4, 4] by frame."""
    frames, places = list(poses), np.array([T[:3, 3] for T in poses.values()], np.float64)
    off = np.linalg.norm(places - np.median(places, axis=0), axis=1)
    return [
        frames[k]
        for k in np.flatnonzero(
            off > max(FarFrameTuning.min_distance_m, FarFrameTuning.min_ratio * float(np.median(off)))
        )
    ]


def frames_of_recording(request: SequenceRequest, objects: bool = True) -> FrameSource:
    """The frames of a recording at the poses that it tells itself.

    Raises:
        SequenceError: it cannot be read.
        ConfigError: it tells no poses.
    """
    sequence = request.open()
    truth = sequence.ground_truth
    poses = {} if truth is None else {i: T for i, T in enumerate(truth) if is_valid_pose(T)}
    if not poses:
        why = f" ({sequence.pose_problem})" if sequence.pose_problem else ""
        raise ConfigError(
            f"{sequence.path}: this recording tells no poses{why}; track it with `live`, or give the folder of a run "
            "of it"
        )
    source = FrameSource(str(sequence.path), sequence, poses, names=dict(sequence.instance_names))
    source.notes.append(f"poses of the recording itself ({sequence.pose_source})")
    if len(poses) < len(sequence):
        left_out = len(sequence) - len(poses)
        source.notes.append(f"{quantity(left_out, 'frame')} without a pose {word_for(left_out, 'is', 'are')} left out")
    if objects and sequence.has_masks:
        source.label = _own_mask
    return source


def _own_mask(frame: Frame, T_world_camera: np.ndarray) -> np.ndarray | None:
    return frame.load_mask()


class _RenderedIds:
    """Object ids as a run's map shows them, in its keyframes."""

    def __init__(self, segmented: SegmentedMap, camera_of: Callable[[int], Camera], keyframes: set[int]) -> None:
        self._segmented, self._camera_of, self._keyframes = segmented, camera_of, keyframes
        self._rasterizer = CpuRasterizer()

    def __call__(self, frame: Frame, T_world_camera: np.ndarray) -> np.ndarray | None:
        if frame.index not in self._keyframes:
            return None
        gaussians, T_camera_world = self._segmented.gaussians, inverse(T_world_camera)
        view = self._rasterizer.forward(gaussians, self._camera_of(frame.index), T_camera_world, features=True)
        ids = object_ids(self._rasterizer, view, self._segmented)
        size = (frame.camera.width, frame.camera.height)
        return ids if ids.shape[::-1] == size else cv2.resize(ids, size, interpolation=cv2.INTER_NEAREST)
