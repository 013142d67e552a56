# SPDX-License-Identifier: Apache-2.0
"""`ggslam update`: a run brought up to date by a later visit."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from ggslam.cli.changes_command import IdsName, choice_of_ids, print_changes
from ggslam.cli.console import console, progress_bar
from ggslam.cli.observer import ProgressObserver
from ggslam.system.plurals import quantity

if TYPE_CHECKING:
    from ggslam.jobs.update.update import UpdateOutcome

EPILOG = """
The updated run is in the world of the older one: what went is out of its map, what moved lies where it is now and keeps
id and name, what came has an id of its own, and what the newer visit did not see is as it was. objects.json holds the
history, changes/ what changed. It is an ordinary run, and can be brought up to date again.

[bold]Examples[/]

  ggslam update runs/monday runs/tuesday --out runs/office

  ggslam update runs/office runs/wednesday --out runs/office-wednesday
"""


def update(
    old: Annotated[Path, typer.Argument(metavar="OLD", help="Folder of the earlier run, or a .ggz file of it.")],
    new: Annotated[
        Path, typer.Argument(metavar="NEW", help="Folder of the later run of the same place, or a .ggz file of it.")
    ],
    out: Annotated[Path, typer.Option(help="Folder for the updated run.")],
    ids: Annotated[
        IdsName,
        typer.Option(
            help="Whether an id means the same object in both runs; auto: yes if objects that stayed have the same ids."
        ),
    ] = IdsName.auto,
    steps: Annotated[
        int,
        typer.Option(
            help="Optimisation steps where the maps meet and where something changed, if the recordings are there; 0: "
            "none.",
            min=0,
        ),
    ] = 400,
    overwrite: Annotated[bool, typer.Option("--overwrite", help="Replace a run that is already at --out.")] = False,
) -> None:
    """Bring the map of a run up to date by a later visit: what went, came or moved in between."""
    from ggslam.jobs.update.update import update_run
    from ggslam.merging.settings import MergeSettings

    with progress_bar() as bar:
        outcome = update_run(
            old, new, out, overwrite=overwrite, ids=choice_of_ids(ids), merging=MergeSettings(steps=steps),
            observer=ProgressObserver(bar),
        )  # fmt: skip
    print_changes(outcome.changes.table)
    for line in _lines(outcome):
        console.print(line, highlight=False, markup=False, soft_wrap=True)


def _lines(outcome: UpdateOutcome) -> list[str]:
    """What came of it, for people; notes of the comparison were printed with it."""
    old, new = outcome.kept
    lines = [
        f"{quantity(outcome.gaussians, 'Gaussian')}: {old} of the older map, {new} of the newer one; {outcome.gone} "
        "showed what is gone"
    ]  # fmt: skip
    if outcome.trained:
        lines.append(f"{quantity(outcome.steps, 'step')} on {quantity(outcome.trained, 'keyframe')}")
    lines += [f"note: {note}" for note in outcome.notes if note not in outcome.changes.table.found.notes]
    took = ", ".join(f"{part} {seconds:.1f}" for part, seconds in outcome.seconds.items())
    return [*lines, f"wrote {outcome.folder.path} in {sum(outcome.seconds.values()):.1f} s ({took})"]
