# SPDX-License-Identifier: Apache-2.0
"""Verdicts on a run: on its recording, as `ggslam inspect` gives them, and on its measurements."""

from __future__ import annotations

from dataclasses import replace

from ggslam.errors import GgslamError
from ggslam.sequences import Sequence, inspect_sequence
from ggslam.sequences.camera_doubts import judge_intrinsics
from ggslam.sequences.depth_doubts import CODES as DEPTH_CODES
from ggslam.sequences.live import LiveSequence
from ggslam.sequences.rig import RigSequence
from ggslam.sequences.rig_inspection import inspect_rig
from ggslam.sequences.verdicts import Verdict, judge_times
from ggslam.slam.result import SlamResult
from ggslam.slam.verdicts import judge_path, judge_run
from ggslam.system.tuning import Tuning

MOVES = "something moves in"
"""What the note of a run that found movers says."""
OTHER_CAUSES = {"intrinsics", "color_noise", "step", "alignment", "depth_scale"}
"""Codes of verdicts on a recording, besides those that doubt depth, for which a camera is lost."""
_SEE = "; most likely for what is said of the recording above"


class HealthTuning(Tuning):
    """How a run's recording is inspected."""

    frames = 5
    """Frames that are inspected."""


def judge(sequence: Sequence | LiveSequence, result: SlamResult, depth: list[Verdict] | None = None) -> list[Verdict]:
    """Verdicts on a run that has ended; some frames of its recording are read once more. `depth`: what was said of its
    depth before it began; None: nobody looked."""
    of_recording = _judge_recording(sequence, result, depth)
    verdicts = [*of_recording, *_explain(judge_run(result), of_recording)]
    told = {verdict.code for verdict in verdicts}
    if isinstance(sequence, Sequence) and not told & {"depth_scale", "intrinsics"}:  # which make paths wrong
        verdicts += judge_path(result, sequence.ground_truth, sequence.depth_scale)
    return verdicts


def doubt_movers(notes: list[str], verdicts: list[Verdict]) -> list[str]:
    """Notes of a run; where depth or intrinsics are at fault, what seems to move is put down to them first."""
    codes = {verdict.code for verdict in verdicts}
    cause = "depth is" if codes & DEPTH_CODES else "the intrinsics are" if "intrinsics" in codes else ""
    if not cause:
        return notes
    return [f"{note}; more likely {cause} at fault, see below" if MOVES in note else note for note in notes]


def _explain(of_run: list[Verdict], of_recording: list[Verdict]) -> list[Verdict]:
    """Verdicts on a run, without the advice to move slower where the recording explains what happened."""
    causes = [verdict for verdict in of_recording if verdict.code in DEPTH_CODES | OTHER_CAUSES]
    if not causes:
        return of_run
    return [
        replace(verdict, text=f"{verdict.text.rpartition('; ')[0]}{_SEE}")
        if verdict.code in ("jump", "lost") else verdict for verdict in of_run
    ]  # fmt: skip


def _judge_recording(
    sequence: Sequence | LiveSequence, result: SlamResult, depth: list[Verdict] | None
) -> list[Verdict]:
    if isinstance(sequence, LiveSequence):
        # Frames that a busy run left out are counted where the source tells: nobody looks for gaps then.
        gaps = judge_times(result.timestamps()) if sequence.counts() is None else []
        return [*judge_intrinsics(sequence.camera), *gaps]
    try:
        if isinstance(sequence, RigSequence):
            return inspect_rig(sequence, HealthTuning.frames, masks=False).verdicts
        return inspect_sequence(sequence, HealthTuning.frames, masks=False, depth=depth).verdicts
    except GgslamError:  # a recording that went away meanwhile; the run ends as it would have
        return []
