# SPDX-License-Identifier: Apache-2.0
"""Runs a recording in a process of its own and reads its scores, for the benchmarks and the papers' tables."""

from __future__ import annotations

import tempfile
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from commands import usage

from ggslam.runs.records.keyframes import FrameRecord, KeyframesRecord
from ggslam.runs.records.metrics import MetricsRecord
from ggslam.runs.records.timing import TimingRecord


@dataclass(frozen=True)
class ScoredRun:
    """What a run says of itself."""

    metrics: MetricsRecord
    timing: TimingRecord
    lost: list[FrameRecord]


def scored_run(
    recording: Path, settings: Sequence[str] = (), words: Sequence[str] = (), scale: float = 0.5,
    out: Path | None = None,
) -> ScoredRun:  # fmt: skip
    """Runs a recording with scores; ends the program if that fails.

    Args:
        recording: folder or file.
        settings: name=value.
        words: further options of `ggslam run`.
        scale: of the images.
        out: folder of the run, replaced if it is there; None: it is not kept.
    """
    with tempfile.TemporaryDirectory() as temporary:
        folder = Path(temporary) / "run" if out is None else out.resolve()
        usage([
            "run", str(recording.resolve()), "--scale", str(scale), "--out", str(folder), "--overwrite", *words,
            *[part for setting in settings for part in ("--set", setting)],
        ])  # fmt: skip
        lost = [frame for frame in KeyframesRecord.read(folder).frames if frame.is_lost]
        return ScoredRun(MetricsRecord.read(folder), TimingRecord.read(folder), lost)
