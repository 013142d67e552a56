# SPDX-License-Identifier: Apache-2.0
"""Printing: progress bars and tables."""

from __future__ import annotations

from typing import Any

from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, ProgressColumn, Task, TextColumn, TimeRemainingColumn
from rich.table import Table
from rich.text import Text

from ggslam.cli.argument_names import with_options


class CommandConsole(Console):
    """Prints what the library says with options in place of the arguments that it names."""

    def print(self, *objects: Any, **how: Any) -> None:
        """As `rich.console.Console.print`."""
        super().print(*(with_options(item) if isinstance(item, str) else item for item in objects), **how)


console = CommandConsole()


class RateColumn(ProgressColumn):
    """Steps a second, lately while running, on average when done."""

    def render(self, task: Task) -> Text:
        """The text of one task."""
        rate = task.finished_speed or task.speed
        return Text("" if rate is None else f"{rate:.1f}/s")


def progress_bar() -> Progress:
    """A one-line progress bar with rate and time left; the task's field `info` is free text."""
    return Progress(
        TextColumn("{task.description}"), BarColumn(bar_width=20), MofNCompleteColumn(), RateColumn(),
        TextColumn("{task.fields[info]}"), TimeRemainingColumn(compact=True), console=console, refresh_per_second=4,
    )  # fmt: skip


def table(title: str, columns: list[str], rows: list[list[str]]) -> Table:
    """A small table; the first column is left-aligned, the others right-aligned."""
    result = Table(title=title, title_justify="left")
    for number, name in enumerate(columns):
        result.add_column(name, justify="left" if number == 0 else "right")
    for row in rows:
        result.add_row(*row)
    return result
