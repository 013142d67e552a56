# SPDX-License-Identifier: Apache-2.0
"""Poses of the frames or scans of a recording: its own, or those of a trajectory file, found by time."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from ggslam.errors import FormatError, SequenceError
from ggslam.formats.trajectory import read_trajectory
from ggslam.system.tuning import Tuning


class GivenPoseTuning(Tuning):
    """Which pose of a file belongs to a frame."""

    max_time_gap_s = 0.02
    """Largest difference between the times of a frame and of a pose from another file, in seconds."""


def poses_of_items(
    source: Path, timestamps: np.ndarray, file: Path | None, own: np.ndarray | None, problem: str = ""
) -> np.ndarray:
    """T_world_sensor of each frame or scan, float64 [n, 4, 4], NaN where none is known.

    Args:
        source: the recording.
        timestamps: of its frames or scans, seconds [n].
        file: a trajectory; None: the recording's own poses.
        own: [n, 4, 4] or None.
        problem: why the recording's own cannot be used.

    Raises:
        SequenceError: there are no poses.
        FormatError: the file cannot be read, or none of its times is near one of the recording's.
    """
    if file is None:
        if own is None or not np.isfinite(own).all((1, 2)).any():
            why = f" ({problem})" if problem else ""
            raise SequenceError(f"{source}: no poses{why}; `ggslam localize` finds them, `poses` names their file")
        return own
    found = read_trajectory(file)
    poses = np.full((len(timestamps), 4, 4), np.nan)
    order = np.argsort(found.timestamps, kind="stable")
    times = found.timestamps[order]
    after = np.clip(np.searchsorted(times, timestamps), 1, max(len(times) - 1, 1))
    before = after - 1
    last = np.minimum(after, len(times) - 1)
    nearest = np.where(np.abs(times[before] - timestamps) <= np.abs(times[last] - timestamps), before, last)
    near = np.abs(times[nearest] - timestamps) <= GivenPoseTuning.max_time_gap_s
    poses[near] = found.T_world_camera[order][nearest[near]]
    if not near.any():
        raise FormatError(f"{file}: none of its times is within {GivenPoseTuning.max_time_gap_s} s of a frame")
    return poses
