# SPDX-License-Identifier: Apache-2.0
"""The table of a batch, from the scores of its runs."""

from __future__ import annotations

import csv
import io
from pathlib import Path

import pytest

from ggslam.jobs.batch.job_states import JobState, State
from ggslam.jobs.batch.manifest import BatchJob
from ggslam.jobs.batch.scores_table import MEAN, ScoresTable
from ggslam.runs.records.metrics import MetricsRecord
from ggslam.runs.records.verdict import Grade, RunVerdict


def done(
    out: Path, recording: str, settings: str, seed: int, psnr: float, ate: float | None, grade: Grade | None = None
) -> JobState:
    state = JobState(BatchJob(recording, settings, seed, (recording,)), out, State.DONE)
    state.run.mkdir(parents=True)
    images = {"held_out": {"psnr": psnr, "ssim": 0.9, "frames": 3}, "all": {"psnr": psnr + 1, "frames": 20}}
    trajectory = {} if ate is None else {"trajectory": {"ate_rmse_m": ate, "ate_mean_m": 0.9 * ate}}
    MetricsRecord.of({"images": images, "map": {"gaussians": 12345}, **trajectory}).write(state.run)
    if grade is not None:
        RunVerdict(grade=grade).write(state.run)
    return state


@pytest.fixture
def table(tmp_path: Path) -> ScoresTable:
    states = [
        done(tmp_path, "room0", "default", 0, 30.0, 0.010, "bad"),
        done(tmp_path, "room0", "default", 1, 32.0, 0.020, "good"),
        done(tmp_path, "kitchen", "default", 0, 25.0, None), done(tmp_path, "room0", "k_1", 0, 28.0, 0.030),
    ]  # fmt: skip
    failed = JobState(BatchJob("kitchen", "k_1", 0, ()), tmp_path, State.FAILED, "no depth & 50% of it")
    return ScoresTable.of("mine", [*states, failed], "a machine")


def test_means_and_spreads_over_seeds_and_means_over_recordings(table: ScoresTable) -> None:
    cells = {(row[0], row[1]): dict(zip(table.head(), row, strict=True)) for row in table.cells()}
    assert list(cells) == [("room0", "default"), ("kitchen", "default"), ("room0", "k_1"), (MEAN, "default")]
    room, kitchen, mean = cells["room0", "default"], cells["kitchen", "default"], cells[MEAN, "default"]
    assert room["runs"] == "2" and room["PSNR dB"] == "31.00 ± 1.41" and room["ATE RMSE cm"] == "1.500 ± 0.707"
    assert kitchen["ATE RMSE cm"] == "–" and kitchen["PSNR dB"] == "25.00" and kitchen["Gaussians k"] == "12.3"
    assert mean["PSNR dB"] == "28.00" and mean["ATE RMSE cm"] == "–"  # not of all recordings: no mean
    assert room["verdict"] == "bad" and kitchen["verdict"] == "" == mean["verdict"]  # the worst of the seeds
    assert room["PSNR dB, GS-ICP (published)"] == "35.37" and kitchen["PSNR dB, GS-ICP (published)"] == ""


def test_every_form_holds_the_same_and_names_what_failed(table: ScoresTable) -> None:
    rows = list(csv.DictReader(io.StringIO(table.to_csv())))
    assert (
        float(rows[0]["PSNR dB"]) == 31
        and rows[1]["ATE RMSE cm"] == ""
        and float(rows[0]["PSNR dB std"]) ** 2 == (pytest.approx(2))
    )
    markdown, latex, page = table.to_markdown(), table.to_latex(), table.to_html()
    for text in (markdown, page):
        assert "31.00 ± 1.41" in text and "held-out" in text and "a machine" in text
    assert "failed: kitchen/k_1/seed0: no depth & 50% of it" in markdown and "no depth &amp; 50% of it" in page
    assert r"room0 & k\_1 & 1 &  & 3.000" in latex and r"31.00$\pm$1.41" in latex and r"mIoU \%" in latex
    lines = [line for line in latex.splitlines() if line.endswith(r"\\")]
    assert len(lines) == 5 and len({line.count("&") for line in lines}) == 1


def test_nothing_done(tmp_path: Path) -> None:
    table = ScoresTable.of("mine", [JobState(BatchJob("a", "b", 0, ()), tmp_path, State.FAILED, "why")], "m")
    assert table.rows == [] and "why" in table.to_markdown() and "tabular" in table.to_latex() and table.to_html()


HOSTILE = ("=2+5", r"\input{/etc/passwd}", "a|b", "<script>alert(1)</script>", "[x](javascript:y)", "$^~#{}", "a\nb")


@pytest.mark.parametrize("name", HOSTILE)
def test_a_name_stays_a_name_in_every_form(tmp_path: Path, name: str) -> None:
    states = [done(tmp_path, name, "default", 0, 30.0, 0.01), done(tmp_path, "room0", "default", 0, 30.0, 0.01)]
    failed = JobState(BatchJob(name, "x", 0, ()), tmp_path, State.FAILED, f"{name}\n\\end{{document}}")
    table = ScoresTable.of(name, [*states, failed], "a machine")
    rows = list(csv.reader(io.StringIO(table.to_csv(), newline="")))
    assert rows[1][0] == (f"'{name}" if name[0] == "=" else name) and len({len(row) for row in rows}) == 1
    latex = table.to_latex()
    assert latex.count("\\end") == 2  # the table's own and, in a comment, the error's
    body = [line for line in latex.splitlines() if not line.startswith("%")]
    assert not any(r"\input" in line or "\\end{document}" in line for line in body)
    assert len([line for line in body if line.endswith(r"\\")]) == 4 and len(body) == 9
    markdown = table.to_markdown()
    assert "<script" not in markdown and "](" not in markdown.replace(r"\](", "")
    assert len({len(line.replace(r"\|", "").split("|")) for line in markdown.splitlines() if line[:1] == "|"}) == 1
    assert "<script>alert" not in table.to_html()
