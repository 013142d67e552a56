# SPDX-License-Identifier: Apache-2.0
"""Makes the runs of a batch that are not there yet, and the table of all."""

from __future__ import annotations

import os
import platform
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

from ggslam import __version__
from ggslam.jobs.batch.job_states import JobState, State, states_of
from ggslam.jobs.batch.local_engine import run_locally, shares
from ggslam.jobs.batch.manifest import Manifest
from ggslam.jobs.batch.scores_table import ScoresTable
from ggslam.runs.environment import processor
from ggslam.system.atomic import make_folder, write_text
from ggslam.system.folder_lock import folder_lock


@dataclass(frozen=True)
class BatchOutcome:
    """What a batch has made.

    Attributes:
        states: of its runs.
        table: of those that are done.
        files: tables written.
    """

    states: list[JobState]
    table: ScoresTable
    files: list[Path]

    @property
    def failures(self) -> list[JobState]:
        """Runs that failed."""
        return [state for state in self.states if state.state is State.FAILED]


def run_batch(
    manifest: Manifest, workers: int | None = None, retry: bool = False,
    changed: Callable[[Sequence[JobState]], None] = lambda states: None,
) -> BatchOutcome:  # fmt: skip
    """Makes what is not there yet, each run into a folder of its own, and writes the tables.

    Args:
        manifest: the runs.
        workers: so many at once, with as many processors each as there are for it; None: two processors each.
        retry: make runs again that failed.
        changed: told how far the runs are, now and then.

    Raises:
        ConfigError: no worker.
        RunFolderError: the folder cannot be written, or another batch is at work in it.
    """
    shares(workers)
    make_folder(manifest.out)
    with folder_lock(manifest.out):
        states = states_of(manifest, retry)
        changed(states)
        run_locally(states, workers, lambda: changed(states))
        found = ScoresTable.of(manifest.title, states, _machine())
        files = []
        for name, make in found.files().items():
            write_text(manifest.out / name, make())
            files.append(manifest.out / name)
    return BatchOutcome(states, found, files)


def _machine() -> str:
    """Version and machine, for the table's last note."""
    return f"ggslam {__version__}, {os.cpu_count()} processors ({processor()}), {platform.system()}"
