# SPDX-License-Identifier: Apache-2.0
"""`ggslam refine`: a finished map trained further."""

from __future__ import annotations

import math
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from ggslam.cli import options
from ggslam.cli.console import console, progress_bar
from ggslam.cli.observer import ProgressObserver
from ggslam.errors import ConfigError
from ggslam.system.plurals import quantity

if TYPE_CHECKING:
    from ggslam.jobs.refine.refine_store import StoreRefinement

EPILOG = """
A store is refined cell by cell, each with the Gaussians around it standing still; what comes out does not depend on the
number of workers. If it is cut off, the same command goes on.

[bold]Examples[/]

  ggslam refine runs/kitchen --steps 1000 --out runs/kitchen_refined

  ggslam refine house.grid --workers 4

  ggslam refine house.grid --out house_refined.grid --engine ray --address auto
"""


Source = Annotated[
    Path, typer.Argument(metavar="RUN_OR_STORE", help="Folder that `ggslam run` or `ggslam submaps` wrote.")
]
Out = Annotated[Path | None, typer.Option(help="Folder for the refined run or store; default: in place.")]
Steps = Annotated[int, typer.Option(help="Optimisation steps; for a store, steps per cell.", min=0)]
Seed = Annotated[int, typer.Option(help="Seed of the order of the keyframes.", min=0)]
Overwrite = Annotated[bool, typer.Option("--overwrite", help="Replace a run that is already at --out.")]


def refine(
    source: Source,
    out: Out = None,
    steps: Steps = 300,
    seed: Seed = 0,
    sequence: options.MovedSequence = None,
    engine: options.CellEngine = options.EngineName.local,
    workers: options.CellWorkers = None,
    address: options.CellAddress = None,
    overwrite: Overwrite = False,
) -> None:
    """Train a finished map further on its keyframes: a run's, or a grid store's cell by cell."""
    from ggslam.jobs.refine.refine_run import refine_run
    from ggslam.jobs.refine.refine_store import refine_store
    from ggslam.jobs.refine.settings import RefineSettings
    from ggslam.jobs.submaps.stores import is_store
    from ggslam.jobs.tasks.engines import Engine

    settings = RefineSettings(steps=steps, seed=seed)
    if address is not None and engine is not options.EngineName.ray:
        raise ConfigError("--address is for --engine ray")
    with progress_bar() as bar:
        if is_store(source):
            if sequence is not None or overwrite:
                raise ConfigError("--sequence and --overwrite are for runs, and this is a grid store")
            where = Engine(engine.value, workers, address)
            outcome = refine_store(source, out, settings=settings, engine=where, observer=ProgressObserver(bar))
        else:
            if engine is not options.EngineName.local or workers is not None:
                raise ConfigError("--engine and --workers are for grid stores, and this is none")
            done = refine_run(
                source, out, settings=settings, recording=sequence, overwrite=overwrite, observer=ProgressObserver(bar)
            )
    if is_store(source):
        _show_store(outcome)
        return
    _print([
        f"{quantity(done.steps, 'step')} on {quantity(done.keyframes, 'keyframe')}{_gain(done.before, done.after)}",
        *(f"note: {note}" for note in done.notes), f"wrote {done.folder.path} in {done.seconds:.1f} s",
    ])  # fmt: skip


def _show_store(outcome: StoreRefinement) -> None:
    gain = _gain(outcome.before, outcome.after)
    lines = [f"{outcome.trained} of {quantity(outcome.cells, 'cell')} trained, {quantity(outcome.steps, 'step')}{gain}"]
    if outcome.resumed:
        lines.append(f"an earlier call had finished {quantity(outcome.resumed, 'cell')}")
    if outcome.unseen:
        lines.append(f"left {quantity(outcome.unseen, 'cell')} unchanged that no keyframe shows well enough")
    lines += [f"note: {note}" for note in outcome.notes]
    _print([*lines, f"wrote {outcome.path} in {outcome.seconds:.1f} s"])
    if outcome.failures:  # of the store: those of ggslam or the machine are raised
        _print([f"as it was: {line}" for line in outcome.failures.values()])
        raise typer.Exit(2)


def _gain(before: float, after: float) -> str:
    return "" if math.isnan(before) else f": {before:.2f} dB before, {after:.2f} dB after"


def _print(lines: list[str]) -> None:
    for line in lines:
        console.print(line, highlight=False, markup=False, soft_wrap=True)
