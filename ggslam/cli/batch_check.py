# SPDX-License-Identifier: Apache-2.0
"""Looks at all runs of a batch before the first begins: hours later is late for a typing mistake."""

from __future__ import annotations

import shlex
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import typer
from rich.markup import escape

from ggslam.cli.console import console, table
from ggslam.cli.old_names import Command
from ggslam.cli.recognition import with_advice
from ggslam.errors import AnotherKindError, ConfigError, GgslamError
from ggslam.system.plurals import quantity, word_for
from ggslam.system.tuning import Tuning

if TYPE_CHECKING:
    from ggslam.jobs.batch.job_states import JobState


class BatchCheckTuning(Tuning):
    """How many mistakes are listed."""

    shown = 10
    """Most mistakes that are listed."""


def check_jobs(states: Sequence[JobState], recordings: bool = True) -> None:
    """Checks the options of the runs that wait, and that their recordings are there.

    Args:
        states: of all runs.
        recordings: whether the recordings have to be on this machine.

    Raises:
        ConfigError: what is wrong, for each run at fault; runs with the same mistake are named once.
    """
    from ggslam.jobs.batch.job_states import State

    waiting = [state for state in states if state.state is State.WAITING]
    wrong: dict[str, list[str]] = {}
    for state in waiting:
        reason = _why_wrong(state.job.words, recordings)
        if reason is not None:
            wrong.setdefault(reason, []).append(state.job.name)
    if not wrong:
        return
    listed = [f"  {_names(names)}: {reason}" for reason, names in list(wrong.items())[: BatchCheckTuning.shown]]
    more = len(wrong) - len(listed)
    listed += [f"  and {quantity(more, 'mistake')} more"] if more else []
    count = sum(map(len, wrong.values()))
    told = f"{count} of {quantity(len(states), 'run')} cannot be made; none was begun:"
    raise ConfigError("\n".join([told, *listed]))


def _why_wrong(words: tuple[str, ...], recordings: bool) -> str | None:
    from ggslam.cli import run_command
    from ggslam.sequences import recognise_format
    from ggslam.slam.config import load_config

    try:
        given = _parameters_of(run_command.run, list(words))
        load_config(given["config"], run_command.overrides_of(given))
        if recordings:
            path = Path(words[0])
            if given["format_name"] is None and recognise_format(path) is None:
                from ggslam.sequences import open_sequence

                open_sequence(path)  # says why not
    except AnotherKindError as error:
        return with_advice(error)
    except GgslamError as error:
        return str(error)
    return None


def _parameters_of(function: object, words: list[str]) -> dict[str, Any]:
    """The parameters that a command would be called with.

    Raises:
        ConfigError: the command line would refuse them.
    """
    app = typer.Typer(add_completion=False)
    app.command("run", cls=Command)(function)  # type: ignore[type-var]
    command = typer.main.get_command(app)
    with command.make_context("run", words) as context:
        return dict(context.params)


def _names(names: list[str]) -> str:
    return names[0] if len(names) == 1 else f"{names[0]} and {quantity(len(names) - 1, 'other run')}"


def list_jobs(states: Sequence[JobState]) -> None:
    """Prints the runs, where they are, and the commands that would make them."""
    rows = [
        [escape(state.job.name), state.state.value, escape(shlex.join(["ggslam", *state.arguments()]))]
        for state in states
    ]
    console.print(table("", ["run", "state", "command"], rows))
    waiting = sum(state.state.value == "waiting" for state in states)
    console.print(f"{quantity(waiting, 'run')} {word_for(waiting, 'is', 'are')} to be made; none was begun")
