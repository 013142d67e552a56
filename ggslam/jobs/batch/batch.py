# SPDX-License-Identifier: Apache-2.0
"""Makes the missing runs of a batch and the table of all runs."""

from __future__ import annotations

import os
import platform
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

from ggslam import __version__
from ggslam.errors import ConfigError
from ggslam.jobs.batch.job_process import make_job
from ggslam.jobs.batch.job_states import JobState, State, states_of
from ggslam.jobs.batch.local_engine import run_locally
from ggslam.jobs.batch.manifest import Manifest
from ggslam.jobs.batch.ray_engine import run_on_ray
from ggslam.jobs.batch.scores_table import ScoresTable
from ggslam.jobs.tasks.processors import shares
from ggslam.runs.environment import processor
from ggslam.system.atomic import make_folder, write_text
from ggslam.system.folder_lock import folder_lock

Engine = Literal["local", "ray", "none"]


@dataclass(frozen=True)
class BatchOutcome:
    """Result of a batch.

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
    changed: Callable[[Sequence[JobState]], None] = lambda states: None, engine: Engine = "local",
    address: str | None = None, baseline: str | None = None, by_rules: bool = False,
) -> BatchOutcome:  # fmt: skip
    """Makes what is not there yet, each run into a folder of its own, and writes the tables.

    Args:
        manifest: the runs.
        workers: so many at once, with as many processors each as there are for it; None: two processors each. Of the
            local engine.
        retry: make runs again that failed.
        changed: told how far the runs are, now and then.
        engine: "local": processes on this machine; "ray": tasks of a Ray cluster; "none": makes no run, for the table
            of those that are done.
        address: of the Ray cluster, see `run_on_ray`.
        baseline: settings that the table compares the others with; None: those that the manifest names, or the first
            of several.
        by_rules: whether the table shows our figures by each paper's rules, beside published ones.

    Raises:
        ConfigError: no worker, or no settings of the baseline's name.
        RunFolderError: the folder cannot be written, or another batch is at work in it.
        MissingDependency, GgslamError: Ray is not installed, or there is no cluster at the address.
    """
    shares(workers)
    compared = manifest.baseline_name(baseline)
    make_folder(manifest.out)
    with folder_lock(manifest.out):
        states = states_of(manifest, retry)
        changed(states)
        if engine == "local":
            run_locally(states, workers, lambda: changed(states))
        elif engine == "ray":
            run_on_ray(states, address, lambda: changed(states))
        found = ScoresTable.of(manifest.title, states, _machine(), compared, by_rules)
        files = []
        for name, make in found.files().items():
            write_text(manifest.out / name, make(), follow=False)
            files.append(manifest.out / name)
    return BatchOutcome(states, found, files)


def run_one(manifest: Manifest, number: int, retry: bool = False) -> JobState:
    """Makes one run of a batch, unless it is done: an element of a job array. Others may make theirs meanwhile.

    Raises:
        ConfigError: no such number.
        RunFolderError: its log cannot be written.
    """
    if not 0 <= number < len(manifest.jobs):
        raise ConfigError(f"`only`: expected a number from 0 to {len(manifest.jobs) - 1}, found {number}")
    state = states_of(manifest, retry)[number]
    if state.state is State.WAITING:
        make_job(state, len(shares(1)[0]))
    return state


def _machine() -> str:
    """Version and machine, for the table's last note."""
    return f"ggslam {__version__}, {os.cpu_count()} processors ({processor()}), {platform.system()}"
