# SPDX-License-Identifier: Apache-2.0
"""Short runs of pieces of a recording, each made once."""

from __future__ import annotations

from pathlib import Path

from kept import build_once

from ggslam.jobs.run.pipeline import RunRequest, execute
from ggslam.runs.recordings import SequenceRequest

FEW = ["mapping.iterations_per_frame=2", "refine_iterations=10"]


def run_of(recording: Path, out: Path, start: int, stop: int, scale: float = 1.0, more: tuple[str, ...] = ()) -> Path:
    def build(folder: Path) -> None:
        request = SequenceRequest(recording, start=start, stop=stop, scale=scale)
        execute(RunRequest(request, out=folder, overrides=[*FEW, *more], evaluate=False))

    return build_once(out, build)
