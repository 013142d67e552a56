# SPDX-License-Identifier: Apache-2.0
"""The scores of a batch as one table, in the forms that people paste: CSV, Markdown, LaTeX, HTML."""

from __future__ import annotations

import math
import statistics
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace

from ggslam.jobs.batch.baseline import Scores, Spread, differences
from ggslam.jobs.batch.job_states import JobState, State
from ggslam.jobs.batch.published import PUBLISHED, Published, why_other_data
from ggslam.jobs.batch.run_links import link_to, run_tiles
from ggslam.jobs.batch.table_forms import latex, markdown, number_text, one_line
from ggslam.reporting.page import Html, bullets, page, section, table
from ggslam.runs.records.metrics import MetricsRecord
from ggslam.runs.records.sequence import SequenceRecord
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
    compared: bool = True
    """Whether its difference to the baseline is shown."""


COLUMNS = (
    Column("ATE RMSE cm", ("trajectory", "ate_rmse_m"), 100, 3),
    Column("ATE mean cm", ("trajectory", "ate_mean_m"), 100, 3, compared=False),
    Column("PSNR dB", ("images", "SET", "psnr")),
    Column("SSIM", ("images", "SET", "ssim"), 1, 3),
    Column("LPIPS", ("images", "SET", "lpips"), 1, 3),
    Column("depth L1 cm", ("images", "SET", "depth_l1_m"), 100),
    Column("mIoU %", ("segmentation", "SET", "miou"), 100, 1),
    Column("frames/s", ("speed", "frames_per_s"), 1, 2),
    Column("Gaussians k", ("map", "gaussians"), 1e-3, 1, compared=False),
    Column("memory MB", ("memory", "peak_rss_mb"), 1, 0, compared=False),
)
COMPARED = tuple(k for k, column in enumerate(COLUMNS) if column.compared)
MEAN = "mean"
_NAMES = ("recording", "settings", "runs", "verdict")


@dataclass(frozen=True)
class Row:
    """A line: runs of one recording and one choice of settings that differ by their seeds, or the mean of recordings.

    Attributes:
        recording, settings: names; `MEAN` for the mean of all recordings.
        runs: how many are in it.
        means, spreads: by column; NaN where there is nothing. A spread is the standard deviation over seeds.
        verdict: the worst of the runs; "": none has one.
        deltas: differences to the baseline, see `differences`; None: there is none, or this is it.
        papers: figures of the table's published columns; NaN where there is none, or the paper had other data.
        by_rules: ours by the rules of those.
        states: its runs; of the mean none.
    """

    recording: str
    settings: str
    runs: int
    means: tuple[float, ...]
    spreads: tuple[float, ...]
    verdict: str = ""
    deltas: Spread | None = None
    papers: tuple[float, ...] = ()
    by_rules: tuple[float, ...] = ()
    states: tuple[JobState, ...] = ()


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
        baseline: settings that the others are compared with; None: there are none.
        by_rules: whether our figures by each paper's rules stand beside the paper's.
        other_data: why papers' figures were left out, by recording.
    """

    title: str
    rows: list[Row]
    published: list[Published]
    set_name: str
    failed: list[tuple[str, str]]
    machine: str
    baseline: str | None = None
    by_rules: bool = False
    other_data: tuple[str, ...] = ()

    @staticmethod
    def of(
        title: str, states: Sequence[JobState], machine: str, baseline: str | None = None, by_rules: bool = False
    ) -> ScoresTable:
        """Reads the scores of the runs that are done.

        Args:
            title: of the batch.
            states: of its runs.
            machine: what it was made with.
            baseline: settings that the others are compared with; None: none.
            by_rules: whether to show ours by each paper's rules.
        """
        done = [state for state in states if state.state in (State.DONE, State.SKIPPED)]
        metrics = [(state, MetricsRecord.read(state.run)) for state in done]
        held_out = all(m.images.held_out is not None for _, m in metrics)
        set_name = "held_out" if held_out else "all"
        groups: dict[tuple[str, str], list[tuple[JobState, MetricsRecord]]] = {}
        for state, found in metrics:
            groups.setdefault((state.job.recording, state.job.settings), []).append((state, found))
        reasons = {state.job.name: _other_data(state) for state in done}
        true_data = {state.job.recording for state in done} - {
            state.job.recording for state in done if reasons[state.job.name] is not None
        }
        published = [column for column in PUBLISHED if true_data & set(column.values)]
        rows = [_row(names, runs, set_name, published, true_data) for names, runs in groups.items()]
        if baseline is not None and any(name == baseline for _, name in groups):
            rows = _with_deltas(rows, groups, set_name, baseline)
        rows += _mean_rows(rows)
        failed = [(state.job.name, state.line) for state in states if state.state is State.FAILED]
        notes = tuple(dict.fromkeys(reason for reason in reasons.values() if reason is not None))
        shown = baseline if any(row.deltas is not None for row in rows) else None
        return ScoresTable(
            title, rows, published, set_name.replace("_", "-"), failed, machine, shown, by_rules, notes
        )

    def head(self) -> list[str]:
        """Headings."""
        return [*_NAMES, *(column.title for column in COLUMNS), *self._delta_head(), *self._paper_head()]

    def _delta_head(self) -> list[str]:
        return [] if self.baseline is None else [f"Δ {COLUMNS[k].title}" for k in COMPARED]

    def _paper_head(self) -> list[str]:
        found = []
        for paper in self.published:
            found += [f"{paper.beside}, ours by {paper.title}'s rules ({paper.rule_words})"] * self.by_rules
            found.append(f"{paper.beside}, {paper.title} (published)")
        return found

    def notes(self) -> list[str]:
        """What a reader has to know."""
        lines = [
            f"Image scores and mIoU are means over {self.set_name} frames; ± is the standard deviation over seeds."
        ]
        if self.baseline is not None:
            pairs = "mean and standard deviation of the differences of runs with the same recording and seed"
            lines.append(f"Δ is the difference to the settings {self.baseline}: {pairs}.")
        lines += [f"{p.beside}, {p.title}: {p.source}." for p in self.published]
        lines += [f"Without published figures: {reason}." for reason in self.other_data]
        return [*lines, *(f"failed: {name}: {line}" for name, line in self.failed), self.machine]

    def cells(self, plus_minus: str = " ± ", spreads: bool = True) -> list[list[str]]:
        """Rows as texts."""
        rows = self.rows if spreads else [replace(row, spreads=(math.nan,) * len(COLUMNS)) for row in self.rows]
        return [self._cells(row, plus_minus) for row in rows]

    def _cells(self, row: Row, plus_minus: str) -> list[str]:
        found = [
            number_text(mean, spread, column.digits, plus_minus)
            for column, mean, spread in zip(COLUMNS, row.means, row.spreads, strict=True)
        ]
        if self.baseline is not None:
            found += [_delta_text(row, k, plus_minus) for k in COMPARED]
        for k, paper in enumerate(self.published):
            digits = next(column.digits for column in COLUMNS if column.title == paper.beside)
            found += [number_text(row.by_rules[k], math.nan, digits, "")] * self.by_rules
            found.append("" if math.isnan(row.papers[k]) else f"{row.papers[k]:.4g}")
        return [row.recording, row.settings, str(row.runs), row.verdict, *found]

    def to_csv(self) -> str:
        """Numbers with all their digits, means and spreads in columns of their own."""
        titles = [column.title for column in COLUMNS]
        head = [*_NAMES, *titles, *(f"{title} std" for title in titles)]
        if self.baseline is not None:
            head += [f"{title}{what}" for what in ("", " std") for title in self._delta_head()]
        rows = []
        for row in self.rows:
            numbers = [*row.means, *row.spreads]
            if self.baseline is not None:
                pair = row.deltas or ((math.nan,) * len(COLUMNS),) * 2
                numbers += [values[k] for values in pair for k in COMPARED]
            for k in range(len(self.published)):
                numbers += [*([row.by_rules[k]] * self.by_rules), row.papers[k]]
            names = [row.recording, row.settings, str(row.runs), row.verdict]
            rows.append([*names, *(None if math.isnan(value) else value for value in numbers)])
        return csv_text([*head, *self._paper_head()], rows)

    def to_markdown(self) -> str:
        """A table and its notes."""
        lines = [self.head(), ["---", "---", "---:", "---", *["---:"] * (len(self.head()) - 4)], *self.cells()]
        body = "\n".join("| " + " | ".join(map(markdown, line)) + " |" for line in lines)
        notes = "\n".join(f"- {markdown(note)}" for note in self.notes())
        return f"# {markdown(self.title)}\n\n{body}\n\n{notes}\n"

    def to_latex(self) -> str:
        """A `tabular` for booktabs."""
        lines = [" & ".join(map(latex, line)) + r" \\" for line in (self.head(), *self.cells("±"))]
        notes = "".join(f"% {one_line(note)}\n" for note in self.notes())
        body = "\n".join([r"\toprule", lines[0], r"\midrule", *lines[1:], r"\bottomrule"])
        return f"{notes}\\begin{{tabular}}{{llrl{'r' * (len(self.head()) - 4)}}}\n{body}\n\\end{{tabular}}\n"

    def to_html(self) -> str:
        """A page that opens from disk."""
        parts: list[Html] = [
            section("Scores", "scores", table(self.head(), self._cells_with_links(), sorts=True, text_columns=(1, 3))),
            section("Runs", "runs", run_tiles([state for row in self.rows for state in row.states])),
            section("Notes", "notes", bullets(self.notes())),
        ]
        runs = sum(row.runs for row in self.rows if row.recording != MEAN)
        lead = f"{quantity(runs, 'run')}, {len(self.failed)} failed"
        return page(self.title, lead, parts, [("scores", "Scores"), ("runs", "Runs"), ("notes", "Notes")], self.machine)

    def _cells_with_links(self) -> list[list[str]]:
        """The cells; the name of a recording leads to the report of its first run."""
        return [
            [link_to(cells[0], row.states[0]) if row.states else cells[0], *cells[1:]]
            for row, cells in zip(self.rows, self.cells(), strict=True)
        ]

    def files(self) -> dict[str, Callable[[], str]]:
        """Names of files, and what makes their content."""
        return {
            "table.csv": self.to_csv, "table.md": self.to_markdown, "table.tex": self.to_latex,
            "table.html": self.to_html,
        }  # fmt: skip


def _row(
    names: tuple[str, str], runs: Sequence[tuple[JobState, MetricsRecord]], set_name: str,
    published: Sequence[Published], true_data: set[str],
) -> Row:  # fmt: skip
    values = [[_value(m, column, set_name) for _, m in runs] for column in COLUMNS]
    means, spreads = tuple(map(_mean, values)), tuple(map(_spread, values))
    grades = [v.grade for state, _ in runs if (v := RunVerdict.read_if_there(state.run))]
    papers = tuple(p.values.get(names[0], math.nan) if names[0] in true_data else math.nan for p in published)
    by_rules = tuple(
        math.nan if math.isnan(figure) else _mean([p.rule(m, state.run) for state, m in runs])
        for p, figure in zip(published, papers, strict=True)
    )
    verdict = _worst(grades)
    return Row(*names, len(runs), means, spreads, verdict, None, papers, by_rules, tuple(state for state, _ in runs))


def _worst(grades: list[Grade]) -> str:
    return worst(grades) if grades else ""


def _other_data(state: JobState) -> str | None:
    """Why papers' figures do not belong beside a run; None: they do, or there are none."""
    return why_other_data(state.job.recording, SequenceRecord.read_if_there(state.run))


def _with_deltas(
    rows: Sequence[Row], groups: Mapping[tuple[str, str], Sequence[tuple[JobState, MetricsRecord]]], set_name: str,
    baseline: str,
) -> list[Row]:  # fmt: skip
    def scores(names: tuple[str, str]) -> Scores:
        return {state.job.seed: [_value(m, column, set_name) for column in COLUMNS] for state, m in groups[names]}

    found = []
    for row in rows:
        compared = row.settings != baseline and (row.recording, baseline) in groups
        deltas = (
            differences(scores((row.recording, row.settings)), scores((row.recording, baseline))) if compared else None
        )
        found.append(replace(row, deltas=deltas))
    return found


def _delta_text(row: Row, column: int, plus_minus: str) -> str:
    if row.deltas is None:
        return ""
    return number_text(row.deltas[0][column], row.deltas[1][column], COLUMNS[column].digits, plus_minus, signed=True)


def _mean_rows(rows: Sequence[Row]) -> list[Row]:
    """For each choice of settings the mean of the recordings, where there are several."""
    names = list(dict.fromkeys(row.settings for row in rows))
    found, none = [], (math.nan,) * len(COLUMNS)
    for name in names:
        mine = [row for row in rows if row.settings == name]
        if len(mine) < 2:
            continue
        means = _column_means([row.means for row in mine])
        compared = [row.deltas[0] for row in mine if row.deltas is not None]
        deltas = (_column_means(compared), none) if len(compared) == len(mine) else None
        papers, by_rules = (_column_means([getattr(row, key) for row in mine]) for key in ("papers", "by_rules"))
        runs = sum(row.runs for row in mine)
        found.append(Row(MEAN, name, runs, means, none, deltas=deltas, papers=papers, by_rules=by_rules))
    return found


def _column_means(rows: Sequence[Sequence[float]]) -> tuple[float, ...]:
    """By column; NaN unless every row has a number."""
    return tuple(_mean(column, whole=True) for column in zip(*rows, strict=True))


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
