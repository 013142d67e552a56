# SPDX-License-Identifier: Apache-2.0
"""keyframes.json: where the keyframes are, and how each frame was tracked."""

from __future__ import annotations

from typing import ClassVar

import numpy as np

from ggslam.errors import RunFolderError
from ggslam.mapping.keyframe import FROM_EARLIER_RUN
from ggslam.rendering.exposure import frame_weights, identity_exposure, typical_gain
from ggslam.runs.records.record import Array, NumberOrNone, Record, RecordFile
from ggslam.slam.result import SlamResult
from ggslam.system.plurals import quantity, word_for


class KeyframeRecord(Record):
    """A keyframe.

    Attributes:
        index: its number.
        frame: index of its frame; `mapping.keyframe.FROM_EARLIER_RUN` if it is of another recording.
        timestamp: seconds.
        T_world_camera: [4, 4].
        exposure: gain and offset of each colour channel, [3, 2].
        iterations: that trained on it.
    """

    index: int = 0
    frame: int
    timestamp: NumberOrNone = None
    T_world_camera: Array
    exposure: Array | None = None
    iterations: int = 0

    @property
    def known_exposure(self) -> np.ndarray:
        """Its exposure, a copy; the map's own if none is recorded."""
        return identity_exposure() if self.exposure is None else self.exposure.copy()

    @property
    def is_exposed(self) -> bool:
        """Whether it has another exposure than the map."""
        return self.exposure is not None and bool((self.exposure != identity_exposure()).any())


class FrameRecord(Record):
    """A frame; see `slam.result.TrackedFrame`."""

    frame: int
    source: int | None = None
    timestamp: NumberOrNone = None
    keyframe: int
    T_keyframe_camera: Array
    overlap: NumberOrNone = None
    rmse_m: NumberOrNone = None
    status: str
    reason: str = ""

    @property
    def is_lost(self) -> bool:
        """Whether it has no pose."""
        return self.status == "lost"


class KeyframesRecord(RecordFile):
    """The keyframes and frames of a run, each in order."""

    FILE: ClassVar[str] = "keyframes.json"
    keyframes: list[KeyframeRecord]
    frames: list[FrameRecord]

    @staticmethod
    def of_result(result: SlamResult) -> KeyframesRecord:
        """Of a run that ended."""
        keyframes = [
            {"index": k.index, "frame": k.frame_index, "timestamp": k.timestamp, "T_world_camera": k.T_world_camera,
             "exposure": k.exposure, "iterations": k.iterations} for k in result.keyframes
        ]  # fmt: skip
        frames = [
            {"frame": f.frame_index, "source": f.source_index, "timestamp": f.timestamp, "keyframe": f.keyframe,
             "T_keyframe_camera": f.T_keyframe_camera, "overlap": f.overlap, "rmse_m": f.rmse_m, "status": f.status,
             "reason": f.reason} for f in result.frames
        ]  # fmt: skip
        return KeyframesRecord.of({"keyframes": keyframes, "frames": frames})

    def keyframe_numbers(self) -> set[int]:
        """Indices of the frames that became keyframes."""
        return {k.frame for k in self.keyframes}

    def typical_exposure(self) -> np.ndarray:
        """Median gain [3] against the map over the run's frames, see `rendering.exposure.typical_gain`."""
        own = [k for k in self.keyframes if k.frame != FROM_EARLIER_RUN]
        gains = [np.ones(3) if k.exposure is None else k.exposure[:, 0] for k in own]
        return typical_gain(gains, frame_weights([k.frame for k in own])) if own else np.ones(3)

    def notes(self) -> list[str]:
        """What a user should know, a line each."""
        recovered = sum(f.status == "recovered" for f in self.frames)
        were = f"{quantity(recovered, 'frame')} {word_for(recovered, 'was', 'were')}"
        return [f"{were} located only after another start was tried (recovered)"] if recovered else []

    def poses(self) -> dict[int, np.ndarray]:
        """T_world_camera [4, 4] of each frame that was not lost, by its index, from the keyframes as refined.

        Raises:
            RunFolderError: a pose is no finite matrix [4, 4].
        """
        tracked = [f for f in self.frames if not f.is_lost and f.keyframe < len(self.keyframes)]
        poses = {}
        for f in tracked:
            matrices = (self.keyframes[f.keyframe].T_world_camera, f.T_keyframe_camera)
            if any(T.shape != (4, 4) or not np.isfinite(T).all() for T in matrices):
                raise RunFolderError(f"{self.FILE}: pose of frame {f.frame}: expected 4x4 finite numbers")
            poses[f.frame] = matrices[0] @ matrices[1]
        return poses
