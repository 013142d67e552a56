# SPDX-License-Identifier: Apache-2.0
"""`ggslam report`: a page to look at of a run, or of several side by side."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from ggslam.cli.console import console, progress_bar
from ggslam.cli.observer import ProgressObserver
from ggslam.errors import ConfigError

if TYPE_CHECKING:
    from ggslam.jobs.changes.saved_changes import ChangesShown

EPILOG = """
[bold]Examples[/]

  ggslam report runs/kitchen

  ggslam report runs/kitchen --plots figures

  ggslam report runs/fast runs/slow runs/refined --out comparison.html

  ggslam report runs/monday runs/tuesday --changes
"""


def report(
    runs: Annotated[list[Path], typer.Argument(metavar="RUN...", help="Folders of runs; several are compared.")],
    out: Annotated[
        Path | None, typer.Option(help="Page that compares several runs; default comparison.html in this folder.")
    ] = None,
    plots: Annotated[Path | None, typer.Option(help="Folder to write the plots to, as SVG and PNG.")] = None,
    changes: Annotated[
        bool,
        typer.Option("--changes", help="For two visits, the older one first: also show what changed between them."),
    ] = False,
) -> None:
    """Write RUN/report.html again, or one page that compares several runs. Pages open from disk, without a network."""
    from ggslam.jobs.report.pages import write_comparison, write_report
    from ggslam.runs.folder import RunFolder

    folders = [RunFolder.open(path) for path in runs]
    if changes and len(folders) != 2:
        raise ConfigError(f"--changes: expected two runs, the older one first, found {len(folders)}")
    if len(folders) == 1:
        if out is not None:
            raise ConfigError("--out is for the comparison of several runs; one run's report is in its folder")
        path = write_report(folders[0], plots=plots)
    else:
        shown = _changes_between(runs[0], runs[1]) if changes else None
        path = write_comparison(folders, out or Path("comparison.html"), plots, shown)
    console.print(f"wrote {path}", highlight=False, markup=False)
    if plots is not None:
        console.print(f"wrote plots to {plots}", highlight=False, markup=False)


def _changes_between(old: Path, new: Path) -> ChangesShown:
    from ggslam.jobs.changes.changes import find_changes, show_changes

    with progress_bar() as bar:
        return show_changes(find_changes(old, new, observer=ProgressObserver(bar)), old, new)
