# SPDX-License-Identifier: Apache-2.0
"""The table of a batch, from the scores of its runs."""

from __future__ import annotations

import csv
import io
import re
from pathlib import Path
from urllib.parse import unquote

import pytest

from ggslam.jobs.batch.job_states import JobState, State
from ggslam.jobs.batch.manifest import BatchJob
from ggslam.jobs.batch.scores_table import MEAN, ScoresTable
from ggslam.runs.records.metrics import MetricsRecord
from ggslam.runs.records.sequence import SequenceRecord
from ggslam.runs.records.verdict import Grade, RunVerdict


def done(
    out: Path, recording: str, settings: str, seed: int, psnr: float, ate: float | None, grade: Grade | None = None,
    size: tuple[int, int] = (1200, 680), frames: int = 2000,
) -> JobState:  # fmt: skip
    state = JobState(BatchJob(recording, settings, seed, (recording,)), out, State.DONE)
    state.run.mkdir(parents=True)
    images = {"held_out": {"psnr": psnr, "ssim": 0.9, "frames": 3}, "all": {"psnr": psnr + 1, "frames": 20}}
    trajectory = {} if ate is None else {"trajectory": {"ate_rmse_m": ate, "ate_mean_m": 0.9 * ate}}
    MetricsRecord.of({"images": images, "map": {"gaussians": 12345}, **trajectory}).write(state.run)
    camera = {"width": size[0], "height": size[1], "fx": 600.0, "fy": 600.0, "cx": 599.5, "cy": 339.5}
    SequenceRecord.of({"open": {"path": recording}, "camera": camera, "frames": frames}).write(state.run)
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


def test_differences_are_numbers_in_csv(tmp_path: Path) -> None:
    states = [
        done(tmp_path, "room0", "default", 0, 30.0, 0.010), done(tmp_path, "room0", "default", 1, 32.0, 0.020),
        done(tmp_path, "room0", "more", 0, 29.5, 0.010), done(tmp_path, "room0", "more", 1, 31.0, 0.020),
    ]  # fmt: skip
    table = ScoresTable.of("mine", states, "a machine", "default", by_rules=True)
    rows = list(csv.DictReader(io.StringIO(table.to_csv())))
    assert rows[0]["Δ PSNR dB"] == "" and float(rows[1]["Δ PSNR dB"]) == -0.75
    assert float(rows[1]["Δ PSNR dB std"]) ** 2 == pytest.approx(0.125)
    assert float(rows[1]["PSNR dB, GS-ICP (published)"]) == 35.37 and None not in rows[1]


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


def cells_of(table: ScoresTable) -> dict[tuple[str, str], dict[str, str]]:
    return {(row[0], row[1]): dict(zip(table.head(), row, strict=True)) for row in table.cells()}


@pytest.mark.parametrize(("size", "frames"), [((640, 480), 2000), ((1200, 680), 200), ((1200, 680), 2001)])
def test_published_figures_stand_beside_the_papers_data_only(
    tmp_path: Path, size: tuple[int, int], frames: int
) -> None:
    states = [
        done(tmp_path, "room0", "default", 0, 30.0, 0.01), done(tmp_path, "room1", "default", 0, 30.0, 0.01),
        done(tmp_path, "office3", "default", 0, 30.0, 0.01, None, size, frames),
    ]  # fmt: skip
    table = ScoresTable.of("mine", states, "a machine")
    column = "PSNR dB, GS-ICP (published)"
    assert [cells_of(table)[name, "default"][column] for name in ("room0", "room1", "office3", MEAN)] == (
        ["35.37", "37.8", "", ""]  # the mean of three, one of which has none
    )
    told = f"office3: papers have 2000 frames of 1200x680, this run {frames} of {size[0]}x{size[1]}"
    assert told in table.to_markdown()


def test_the_mean_of_published_figures_is_of_the_same_scenes(tmp_path: Path) -> None:
    states = [done(tmp_path, name, "default", 0, 30.0, 0.01) for name in ("room0", "room1")]
    mean = cells_of(ScoresTable.of("mine", states, "a machine"))[MEAN, "default"]
    assert mean["PSNR dB, MonoGS (published)"] == "35.63"  # of 34.83 and 36.43
    assert mean["ATE RMSE cm, RTG-SLAM (published)"] == "0.19"


def test_differences_to_the_baseline_pair_seeds(tmp_path: Path) -> None:
    states = [
        *(done(tmp_path, "kitchen", "default", seed, psnr, None) for seed, psnr in enumerate((20.0, 30.0, 25.0))),
        *(done(tmp_path, "kitchen", "new", seed, psnr, None) for seed, psnr in enumerate((21.0, 33.0))),
        done(tmp_path, "hall", "new", 0, 20.0, None),
    ]  # fmt: skip
    table = ScoresTable.of("mine", states, "a machine", baseline="default")
    cells = cells_of(table)
    assert cells["kitchen", "new"]["Δ PSNR dB"] == "+2.00 ± 1.41"  # of +1 and +3, though the scores spread by 8
    assert cells["kitchen", "default"]["Δ PSNR dB"] == cells["hall", "new"]["Δ PSNR dB"] == ""
    assert cells[MEAN, "new"]["Δ PSNR dB"] == "" and cells["kitchen", "new"]["Δ ATE RMSE cm"] == "–"
    assert "Δ Gaussians k" not in table.head() and r"$\Delta$ PSNR" in table.to_latex()
    assert "Δ" not in ScoresTable.of("mine", states, "a machine").to_markdown()


def test_ours_by_each_papers_rules(tmp_path: Path) -> None:
    state = done(tmp_path, "room0", "default", 0, 30.0, 0.01)
    record = MetricsRecord.read(state.run).model_dump()
    record["images"]["keyframes"] = {"psnr": 33.0}
    MetricsRecord.of(record).write(state.run)
    rows = [(0, "keyframe", 40), (5, "other", 30), (6, "other", 10), (10, "held-out", 34), (15, "keyframe", 50)]
    lines = ["frame,kind,psnr", *(f"{frame},{kind},{psnr}" for frame, kind, psnr in rows)]
    (state.run / "frames.csv").write_text("\n".join(lines) + "\n")
    cells = cells_of(ScoresTable.of("mine", [state], "a machine", by_rules=True))["room0", "default"]
    ours = {name.split("ours by ")[1]: value for name, value in cells.items() if "ours by" in name}
    assert ours == {
        "GS-ICP's rules (mean error)": "0.900", "RTG-SLAM's rules (RMSE)": "1.000",
        "GS-ICP's rules (keyframes, masked)": "33.00", "MonoGS's rules (every fifth frame, no keyframes)": "32.00",
    }  # fmt: skip


def test_the_page_leads_to_runs_and_their_pictures(tmp_path: Path) -> None:
    state = done(tmp_path, "a b", "default", 0, 30.0, 0.01)
    (state.run / "report.html").write_text("x")
    (state.run / "renders").mkdir()
    (state.run / "renders" / "compare000000.png").write_bytes(b"x")
    bare = done(tmp_path, "hall", "default", 0, 30.0, 0.01)
    page = ScoresTable.of("mine", [state, bare], "a machine").to_html()
    for address in re.findall(r'(?:href|src)="([^#"]+)"', page):
        assert (tmp_path / unquote(address)).is_file(), address
    assert page.count("report.html") == 3 and "compare000000.png" in page and "hall/default/seed0" in page
