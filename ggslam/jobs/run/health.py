# SPDX-License-Identifier: Apache-2.0
"""What seems wrong with a run: verdicts on its recording, as `ggslam inspect` gives them, and on what it measured."""

from __future__ import annotations

from ggslam.errors import GgslamError
from ggslam.sequences import Sequence, inspect_sequence
from ggslam.sequences.live import LiveSequence
from ggslam.sequences.rig import RigSequence
from ggslam.sequences.rig_inspection import inspect_rig
from ggslam.sequences.verdicts import Verdict, judge_intrinsics, judge_times
from ggslam.slam.result import SlamResult
from ggslam.slam.verdicts import judge_path, judge_run

FRAMES = 5
"""Of the recording that are looked at."""


def judge(sequence: Sequence | LiveSequence, result: SlamResult) -> list[Verdict]:
    """Verdicts on a run that has ended; some frames of its recording are read once more."""
    verdicts = [*_judge_recording(sequence, result), *judge_run(result)]
    told = {verdict.code for verdict in verdicts}
    if isinstance(sequence, Sequence) and not told & {"depth_scale", "intrinsics"}:  # which make paths wrong
        verdicts += judge_path(result, sequence.ground_truth, sequence.depth_scale)
    return verdicts


def _judge_recording(sequence: Sequence | LiveSequence, result: SlamResult) -> list[Verdict]:
    if isinstance(sequence, LiveSequence):
        return [*judge_intrinsics(sequence.camera), *judge_times(result.timestamps())]
    try:
        if isinstance(sequence, RigSequence):
            return inspect_rig(sequence, FRAMES, masks=False).verdicts
        return inspect_sequence(sequence, FRAMES, masks=False).verdicts
    except GgslamError:  # a recording that went away meanwhile; the run ends as it would have
        return []
