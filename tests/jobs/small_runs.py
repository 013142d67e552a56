# SPDX-License-Identifier: Apache-2.0
"""Short runs of pieces of a recording, and maps of runs in cells, each made once."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import pytest
from kept import build_once, session_folder

from ggslam.jobs.run.pipeline import RunRequest, execute
from ggslam.jobs.submaps.stores import INDOORS, store_of_run
from ggslam.runs.folder import RunFolder
from ggslam.runs.recordings import SequenceRequest
from ggslam.submaps.grid import GridStore

FEW = ["mapping.iterations_per_frame=2", "refine_iterations=10"]


def run_of(recording: Path, out: Path, start: int, stop: int, scale: float = 1.0, more: tuple[str, ...] = ()) -> Path:
    def build(folder: Path) -> None:
        request = SequenceRequest(recording, start=start, stop=stop, scale=scale)
        execute(RunRequest(request, out=folder, overrides=[*FEW, *more], evaluate=False))

    return build_once(out, build)


def store_of(
    run: RunFolder, factory: pytest.TempPathFactory, name: str = "room", spacing: float = INDOORS.spacing
) -> Path:
    """A run's map in cells of `spacing` metres. Who changes it works on a copy."""

    def build(out: Path) -> None:
        with GridStore.create(out, replace(INDOORS, spacing=spacing)) as made:
            store_of_run(run.path, made)

    return build_once(session_folder(factory) / "stores" / name, build)
