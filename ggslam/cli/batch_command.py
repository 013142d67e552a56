# SPDX-License-Identifier: Apache-2.0
"""`ggslam batch`: many runs, one table."""

from __future__ import annotations

import shlex
import time
from collections import Counter
from collections.abc import Iterator
from contextlib import contextmanager
from enum import Enum
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, cast

import typer

from ggslam.cli.console import console
from ggslam.errors import ConfigError

if TYPE_CHECKING:
    from collections.abc import Sequence

    from rich.live import Live

    from ggslam.jobs.batch.batch import BatchOutcome
    from ggslam.jobs.batch.batch import Engine as RunEngine
    from ggslam.jobs.batch.job_states import JobState
    from ggslam.jobs.batch.manifest import Manifest

EPILOG = """
[bold]Examples[/]

  ggslam batch experiments.yaml

  ggslam batch experiments.yaml --retry --workers 4

  ggslam batch recordings/ --options "--scale 0.5" --seeds 0,1,2

  ggslam batch --replica data/Replica --by-paper-rules

  ggslam batch experiments.yaml --dry-run

  ggslam batch experiments.yaml --engine ray --address auto

  ggslam batch experiments.yaml --engine slurm --write-only > array.sh
"""


class EngineName(str, Enum):
    """What makes the runs."""

    local = "local"
    ray = "ray"
    slurm = "slurm"


Source = Annotated[
    Path | None,
    typer.Argument(metavar="MANIFEST", help="YAML with recordings, settings and seeds, or a folder of recordings."),
]
Replica = Annotated[
    Path | None,
    typer.Option(help="Folder with Replica's scenes (room0 ... office4); all of them are run."),
]
Out = Annotated[
    Path | None, typer.Option(help="Folder of runs and tables; default runs/NAME, or as the manifest says.")
]
Options = Annotated[
    str,
    typer.Option(
        help="Options of `ggslam run` for all recordings, in one string; those of a manifest come after them."
    ),
]
Seeds = Annotated[str, typer.Option(help="For a folder of recordings: seeds, separated by commas.")]
Workers = Annotated[int | None, typer.Option(help="Runs at a time; default: one for every two processors.")]
Engine = Annotated[
    EngineName,
    typer.Option(help="local: processes on this machine; ray: tasks of a Ray cluster; slurm: a job array."),
]
Address = Annotated[
    str | None,
    typer.Option(
        help="Address of the Ray cluster; auto: the cluster of this machine. Default: a new cluster on this machine."
    ),
]
WriteOnly = Annotated[bool, typer.Option("--write-only", help="Print the script of --engine slurm and submit nothing.")]
TableOnly = Annotated[bool, typer.Option("--table-only", help="Make no runs; write the table of the finished ones.")]
Only = Annotated[
    int | None,
    typer.Option(help="Make only the run with this number, counted from 0, and no table; used by job arrays."),
]
DryRun = Annotated[bool, typer.Option("--dry-run", help="Check all runs and list them; make none.")]
Baseline = Annotated[
    str | None,
    typer.Option(
        help="Settings that the table compares the others with; default: as the manifest says, or the first ones."
    ),
]
ByRules = Annotated[
    bool,
    typer.Option("--by-paper-rules", help="Show our figures by each paper's rules too, beside the published ones."),
]
Retry = Annotated[bool, typer.Option("--retry", help="Repeat failed runs.")]


def batch(
    manifest: Source = None,
    replica: Replica = None,
    out: Out = None,
    options: Options = "",
    seeds: Seeds = "0",
    workers: Workers = None,
    retry: Retry = False,
    engine: Engine = EngineName.local,
    address: Address = None,
    write_only: WriteOnly = False,
    table_only: TableOnly = False,
    only: Only = None,
    dry_run: DryRun = False,
    baseline: Baseline = None,
    by_rules: ByRules = False,
) -> None:
    """Run recordings x settings x seeds, each into a folder of its own, and write one table of their scores.

    All options and recordings are checked before the first run.

    Runs that are done are skipped and those that were cut off go on, so the same command can be given again. Exit
    code 1 if a run failed."""
    from ggslam.cli.batch_check import check_jobs, list_jobs
    from ggslam.jobs.batch.batch import run_batch, run_one
    from ggslam.jobs.batch.job_states import states_of

    jobs = _manifest(manifest, replica, out, options, seeds)
    jobs.baseline_name(baseline)
    if write_only != (engine is EngineName.slurm):
        raise ConfigError("--engine slurm needs --write-only, and only it has that: ggslam does not submit jobs itself")
    if address is not None and engine is not EngineName.ray:
        raise ConfigError("--address is for --engine ray")
    if not table_only and only is None:
        check_jobs(states_of(jobs, retry), recordings=not write_only)
    if dry_run:
        list_jobs(states_of(jobs, retry))
        return
    if write_only:
        from ggslam.jobs.batch.slurm_script import slurm_script

        words = _words(manifest, replica, jobs.out, options, seeds)
        print(slurm_script(jobs, words, "--only", "--table-only"), end="")
        return
    if only is not None:
        state = run_one(jobs, only, retry)
        _Lines().note([state])
        failed = bool(state.line)
    else:
        with _progress() as told:
            chosen = cast("RunEngine", "none" if table_only else engine.value)
            outcome = run_batch(jobs, workers, retry, told.note, chosen, address, baseline, by_rules)
        _show(outcome)
        failed = bool(outcome.failures)
    if failed:
        raise typer.Exit(1)


def _manifest(
    manifest: Path | None, replica: Path | None, out: Path | None, options: str, seeds: str
) -> Manifest:
    from ggslam.jobs.batch.manifest import REPLICA, manifest_of_folder, read_manifest

    if (manifest is None) == (replica is None):
        raise ConfigError("expected a MANIFEST (or a folder of recordings), or --replica with a folder")
    words, numbers = _split(options), _numbers(seeds)
    if replica is not None:
        return manifest_of_folder(replica, out, numbers, words, REPLICA)
    assert manifest is not None
    if manifest.is_dir():
        return manifest_of_folder(manifest, out, numbers, words)
    if seeds != "0":
        raise ConfigError("--seeds is for folders; a manifest says its own")
    return read_manifest(manifest, out, words)


def _words(manifest: Path | None, replica: Path | None, out: Path, options: str, seeds: str) -> list[str]:
    """Arguments of `ggslam batch` that lead to the same runs from any folder."""
    source = [str(manifest.absolute())] if manifest is not None else []
    source += ["--replica", str(replica.absolute())] if replica is not None else []
    given = [("--options", options, ""), ("--seeds", seeds, "0")]
    return [*source, "--out", str(out.absolute()), *(w for name, v, d in given if v != d for w in (name, v))]


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


class _Lines:
    """Says what changes: a line for every run that begins or ends."""

    def __init__(self) -> None:
        self._shown: dict[str, str] = {}

    def note(self, states: Sequence[JobState]) -> None:
        """Prints the runs whose state is new, and how many are where."""
        for state in states:
            name, word = state.job.name, state.state.value
            if self._shown.get(name, "waiting") != word:
                rest = ", ".join(_counts(states, ("running", "waiting")))
                why = f": {state.line}" if state.line else f" in {state.seconds:.0f} s" if state.seconds else ""
                console.print(f"{name}: {word}{why}" + (f"  ({rest})" if rest else ""), highlight=False, markup=False)
            self._shown[name] = word


class _LiveTable:
    """Shows the runs as a table that changes in place: those at work with what they say, the others by number."""

    def __init__(self, live: Live) -> None:
        self._live, self._lines = live, _Lines()

    def note(self, states: Sequence[JobState]) -> None:
        """Redraws the table; runs that end get a line above it."""
        from rich.markup import escape
        from rich.table import Table

        ended = [state for state in states if state.state.value not in ("waiting", "running")]
        self._lines.note(ended)
        shown = Table(title=", ".join(_counts(states, [s.value for s in type(states[0].state)])), title_justify="left")
        for heading in ("at work", "minutes", "says"):
            shown.add_column(heading, justify="right" if heading == "minutes" else "left")
        for state in states:
            if state.state.value == "running":
                minutes = f"{(time.time() - state.begun) / 60:.1f}"
                shown.add_row(escape(state.job.name), minutes, escape(state.last_line()))
        self._live.update(shown, refresh=True)


@contextmanager
def _progress() -> Iterator[_Lines | _LiveTable]:
    """What is told how far the runs are: a table on a terminal, lines elsewhere."""
    if not console.is_terminal:
        yield _Lines()
        return
    from rich.live import Live

    with Live(console=console, transient=True, auto_refresh=False) as live:
        yield _LiveTable(live)


def _print_columns(title: str, outcome: BatchOutcome, chosen: Sequence[int]) -> None:
    from rich.table import Table

    shown, head = Table(title=title), outcome.table.head()
    for k in chosen:
        shown.add_column(head[k], justify="left" if k < 2 else "right")
    for row in outcome.table.cells(spreads=head[chosen[-1]].startswith("Δ")):
        shown.add_row(*(row[k] for k in chosen))
    console.print(shown)


def _counts(states: Sequence[JobState], words: Sequence[str]) -> list[str]:
    counts = Counter(state.state.value for state in states)
    return [f"{counts[word]} {word}" for word in words if counts[word]]


def _show(outcome: BatchOutcome) -> None:
    from ggslam.jobs.batch.scores_table import COLUMNS

    names, own = 2, 3 + len(COLUMNS)  # papers' figures are in the files
    _print_columns(outcome.table.title, outcome, [*range(own)])
    if outcome.table.baseline is not None:
        deltas = [k for k, title in enumerate(outcome.table.head()) if title.startswith("Δ")]
        _print_columns(f"against {outcome.table.baseline}", outcome, [*range(names), *deltas])
    for note in outcome.table.notes():
        console.print(note, highlight=False, markup=False)
    console.print(f"wrote {', '.join(map(str, outcome.files))}", highlight=False, markup=False)
