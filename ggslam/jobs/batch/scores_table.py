# SPDX-License-Identifier: Apache-2.0
"""The scores of a batch as one table, in the forms that people paste: CSV, Markdown, LaTeX, HTML."""

from __future__ import annotations

import math
import re
import statistics
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

from ggslam.jobs.batch.job_states import JobState, State
from ggslam.jobs.batch.manifest import BatchJob
from ggslam.jobs.batch.published import PUBLISHED, Published
from ggslam.reporting.page import Html, bullets, page, section, table
from ggslam.runs.records.metrics import MetricsRecord
from ggslam.runs.records.verdict import Grade, RunVerdict, worst
from ggslam.system.csv_text import csv_text
from ggslam.system.plurals import quantity


@dataclass(frozen=True)
class Column:
    """A score: its heading, where metrics.json has it, the factor to the unit of the heading, and digits shown."""

    title: str
    keys: tuple[str, ...]
    factor: float = 1.0
    digits: int = 2


COLUMNS = (
    Column("ATE RMSE cm", ("trajectory", "ate_rmse_m"), 100, 3),
    Column("ATE mean cm", ("trajectory", "ate_mean_m"), 100, 3),
    Column("PSNR dB", ("images", "SET", "psnr")),
    Column("SSIM", ("images", "SET", "ssim"), 1, 3),
    Column("LPIPS", ("images", "SET", "lpips"), 1, 3),
    Column("depth L1 cm", ("images", "SET", "depth_l1_m"), 100),
    Column("mIoU %", ("segmentation", "SET", "miou"), 100, 1),
    Column("frames/s", ("speed", "frames_per_s"), 1, 2),
    Column("Gaussians k", ("map", "gaussians"), 1e-3, 1),
    Column("memory MB", ("memory", "peak_rss_mb"), 1, 0),
)
MEAN = "mean"
_NAMES = ("recording", "settings", "runs", "verdict")


@dataclass(frozen=True)
class Row:
    """A line: runs of one recording and one choice of settings that differ by their seeds, or the mean of recordings.

    Attributes:
        recording, settings: names; `MEAN` for the mean of all recordings.
        runs: how many are in it.
        means, spreads: by column; NaN where there is nothing. A spread is the standard deviation over seeds.
    """

    recording: str
    settings: str
    runs: int
    means: tuple[float, ...]
    spreads: tuple[float, ...]
    verdict: str = ""
    """The worst of the runs; "": none has one."""


@dataclass(frozen=True)
class ScoresTable:
    """A batch's table.

    Attributes:
        title: of the batch.
        rows: recordings in their order, then the means of each choice of settings.
        published: columns of papers that have a figure for a recording here.
        set_name: frames that image scores are about.
        failed: (name, line) of the runs that failed.
        machine: what it was made with.
    """

    title: str
    rows: list[Row]
    published: list[Published]
    set_name: str
    failed: list[tuple[str, str]]
    machine: str

    @staticmethod
    def of(title: str, states: Sequence[JobState], machine: str) -> ScoresTable:
        """Reads the scores of the runs that are done."""
        done = [state for state in states if state.state in (State.DONE, State.SKIPPED)]
        metrics = {state.job: MetricsRecord.read(state.run) for state in done}
        held_out = all(m.images.held_out is not None for m in metrics.values())
        set_name = "held_out" if held_out else "all"
        grades = {state.job: verdict.grade for state in done if (verdict := RunVerdict.read_if_there(state.run))}
        groups: dict[tuple[str, str], list[BatchJob]] = {}
        for job in metrics:
            groups.setdefault((job.recording, job.settings), []).append(job)
        rows = [
            _row(names, [metrics[job] for job in jobs], set_name, [grades[job] for job in jobs if job in grades])
            for names, jobs in groups.items()
        ]
        rows += _mean_rows(rows)
        recordings = {row.recording for row in rows}
        published = [column for column in PUBLISHED if recordings & set(column.values)]
        failed = [(state.job.name, state.line) for state in states if state.state is State.FAILED]
        return ScoresTable(title, rows, published, set_name.replace("_", "-"), failed, machine)

    def head(self) -> list[str]:
        """Headings."""
        own = [column.title for column in COLUMNS]
        return [*_NAMES, *own, *(f"{p.beside}, {p.title} (published)" for p in self.published)]

    def notes(self) -> list[str]:
        """What a reader has to know."""
        lines = [
            f"Image scores and mIoU are means over {self.set_name} frames; ± is the standard deviation over seeds."
        ]
        lines += [f"{p.beside}, {p.title}: {p.source}." for p in self.published]
        return [*lines, *(f"failed: {name}: {line}" for name, line in self.failed), self.machine]

    def cells(self, plus_minus: str = " ± ", spreads: bool = True) -> list[list[str]]:
        """Rows as texts."""
        rows = self.rows if spreads else [replace(row, spreads=(math.nan,) * len(COLUMNS)) for row in self.rows]
        return [self._cells(row, plus_minus) for row in rows]

    def _cells(self, row: Row, plus_minus: str) -> list[str]:
        found = [
            _text(mean, spread, column.digits, plus_minus)
            for column, mean, spread in zip(COLUMNS, row.means, row.spreads, strict=True)
        ]
        others = [f"{p.values[row.recording]:g}" if row.recording in p.values else "" for p in self.published]
        return [row.recording, row.settings, str(row.runs), row.verdict, *found, *others]

    def to_csv(self) -> str:
        """Numbers with all their digits, means and spreads in columns of their own."""
        spreads = [f"{column.title} std" for column in COLUMNS]
        names, end = len(_NAMES), len(_NAMES) + len(COLUMNS)
        rows = []
        for row, cells in zip(self.rows, self.cells(), strict=True):
            numbers = [None if math.isnan(value) else value for value in (*row.means, *row.spreads)]
            rows.append([*cells[:names], *numbers, *cells[end:]])
        return csv_text([*self.head()[:end], *spreads, *self.head()[end:]], rows)

    def to_markdown(self) -> str:
        """A table and its notes."""
        lines = [self.head(), ["---", "---", "---:", "---", *["---:"] * (len(self.head()) - 4)], *self.cells()]
        body = "\n".join("| " + " | ".join(map(_markdown, line)) + " |" for line in lines)
        notes = "\n".join(f"- {_markdown(note)}" for note in self.notes())
        return f"# {_markdown(self.title)}\n\n{body}\n\n{notes}\n"

    def to_latex(self) -> str:
        """A `tabular` for booktabs."""
        lines = [" & ".join(map(_latex, line)) + r" \\" for line in (self.head(), *self.cells("±"))]
        notes = "".join(f"% {_one_line(note)}\n" for note in self.notes())
        body = "\n".join([r"\toprule", lines[0], r"\midrule", *lines[1:], r"\bottomrule"])
        return f"{notes}\\begin{{tabular}}{{llrl{'r' * (len(self.head()) - 4)}}}\n{body}\n\\end{{tabular}}\n"

    def to_html(self) -> str:
        """A page that opens from disk."""
        parts: list[Html] = [
            section("Scores", "scores", table(self.head(), self.cells(), sorts=True, text_columns=(1, 3))),
            section("Notes", "notes", bullets(self.notes())),
        ]
        runs = sum(row.runs for row in self.rows if row.recording != MEAN)
        lead = f"{quantity(runs, 'run')}, {len(self.failed)} failed"
        return page(self.title, lead, parts, [("scores", "Scores"), ("notes", "Notes")], self.machine)

    def files(self) -> dict[str, Callable[[], str]]:
        """Names of files, and what makes their content."""
        return {
            "table.csv": self.to_csv, "table.md": self.to_markdown, "table.tex": self.to_latex,
            "table.html": self.to_html,
        }  # fmt: skip


def _row(names: tuple[str, str], found: Sequence[MetricsRecord], set_name: str, grades: list[Grade]) -> Row:
    values = [[_value(m, column, set_name) for m in found] for column in COLUMNS]
    means, spreads = tuple(map(_mean, values)), tuple(map(_spread, values))
    return Row(*names, len(found), means, spreads, worst(grades) if grades else "")


def _mean_rows(rows: Sequence[Row]) -> list[Row]:
    """For each choice of settings the mean of the recordings, where there are several."""
    names = list(dict.fromkeys(row.settings for row in rows))
    found = []
    for name in names:
        mine = [row for row in rows if row.settings == name]
        if len(mine) > 1:
            means = tuple(_mean([row.means[k] for row in mine], whole=True) for k in range(len(COLUMNS)))
            found.append(Row(MEAN, name, sum(row.runs for row in mine), means, (math.nan,) * len(COLUMNS)))
    return found


def _value(metrics: MetricsRecord, column: Column, set_name: str) -> float:
    value = metrics.number(*(set_name if key == "SET" else key for key in column.keys))
    return math.nan if value is None else column.factor * value


def _mean(values: Sequence[float], whole: bool = False) -> float:
    """Of those that are there; with `whole` NaN unless all are."""
    there = [value for value in values if not math.isnan(value)]
    return statistics.fmean(there) if there and (not whole or len(there) == len(values)) else math.nan


def _spread(values: Sequence[float]) -> float:
    there = [value for value in values if not math.isnan(value)]
    return statistics.stdev(there) if len(there) > 1 else math.nan


def _text(mean: float, spread: float, digits: int, plus_minus: str) -> str:
    if math.isnan(mean):
        return "–"
    return f"{mean:.{digits}f}" + ("" if math.isnan(spread) else f"{plus_minus}{spread:.{digits}f}")


_LATEX = {
    "\\": r"\textbackslash{}", "{": r"\{", "}": r"\}", "$": r"\$", "&": r"\&", "%": r"\%", "_": r"\_", "#": r"\#",
    "~": r"\textasciitilde{}", "^": r"\textasciicircum{}", "<": r"\textless{}", ">": r"\textgreater{}",
    "|": r"\textbar{}", "–": "--", "±": r"$\pm$",
}  # fmt: skip


def _latex(text: str) -> str:
    """A cell's text; a name cannot become a command."""
    return "".join(_LATEX.get(character, character) for character in _one_line(text))


def _markdown(text: str) -> str:
    """A cell's text; a name cannot become HTML, a link or another cell."""
    return re.sub(r"([\\`*\[\]|])", r"\\\1", _one_line(text)).replace("<", "&lt;")


def _one_line(text: str) -> str:
    return " ".join(text.split())
