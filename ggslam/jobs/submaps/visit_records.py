# SPDX-License-Identifier: Apache-2.0
"""What a store remembers of a run that filled it: its recording, settings and keyframes, so that cells can be trained,
and their surfaces fused, from the images again."""

from __future__ import annotations

import json
import logging
from typing import Any

import numpy as np
import pydantic

from ggslam.errors import FormatError, GgslamError
from ggslam.mapping.keyframe import ELSEWHERE
from ggslam.rendering.exposure import identity_exposure
from ggslam.runs.folder import RunFolder
from ggslam.runs.records.keyframes import KeyframeRecord
from ggslam.runs.records.record import Record, explain
from ggslam.runs.records.sequence import SequenceRecord
from ggslam.scene.camera import Camera
from ggslam.slam.config import Config, config_from_dict, config_to_dict
from ggslam.submaps.grid import GridStore
from ggslam.submaps.visit_files import read_visit, visit_file, write_visit
from ggslam.system.foreign import printable

_log = logging.getLogger(__name__)


class VisitRecord(Record):
    """A run that filled a store.

    Attributes:
        run: its folder.
        sequence: its recording.
        config: its settings.
        keyframes: where they are in the store's world.
    """

    run: str
    sequence: SequenceRecord
    config: dict[str, Any]
    keyframes: list[KeyframeRecord]

    @staticmethod
    def of_run(folder: RunFolder) -> VisitRecord:
        """Of a run whose world is the store's."""
        known = [keyframe for keyframe in folder.keyframes().keyframes if keyframe.frame != ELSEWHERE]
        return VisitRecord(
            run=str(folder.path.absolute()), sequence=folder.sequence(), config=config_to_dict(folder.config()),
            keyframes=known,
        )  # fmt: skip

    def settings(self) -> Config:
        """Of the run. Raises ConfigError if they are none of this version's."""
        return config_from_dict(self.config, f"{self.run}: settings")

    def camera_of(self, keyframe: KeyframeRecord) -> Camera:
        """The camera of a keyframe's images."""
        first = 0
        for part in self.sequence.parts or []:
            first += part.frames
            if keyframe.frame < first:
                return part.camera
        return self.sequence.camera


def exposure_of(keyframe: KeyframeRecord) -> np.ndarray:
    """Gain and offset of each colour channel, [3, 2]."""
    return identity_exposure() if keyframe.exposure is None else keyframe.exposure


def remember_run(store: GridStore, folder: RunFolder) -> None:
    """Writes the record of the visit that was begun. A run whose own records are damaged can be stored, but not be
    trained any further.

    Raises:
        RunFolderError: the record cannot be written.
    """
    try:
        record = VisitRecord.of_run(folder)
    except GgslamError as error:
        _log.warning("warning: %s; what is stored of the run cannot be refined", printable(str(error)))
        return
    write_visit(store, json.dumps(record.values()).encode())


def read_record(store: GridStore, visit: str) -> VisitRecord | None:
    """The record of a visit; None: it has none, because it was no run or the store is older.

    Raises:
        FormatError: it is damaged.
    """
    data = read_visit(store, visit)
    if data is None:
        return None
    path = visit_file(store.path, visit)
    try:
        return VisitRecord.model_validate(json.loads(data))
    except pydantic.ValidationError as error:
        raise FormatError(f"{path}: {explain(error)}") from None
    except (ValueError, RecursionError) as error:
        raise FormatError(f"{path}: cannot be read: {error}") from None
