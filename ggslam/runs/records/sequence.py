# SPDX-License-Identifier: Apache-2.0
"""sequence.json: where the recording of a run is and how it was read."""

from __future__ import annotations

from dataclasses import asdict
from typing import Annotated, Any, ClassVar

import pydantic

from ggslam.runs.records.record import Array, Number, NumberOrNone, Record, RecordFile
from ggslam.scene.camera import Camera


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


class SkippedRecord(Record):
    """A damaged frame that was passed over; see `sequences.sequence.SkippedFrame`."""

    index: int | None = None
    source_index: int | None = None
    reason: str


class PartRecord(Record):
    """One of the recordings of a run that was merged from several.

    Attributes:
        run: folder of the run of it.
        open, format, camera, frames: as of `SequenceRecord`.
        time_shift_s: seconds added to its times, so that those of the whole rise.
        T_joint_truth: [4, 4], brings its true poses into the world of the first recording's.
        mask_ids: what its mask ids are called in the merged run; None: as they are.
    """

    run: str
    open: OpenRecord
    format: str | None = None
    camera: Annotated[Camera, pydantic.PlainValidator(_camera), pydantic.PlainSerializer(asdict)]
    frames: int
    time_shift_s: Number = 0.0
    T_joint_truth: Array | None = None
    mask_ids: dict[int, int] | None = None


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

    def own_number(self, frame: int) -> int:
        """Number of a frame in its own recording; of a run with one recording the number itself."""
        for part in self.parts or []:
            if frame < part.frames:
                break
            frame -= part.frames
        return frame

    def notes(self) -> list[str]:
        """What a user should know of frames and masks besides the warnings, a line each."""
        notes = [f"skipped: {skipped.reason}" for skipped in self.skipped]
        return notes + [f"mask not used: {problem}" for problem in (self.mask_problems or {}).values()]
