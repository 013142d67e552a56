# SPDX-License-Identifier: Apache-2.0
"""`ggslam changes`: what was added, removed or moved between two visits."""

from __future__ import annotations

from enum import Enum
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from ggslam.cli.console import console, progress_bar, table
from ggslam.cli.observer import ProgressObserver
from ggslam.system.plurals import quantity

if TYPE_CHECKING:
    from ggslam.changes.change import Change
    from ggslam.changes.change_table import ChangeTable

EPILOG = """
Poses and boxes are in the world of the older run. Things of which the newer visit saw too little are listed as unseen:
nothing is claimed of them.

[bold]Examples[/]

  ggslam changes runs/monday runs/tuesday

  ggslam changes runs/monday runs/tuesday --out changes --ids no
"""


class IdsName(str, Enum):
    """Whether object ids mean the same in both runs."""

    auto = "auto"
    yes = "yes"
    no = "no"


def changes(
    old: Annotated[Path, typer.Argument(metavar="OLD", help="Folder of the earlier run, or a .ggz file of it.")],
    new: Annotated[
        Path, typer.Argument(metavar="NEW", help="Folder of the later run of the same place, or a .ggz file of it.")
    ],
    out: Annotated[
        Path | None,
        typer.Option(help="Folder for changes.json and pictures of each change. Without it, only a table is printed."),
    ] = None,
    ids: Annotated[
        IdsName,
        typer.Option(
            help="Whether an id means the same object in both runs; auto: yes if objects that stayed have the same ids."
        ),
    ] = IdsName.auto,
) -> None:
    """List what was added, removed, moved or changed its look between two visits to one place."""
    from ggslam.jobs.changes.changes import find_changes, make_folder_of_changes, write_changes

    if out is not None:
        make_folder_of_changes(out)  # not after minutes of work
    with progress_bar() as bar:
        outcome = find_changes(old, new, ids=choice_of_ids(ids), observer=ProgressObserver(bar))
    print_changes(outcome.table)
    console.print(f"took {outcome.seconds:.1f} s", highlight=False)
    if out is not None:
        written = write_changes(outcome, out, old, new)
        console.print(f"wrote {out}: {quantity(len(written), 'file')}", highlight=False, markup=False, soft_wrap=True)


def choice_of_ids(ids: IdsName) -> bool | None:
    """As jobs take it."""
    return {IdsName.auto: None, IdsName.yes: True, IdsName.no: False}[ids]


def print_changes(found: ChangeTable) -> None:
    """A table, and what else is to be known."""
    rows = [_row(change, found) for change in found.found.changes]
    if rows:
        console.print(table("changes", ["", "object", "moved", "turned", "confidence"], rows))
    else:
        console.print("nothing changed", highlight=False)
    lines = [f"{found.found.stayed} stayed where they were"]
    for reason in dict.fromkeys(change.reason for change in found.found.unseen):
        names = ", ".join(found.label(change) for change in found.found.unseen if change.reason == reason)
        lines.append(f"{reason}: {names}")
    by = "ids, surfaces and colours" if found.found.ids_believed else "surfaces and colours alone"
    lines.append(f"told by {by}")
    for line in [*lines, *(f"note: {note}" for note in found.found.notes)]:
        console.print(line, highlight=False, markup=False, soft_wrap=True)


def _row(change: Change, found: ChangeTable) -> list[str]:
    moved = ["", ""]
    if change.T_new_old is not None:
        metres, degrees = found.motion(change)
        known = change.fit is None or change.fit.turn_known
        moved = [f"{100 * metres:.1f} cm", f"{degrees:.1f} deg" if known else "not known"]
    return [_WORDS[change.kind], found.label(change), *moved, f"{change.confidence:.0%}"]


_WORDS = {"moved": "moved", "removed": "removed", "added": "added", "look": "changed look", "unseen": "unseen"}
