# SPDX-License-Identifier: Apache-2.0
"""Checks a recording's camera, depth and masks before a run."""

from __future__ import annotations

from dataclasses import replace

from ggslam.errors import SequenceError
from ggslam.jobs.progress import Observer
from ggslam.sequences import Sequence
from ggslam.sequences.camera_doubts import judge_intrinsics
from ggslam.sequences.depth_doubts import DepthDoubts
from ggslam.sequences.inspection import VOID_TEXT
from ggslam.sequences.live import LiveSequence
from ggslam.sequences.rig import RigSequence
from ggslam.sequences.verdicts import Verdict
from ggslam.sequences.void_ids import has_void_id


def check_depth(sequence: Sequence | LiveSequence, observer: Observer) -> list[Verdict]:
    """What is doubtful about depth; that, and what is of intrinsics, is told as a note.

    Raises:
        SequenceError: depth is certainly not what it is taken for, or the intrinsics are of no such image; says what
            is wrong and what to do.
    """
    try:
        found = _judge(sequence)
    except Exception as error:  # the run itself will tell what is wrong with images, if it matters
        observer.note(f"depth could not be checked: {error!r}")
        return []
    cameras = _judge_cameras(sequence)
    certain = [verdict.text for verdict in [*cameras, *found] if verdict.severity == "wrong"]
    if certain:
        raise SequenceError(f"{sequence.path}: {'; '.join(certain)} (or `check` to run it as it is)")
    for verdict in [*cameras, *found]:
        observer.note(verdict.text)
    return found


def _judge_cameras(sequence: Sequence | LiveSequence) -> list[Verdict]:
    """What is implausible of intrinsics by themselves."""
    if isinstance(sequence, RigSequence):
        return [verdict for part in sequence.parts for verdict in _judge_cameras(part.sequence)]
    if isinstance(sequence, LiveSequence):
        return judge_intrinsics(sequence.camera)
    return judge_intrinsics(sequence.native_camera, sequence.stated_size, sequence.camera_source)


def _judge(sequence: Sequence | LiveSequence) -> list[Verdict]:
    if isinstance(sequence, LiveSequence):
        return []
    if isinstance(sequence, RigSequence):
        return [
            replace(verdict, text=f"{part.name}: {verdict.text}")
            for part in sequence.parts for verdict in DepthDoubts(part.sequence).judge()
        ]  # fmt: skip
    void = [Verdict("void_id", "doubtful", VOID_TEXT)] if has_void_id(sequence) else []
    return [*DepthDoubts(sequence).judge(), *void]
