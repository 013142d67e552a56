# SPDX-License-Identifier: Apache-2.0
"""`ggslam batch`: many runs, one table."""

from __future__ import annotations

import shlex
from collections import Counter
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from ggslam.cli.console import console
from ggslam.errors import ConfigError

if TYPE_CHECKING:
    from collections.abc import Sequence

    from ggslam.jobs.batch.batch import BatchOutcome
    from ggslam.jobs.batch.job_states import JobState

EPILOG = """
[bold]Examples[/]

  ggslam batch experiments.yaml

  ggslam batch experiments.yaml --retry --workers 4

  ggslam batch recordings/ --options "--scale 0.5" --seeds 0,1,2

  ggslam batch --replica data/Replica
"""

Source = Annotated[
    Path | None,
    typer.Argument(metavar="MANIFEST", help="YAML with recordings, settings and seeds, or a folder of recordings."),
]
Replica = Annotated[
    Path | None,
    typer.Option(help="Folder with Replica's scenes (room0 ... office4): all of them, with the preset replica."),
]
Out = Annotated[
    Path | None, typer.Option(help="Folder of runs and tables; default runs/NAME, or as the manifest says.")
]
Options = Annotated[str, typer.Option(help="Of a folder: options of `ggslam run` for all recordings, as one text.")]
Seeds = Annotated[str, typer.Option(help="Of a folder: seeds, by commas.")]
Workers = Annotated[int | None, typer.Option(help="Runs at a time; default: one for every two processors.")]
Retry = Annotated[bool, typer.Option("--retry", help="Make runs again that failed.")]


def batch(
    manifest: Source = None,
    replica: Replica = None,
    out: Out = None,
    options: Options = "",
    seeds: Seeds = "0",
    workers: Workers = None,
    retry: Retry = False,
) -> None:
    """Run recordings x settings x seeds, each into a folder of its own, and write one table of their scores.

    Runs that are done are skipped and those that were cut off go on, so the same command can be given again. Exit
    code 1 if a run failed."""
    from ggslam.jobs.batch.batch import run_batch
    from ggslam.jobs.batch.manifest import REPLICA, manifest_of_folder, read_manifest

    if (manifest is None) == (replica is None):
        raise ConfigError("expected a MANIFEST (or a folder of recordings), or --replica with a folder")
    words, numbers = _split(options), _numbers(seeds)
    if replica is not None:
        jobs = manifest_of_folder(replica, out, numbers, ["--config", "replica", *words], REPLICA)
    elif manifest is not None and manifest.is_dir():
        jobs = manifest_of_folder(manifest, out, numbers, words)
    elif manifest is not None:
        if options or seeds != "0":
            raise ConfigError("--options and --seeds are for folders; a manifest says its own")
        jobs = read_manifest(manifest, out)
    told = _Told()
    outcome = run_batch(jobs, workers, retry, told.note)
    _show(outcome)
    if outcome.failures:
        raise typer.Exit(1)


def _split(options: str) -> list[str]:
    try:
        return shlex.split(options)
    except ValueError as error:
        raise ConfigError(f"--options: {error}") from None


def _numbers(seeds: str) -> list[int]:
    words = seeds.split(",")
    if not all(word.strip().isdecimal() for word in words):
        raise ConfigError(f"--seeds: expected whole numbers by commas, found {seeds}")
    return [int(word) for word in words]


class _Told:
    """Says what changes: a line for every run that begins or ends."""

    def __init__(self) -> None:
        self._shown: dict[str, str] = {}

    def note(self, states: Sequence[JobState]) -> None:
        """Prints the runs whose state is new, and how many are where."""
        for state in states:
            name, word = state.job.name, state.state.value
            if self._shown.get(name, "waiting") != word:
                counts = Counter(other.state.value for other in states)
                rest = ", ".join(f"{counts[k]} {k}" for k in ("running", "waiting") if counts[k])
                why = f": {state.line}" if state.line else f" in {state.seconds:.0f} s" if state.seconds else ""
                console.print(f"{name}: {word}{why}" + (f"  ({rest})" if rest else ""), highlight=False, markup=False)
            self._shown[name] = word


def _show(outcome: BatchOutcome) -> None:
    from rich.table import Table

    from ggslam.jobs.batch.scores_table import COLUMNS

    shown, own = Table(title=outcome.table.title), 3 + len(COLUMNS)  # papers' figures are in the files
    for number, title in enumerate(outcome.table.head()[:own]):
        shown.add_column(title, justify="left" if number < 2 else "right")
    for row in outcome.table.cells(spreads=False):
        shown.add_row(*row[:own])
    console.print(shown)
    for note in outcome.table.notes():
        console.print(note, highlight=False, markup=False)
    console.print(f"wrote {', '.join(map(str, outcome.files))}", highlight=False, markup=False)
