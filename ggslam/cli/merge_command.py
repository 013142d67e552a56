# SPDX-License-Identifier: Apache-2.0
"""`ggslam merge`: one run from several."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from ggslam.cli.console import console, progress_bar
from ggslam.cli.observer import ProgressObserver
from ggslam.system.plurals import quantity

if TYPE_CHECKING:
    from ggslam.jobs.merge.merge import MergeOutcome

EPILOG = """
The merged run is in the world of the first one, whose names and colours go first. It is an ordinary run: eval, view,
edit, export, encode, volumes and localize take it.

[bold]Examples[/]

  ggslam merge runs/monday runs/tuesday --out runs/office

  ggslam merge robot1.ggz robot2.ggz --out runs/hall

  ggslam merge runs/upstairs runs/stairs runs/downstairs --out runs/house --steps 600
"""


def merge(
    runs: Annotated[
        list[Path],
        typer.Argument(metavar="RUN...", help="Folders that `ggslam run` wrote, or .ggz files of such; two or more."),
    ],
    out: Annotated[Path, typer.Option(help="Folder for the merged run.")],
    steps: Annotated[
        int,
        typer.Option(
            help="Optimisation steps where maps meet for each run that joins, if the recordings are there; 0: none.",
            min=0,
        ),
    ] = 400,
    overwrite: Annotated[bool, typer.Option("--overwrite", help="Replace a run that is already at --out.")] = False,
) -> None:
    """Merge runs that share a part of a scene: one world, one map, one id for each object."""
    from ggslam.jobs.merge.merge import merge_runs
    from ggslam.merging.settings import MergeSettings

    with progress_bar() as bar:
        outcome = merge_runs(
            list(runs), out, overwrite=overwrite, settings=MergeSettings(steps=steps), observer=ProgressObserver(bar)
        )
    for line in _lines(outcome, [str(run) for run in runs]):
        console.print(line, highlight=False, markup=False, soft_wrap=True)


def _lines(outcome: MergeOutcome, names: list[str]) -> list[str]:
    """What came of it, for people."""
    lines = []
    for pair in sorted({link.runs for link in outcome.poses.links}):
        own = [link for link in outcome.poses.links if link.runs == pair]
        believed = sum(link.believed for link in own)
        lines.append(f"{names[pair[0]]} and {names[pair[1]]}: {believed} of {len(own)} links believed")
    lines.append(f"{quantity(outcome.gaussians, 'Gaussian')}, {sum(outcome.doubles)} double ones left out")
    if outcome.united:
        lines.append(f"gave one id to {quantity(outcome.shared_objects, 'object')} seen in more than one run")
    if outcome.trained:
        lines.append(f"{quantity(outcome.steps, 'step')} on {quantity(outcome.trained, 'keyframe')} at the seams")
    lines += [f"note: {note}" for note in outcome.notes]
    took = ", ".join(f"{part} {seconds:.1f}" for part, seconds in outcome.seconds.items())
    return [*lines, f"wrote {outcome.folder.path} in {sum(outcome.seconds.values()):.1f} s ({took})"]
