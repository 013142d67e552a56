# SPDX-License-Identifier: Apache-2.0
"""What a grid store remembers of a run that filled it."""

from __future__ import annotations

from typing import Any

import pydantic

from ggslam.errors import FormatError
from ggslam.runs.records.keyframes import KeyframeRecord
from ggslam.runs.records.record import Array, Record, explain
from ggslam.runs.records.sequence import SequenceRecord
from ggslam.scene.camera import Camera
from ggslam.slam.config import Config, config_from_dict


class VisitRecord(Record):
    """A run that filled a store.

    Attributes:
        run: its folder.
        sequence: its recording.
        config: its settings.
        keyframes: where they are in the store's world.
        poses: T_world_camera [4, 4] of all frames that were located, by frame.
    """

    run: str
    sequence: SequenceRecord
    config: dict[str, Any]
    keyframes: list[KeyframeRecord]
    poses: dict[int, Array] = {}

    def settings(self) -> Config:
        """Of the run. Raises ConfigError if they are none of this version's."""
        return config_from_dict(self.config, f"{self.run}: settings")

    def camera_of(self, keyframe: KeyframeRecord) -> Camera:
        """The camera of a keyframe's images."""
        return self.sequence.camera_of(keyframe.frame)

    @staticmethod
    def parse(content: bytes | str, what: str) -> VisitRecord:
        """A record in its bytes. Raises FormatError, which names `what`, if they are none."""
        try:
            return VisitRecord.model_validate_json(content)
        except pydantic.ValidationError as error:
            raise FormatError(f"{what}: {explain(error)}") from None
