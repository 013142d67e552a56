# SPDX-License-Identifier: Apache-2.0
"""A job array of Slurm that makes a batch's runs: one element a run, then one job for the table."""

from __future__ import annotations

import shlex
import sys
from collections.abc import Mapping, Sequence

from ggslam.jobs.batch.manifest import Manifest, option
from ggslam.jobs.tasks.processors import ProcessorTuning
from ggslam.system.plurals import quantity
from ggslam.system.tuning import Tuning


class SlurmTuning(Tuning):
    """What a job asks Slurm for."""

    memory_gb = 4
    """Memory of a run, in GB."""
    hours = 4
    """Longest time of a run, in hours."""


def slurm_script(manifest: Manifest, arguments: Sequence[str], only: str, table: str) -> str:
    """A shell script that submits the runs and, after them, the table.

    Args:
        manifest: the runs.
        arguments: of `ggslam batch` that lead to the same manifest from any folder.
        only: option of `ggslam batch` that makes one run, by its number.
        table: option that makes none and writes the table.
    """
    out, command = manifest.out.absolute(), shlex.join([sys.executable, "-m", "ggslam", "batch", *arguments])
    title = " ".join(manifest.title.split())  # a comment ends with its line
    runs = {
        "job-name": title, "array": f"0-{len(manifest.jobs) - 1}", "cpus-per-task": str(ProcessorTuning.per_worker),
        "mem": f"{SlurmTuning.memory_gb}G", "time": f"{SlurmTuning.hours}:00:00",
        "output": str(out / "slurm-%A_%a.log"),
        "wrap": f"{command} {only} $SLURM_ARRAY_TASK_ID",
    }  # fmt: skip
    end = {"job-name": f"{title} table", "cpus-per-task": "1", "wrap": f"{command} {table}"}
    return "\n".join([
        "#!/bin/bash",
        f"# Submits {quantity(len(manifest.jobs), 'run')} of {title} and a job for their table.",
        "# Times and memory are guesses: change them to what your recordings need.",
        "set -eu",
        f"mkdir -p {shlex.quote(str(out))}",
        f"array=$(sbatch {option('parsable')} {option('requeue')}{_options(runs)})",
        f"sbatch {option('dependency')} afterany:$array{_options(end)}",
        "",
    ])  # fmt: skip


def _options(values: Mapping[str, str]) -> str:
    """Each on a line of its own."""
    return "".join(f" \\\n  {option(name)} {shlex.quote(value)}" for name, value in values.items())
