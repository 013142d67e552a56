# SPDX-License-Identifier: Apache-2.0
"""annotations.json and camera_keys.json: what people noted at places of a map, and the camera of a film, both made in
the viewer. They may come from anybody and are data: texts are never read as markup."""

from __future__ import annotations

from typing import Annotated, Any, ClassVar, Final

import pydantic

from ggslam.runs.records.record import Number, Record, RecordFile


def _vector(value: Any) -> list[float]:
    if not isinstance(value, list) or len(value) != 3:
        raise ValueError("expected three numbers")
    numbers = [v for v in value if isinstance(v, (int, float)) and not isinstance(v, bool) and abs(v) < 1e9]
    if len(numbers) != 3:
        raise ValueError("expected three finite numbers")
    return [float(v) for v in numbers]


Vector = Annotated[list[float], pydantic.PlainValidator(_vector)]
"""Three finite numbers."""
MOST: Final = 10_000
"""Most annotations or camera keys: as many as a page still lists."""


class Annotation(Record):
    """A text at a place: `point` in metres, world frame."""

    point: Vector
    text: Annotated[str, pydantic.StringConstraints(max_length=2000)]


class AnnotationsRecord(RecordFile):
    """What people noted at places of a map."""

    FILE: ClassVar[str] = "annotations.json"
    annotations: Annotated[list[Annotation], pydantic.Field(max_length=MOST)] = []


class CameraKey(Record):
    """Where a film's camera is at a time.

    `time` in seconds; `position` and `look_at` in metres and the direction `up`, in the world frame; `fov` along the
    shorter side of the picture, in radians, None: as the recording's camera."""

    time: Number
    position: Vector
    look_at: Vector
    up: Vector
    fov: Annotated[float, pydantic.Field(gt=0.01, lt=3.1)] | None = None


class CameraKeysRecord(RecordFile):
    """The camera of a film, by keys in rising order of time."""

    FILE: ClassVar[str] = "camera_keys.json"
    fps: Annotated[float, pydantic.Field(ge=1, le=240)] = 30.0
    keys: Annotated[list[CameraKey], pydantic.Field(max_length=MOST)] = []
