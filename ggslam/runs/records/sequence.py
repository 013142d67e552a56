# SPDX-License-Identifier: Apache-2.0
"""sequence.json: where the recording of a run is and how it was read."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict
from functools import cached_property
from typing import Annotated, Any, ClassVar

import numpy as np
import pydantic

from ggslam.runs.records.record import Array, Number, NumberOrNone, Record, RecordFile
from ggslam.scene.camera import Camera
from ggslam.scene.poses import inverse


def _camera(value: Any) -> Camera:
    if isinstance(value, Camera):
        return value
    try:
        return Camera(**value)
    except (TypeError, OverflowError):
        raise ValueError("expected width, height, fx, fy, cx and cy of a camera") from None


class OpenRecord(Record):
    """How the recording is opened again; see `recordings.SequenceRequest`."""

    model_config = pydantic.ConfigDict(extra="forbid")

    path: str
    format: str | None = None
    start: int = 0
    stop: int | None = None
    stride: int = 1
    scale: Number = 1.0
    masks: str | None = None
    depth_scale: NumberOrNone = None
    on_bad_frame: str = "error"
    depth_camera: str | None = None
    min_confidence: int | None = None
    topics: list[str] = []
    pose_convention: str | None = None
    camera: str | None = None
    intrinsics: str | None = None
    depth_kind: str | None = None
    depth_delay: str | None = None
    upright: bool = False
    void_id: int | None = None


class SkippedRecord(Record):
    """A damaged frame that was skipped; see `sequences.sequence.SkippedFrame`."""

    index: int | None = None
    source_index: int | None = None
    reason: str


class RigRecord(Record):
    """The cameras of a rig, and which of them took the frames of its recordings; see `sequences.rig.RigSequence`.

    Attributes:
        names: of the cameras.
        cameras: of their images as the run saw them.
        T_first_camera: [n, 4, 4], from each camera's frame to the first one's.
        tolerance: seconds between images that count as taken together.
        instants: of each camera the instants at which it has a frame, as ranges [first, one past the last].
    """

    names: list[str]
    cameras: list[Annotated[Camera, pydantic.PlainValidator(_camera), pydantic.PlainSerializer(asdict)]]
    T_first_camera: Array
    tolerance: Number = 0.0
    instants: list[list[tuple[int, int]]]

    @cached_property
    def places(self) -> np.ndarray:
        """Instant and camera number of each frame, int64 [n, 2]."""
        rows = [
            np.stack([np.arange(first, end), np.full(end - first, number)], 1)
            for number, ranges in enumerate(self.instants) for first, end in ranges
        ]  # fmt: skip
        places = np.concatenate([np.zeros((0, 2), int), *rows])
        return places[np.lexsort((places[:, 1], places[:, 0]))]

    def first_of_instants(self, frames: Sequence[int]) -> np.ndarray:
        """Of frames, in order, the positions in the list of those that are the first of their instants: they stand for
        the rig, in trajectory.txt and ground_truth.txt."""
        return np.unique(self.places[np.array(frames, int), 0], return_index=True)[1]

    def pose_of_first(self, T_world_camera: np.ndarray, frame: int) -> np.ndarray:
        """T_world_first [4, 4] by the pose of a frame, whichever camera took it."""
        return T_world_camera @ inverse(self.T_first_camera[self.places[frame, 1]])


class PartRecord(Record):
    """One of the recordings of a run that was merged from several.

    Attributes:
        run: folder of the run of it.
        open, format, camera, frames, rig: as of `SequenceRecord`.
        time_shift_s: seconds added to its times, so that those of the whole rise.
        T_joint_truth: [4, 4], brings its true poses into the world of the first recording's.
        mask_ids: what its mask ids are called in the merged run; None: as they are.
        past: whether it shows an earlier state of the place than the map, so that the map is not scored against it.
    """

    run: str
    open: OpenRecord
    format: str | None = None
    camera: Annotated[Camera, pydantic.PlainValidator(_camera), pydantic.PlainSerializer(asdict)]
    frames: int
    time_shift_s: Number = 0.0
    T_joint_truth: Array | None = None
    mask_ids: dict[int, int] | None = None
    rig: RigRecord | None = None
    past: bool = False


class SequenceRecord(RecordFile):
    """The recording of a run.

    Attributes:
        open: how to open it again.
        format: name of its format.
        camera: of the images as the run saw them.
        frames: their number.
        warnings, skipped, mask_problems: what was wrong with it; problems by file or frame.
        map: folder of the run whose map this one began with.
        map_fingerprint: of that run, see `recordings.fingerprint`.
        parts: of a merged run its recordings; `open`, `format` and `camera` are the first one's then, `frames` are all.
        rig: of a run of a rig its cameras; `camera` is the first one then.
    """

    FILE: ClassVar[str] = "sequence.json"
    open: OpenRecord
    format: str | None = None
    camera: Annotated[Camera, pydantic.PlainValidator(_camera), pydantic.PlainSerializer(asdict)]
    frames: int | None = None
    warnings: list[str] = []
    skipped: list[SkippedRecord] = []
    mask_problems: dict[str, str] | None = None
    map: str | None = None
    map_fingerprint: str | None = None
    parts: list[PartRecord] | None = None
    rig: RigRecord | None = None

    def own_number(self, frame: int) -> int:
        """Number of a frame in its own recording, of a rig's that of its instant; of a run with one recording the
        number itself."""
        part, own = self._part_of(frame)
        return own if part.rig is None else int(part.rig.places[own, 0])

    def is_past(self, frame: int) -> bool:
        """Whether a frame shows an earlier state of the place than the map."""
        part = self._part_of(frame)[0]
        return isinstance(part, PartRecord) and part.past

    def walk_of(self, frame: int) -> tuple[int, int]:
        """Numbers of a frame's recording and, of a rig, of its camera: frames of one walk follow one another."""
        part, own = self._part_of(frame)
        recording = 0 if part is self else [part is other for other in self.parts or []].index(True)
        return recording, 0 if part.rig is None else int(part.rig.places[own, 1])

    def camera_of(self, frame: int) -> Camera:
        """The camera that took a frame, as the run saw its images."""
        part, own = self._part_of(frame)
        return part.camera if part.rig is None else part.rig.cameras[part.rig.places[own, 1]]

    def cameras(self) -> list[Camera]:
        """All that took frames, each once."""
        parts: list[SequenceRecord | PartRecord] = [*self.parts] if self.parts else [self]
        found = [camera for part in parts for camera in ([part.camera] if part.rig is None else part.rig.cameras)]
        return list(dict.fromkeys(found))

    def _part_of(self, frame: int) -> tuple[SequenceRecord | PartRecord, int]:
        """The recording of a frame, and its number there."""
        for part in self.parts or []:
            if frame < part.frames:
                return part, frame
            frame -= part.frames
        return self, frame

    def notes(self) -> list[str]:
        """What a user should know of frames and masks besides the warnings, a line each."""
        notes = [f"skipped: {skipped.reason}" for skipped in self.skipped]
        return notes + [f"mask not used: {problem}" for problem in (self.mask_problems or {}).values()]
