# SPDX-License-Identifier: Apache-2.0
"""Printing: progress bars and tables."""

from __future__ import annotations

import os
import re
import time
from collections.abc import Iterable
from typing import Any

from rich.console import Console, ConsoleDimensions
from rich.progress import (
    BarColumn,
    MofNCompleteColumn,
    Progress,
    ProgressColumn,
    Task,
    TaskID,
    TextColumn,
    TimeRemainingColumn,
)
from rich.segment import Segment
from rich.table import Table
from rich.text import Text

from ggslam.cli.argument_names import with_options
from ggslam.errors import plain
from ggslam.system.tuning import Tuning
from ggslam.system.untrusted_files import printable


class ConsoleTuning(Tuning):
    """How output is printed where it is no terminal."""

    columns = 100_000
    """Columns of a log or a pipe: wide enough that no line wraps."""
    line_interval_s = 10.0
    """Seconds between two lines of progress."""


class PlainConsole(Console):
    """A console that never hands on control characters of what it is given: names in a recording or a run could move
    the cursor, recolour or rename the terminal, or hide what is printed. Where output is no terminal, lines are not
    wrapped, unless COLUMNS says how wide it is. What tells people nothing (`errors.plain`) is left out."""

    @property  # type: ignore[misc]  # it is set nowhere
    def size(self) -> ConsoleDimensions:
        """Columns and rows."""
        found = super().size
        asked = self._width is not None or self.is_terminal or "COLUMNS" in os.environ
        return found if asked else ConsoleDimensions(ConsoleTuning.columns, found.height)

    def print(self, *objects: Any, **how: Any) -> None:
        """As `rich.console.Console.print`."""
        super().print(*(plain(item) if isinstance(item, str) else item for item in objects), **how)

    def _render_buffer(self, buffer: Iterable[Segment]) -> str:
        # The only place that all text passes, whatever it was part of; rich's own sequences are added in it.
        return super()._render_buffer(
            segment if segment.control else Segment(printable(segment.text), segment.style) for segment in buffer
        )


class CommandConsole(PlainConsole):
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


class ProgressLines(Progress):
    """Progress where output is no terminal (a log, `nohup`, CI): a line every 10 s, and one when a task is done."""

    def __init__(self, output: Console) -> None:
        super().__init__(console=output, disable=True)  # draws no bar
        self._due = time.monotonic() + ConsoleTuning.line_interval_s

    def update(self, task_id: TaskID, **changes: Any) -> None:  # type: ignore[override]
        """As `Progress.update`; prints a line when one is due."""
        was_finished = self._tasks[task_id].finished
        super().update(task_id, **changes)
        task, now = self._tasks[task_id], time.monotonic()
        if now >= self._due or (task.finished and not was_finished):
            self._due = now + ConsoleTuning.line_interval_s
            self.console.print(progress_line(task), highlight=False, markup=False, soft_wrap=True)


def progress_line(task: Task) -> str:
    """A task in words: `track + map 120/250, 14.2/s, 9 s left, 98k Gaussians`."""
    total = "" if task.total is None else f"/{task.total:.0f}"
    parts = [f"{task.description} {task.completed:.0f}{total}"]
    rate = task.finished_speed or task.speed
    parts += [] if rate is None else [f"{rate:.1f}/s"]
    if not task.finished and task.time_remaining is not None:
        parts.append(f"{duration(task.time_remaining)} left")
    info = Text.from_markup(str(task.fields.get("info", ""))).plain
    parts += [" ".join(part.split()) for part in re.split(r"(?<!overlap) {2,}", info) if part.strip()]
    return ", ".join(parts)


def duration(seconds: float) -> str:
    """Seconds for people: `9 s`, `2 min 5 s`, `1 h 20 min`."""
    whole = round(seconds)
    if whole < 60:
        return f"{whole} s"
    if whole < 3600:
        return f"{whole // 60} min {whole % 60} s"
    return f"{whole // 3600} h {whole % 3600 // 60} min"


def progress_bar() -> Progress:
    """A one-line progress bar with rate and time left; the task's field `info` is free text. Where output is no
    terminal, lines take its place."""
    if not console.is_terminal:
        return ProgressLines(console)
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
