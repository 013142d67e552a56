# SPDX-License-Identifier: Apache-2.0
"""Pages of runs: well-formed, self-contained, honest about what is missing."""

from __future__ import annotations

import re
from dataclasses import asdict, replace
from html.parser import HTMLParser

import numpy as np
import pytest

from ggslam.jobs.report.comparison_page import by_recording, comparison_page
from ggslam.jobs.report.run_data import FrameView, LevelAxes, Path3D, RunData, stage_seconds
from ggslam.jobs.report.run_page import run_page
from ggslam.jobs.report.run_plots import all_plots, trajectory_plots
from ggslam.runs.records.metrics import MetricsRecord
from ggslam.runs.records.run_json import RunRecord
from ggslam.runs.records.sequence import SequenceRecord
from ggslam.runs.records.timing import TimingRecord
from ggslam.scene.camera import Camera

VOID = {"meta", "img", "br", "link", "input"}
ADDRESSES = ("src", "href", "xlink:href", "srcset", "data", "action")


class Checker(HTMLParser):
    """Raises where tags do not match; collects what pages refer to and say."""

    def __init__(self) -> None:
        super().__init__()
        self.open: list[str] = []
        self.addresses: list[str] = []
        self.counts: dict[str, int] = {}
        self.words: list[str] = []

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.counts[tag] = self.counts.get(tag, 0) + 1
        self.addresses += [value or "" for name, value in attrs if name in ADDRESSES]
        assert not any(name.startswith("on") for name, _ in attrs)
        if tag not in VOID:
            self.open.append(tag)

    def handle_startendtag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.counts[tag] = self.counts.get(tag, 0) + 1

    def handle_endtag(self, tag: str) -> None:
        assert self.open and self.open[-1] == tag, f"</{tag}> closes {self.open[-3:]}"
        self.open.pop()

    def handle_data(self, data: str) -> None:
        if self.open[-1:] not in (["style"], ["script"]):
            self.words.append(data)


def checked(page: str) -> Checker:
    """Fails unless the page is well-formed and needs nothing but itself."""
    checker = Checker()
    checker.feed(page)
    checker.close()
    assert checker.open == []
    assert all(a.startswith(("#", "data:image/jpeg;base64,")) for a in checker.addresses)
    without_names = page.replace("http://www.w3.org/2000/svg", "")
    assert not re.search(r"https?://|@import|url\(", without_names)
    return checker


def recording(path: str) -> SequenceRecord:
    return SequenceRecord.of({"open": {"path": path}, "camera": asdict(Camera(320, 240, 240.0, 240.0, 160.0, 120.0))})


def some_run(name: str = "kitchen", psnr: float = 30.0) -> RunData:
    frames = np.arange(20)
    positions = np.stack([np.cos(frames / 5), np.zeros(20), np.sin(frames / 5)], 1)
    step = np.linspace(1, 2, 20)
    return RunData(
        name=name, path=f"/runs/{name}",
        camera_path=Path3D(frames, frames / 30, positions, positions + 0.01, np.full(20, 0.01)),
        tracked={"frame": frames.astype(float), "overlap": step / 2, "rmse_m": step / 100,
                 "status": np.array(["first"] + ["ok"] * 15 + ["lost"] * 4)},
        keyframes=np.array([0, 5, 10]),
        steps={"frame": frames, "step_ms": step, "tracking_ms": step, "gaussians": 1000 * step,
               "resident_mb": 100 * step, "loss_total": step / 10, "loss_color": step / 20, "loss_depth": step / 30},
        scores={"frame": frames, "kind": np.array(["keyframe", "other"] * 10), "psnr": 20 + step, "ssim": step / 2,
                "lpips": np.full(20, np.nan), "depth_l1_m": step / 100},
        metrics=MetricsRecord.of({"images": {"held_out": {"frames": 3, "psnr": psnr, "ssim": 0.9, "lpips": None}},
                                  "trajectory": {"ate_rmse_m": 0.01}, "notes": []}),
        timing=TimingRecord.of({"frames": 20, "frames_per_s": 12.5, "wall_s": 2.0, "tracking_s": 0.5,
                                "refinement_s": 0.0, "gaussians": 2000, "peak_rss_mb": 432.0,
                                "mapping": {"insertion": 0.25, "forward": 0.75}}),
        settings={"seed": 1, "mapping.rate": 0.5}, defaults={"seed": 0, "mapping.rate": 0.5},
        recording=recording("/data/kitchen"),
        mark=RunRecord(ggslam="0.1.0", environment={"python": "3.11", "processor": "a processor"}),
        warnings=["Lost for 4 frames (0.13 s) from frame 16."],
        views=[FrameView(3, {"recorded": np.zeros((6, 8, 3), np.uint8), "rendered": np.ones((6, 8, 3), np.uint8)})],
    )  # fmt: skip


def bare_run(name: str = "old") -> RunData:
    path = Path3D(np.arange(3), np.arange(3.0), np.eye(3), reason="the recording has no ground-truth poses")
    tracked = {"frame": np.arange(3.0), "overlap": np.full(3, np.nan), "rmse_m": np.full(3, np.nan),
               "status": np.array(["ok"] * 3)}  # fmt: skip
    return RunData(name, f"/runs/{name}", path, tracked, np.array([0]))


def test_a_page_is_well_formed_and_shows_all_parts() -> None:
    found = checked(run_page(some_run()))
    words = " ".join(found.words)
    for expected in ("30.00", "432", "12.5", "Lost for 4 frames", "a processor", "/data/kitchen", "frame 3",
                     "Peak signal-to-noise", "seed", "LPIPS was not scored."):  # fmt: skip
        assert expected in words, expected
    assert found.counts["svg"] == len(all_plots([some_run()])) == 13
    assert found.counts["img"] == 2
    assert "All 2 settings" in words and "No comparison with true poses" not in words


def test_what_is_missing_is_said_in_a_sentence() -> None:
    found = checked(run_page(bare_run()))
    words = " ".join(found.words)
    assert "No comparison with true poses: the recording has no ground-truth poses." in words
    assert "This run was not scored" in words and "did not note its steps" in words
    assert "There are no pictures" in words and "settings of this run are not known" in words
    assert found.counts["svg"] == 2  # its path alone


@pytest.mark.parametrize("name", ["<script>alert(1)</script>", 'a" onload="b', "a & b", "Küche"])
def test_names_are_words_not_markup(name: str) -> None:
    run = replace(some_run(name), warnings=[name], settings={name: name}, path=name)
    for page in (run_page(run), comparison_page([[run, some_run("b")]], [[FrameView(0, run.views[0].pictures)]])):
        found = checked(page)
        assert found.counts["script"] == 1  # the page's own
        assert name in "".join(found.words)


def test_a_comparison_marks_the_best_and_lists_what_differs() -> None:
    runs = [some_run("a", 30.0), replace(some_run("b", 31.5), settings={"seed": 2, "mapping.rate": 0.5}),
            replace(bare_run("c"), recording=some_run().recording)]  # fmt: skip
    page = comparison_page([runs], [[FrameView(3, {"a": np.zeros((6, 8, 3), np.uint8)})]])
    found = checked(page)
    assert re.search(r'<td class="best"><span>31\.50</span></td>', page)
    assert not re.search(r'<td class="best"><span>30\.00', page)
    settings = page[page.index('<section id="settings">') : page.index('<section id="views">')]
    assert "seed" in settings and "not there" in settings
    assert "Not scored: c." in " ".join(found.words)
    # 0.900 in both is no best one; frames/s and memory are known without scores
    assert 'class="best"><span>0.900' not in page and "frames/s" in " ".join(found.words)


def test_runs_of_different_recordings_are_not_laid_over_each_other() -> None:
    other = replace(some_run("c"), recording=recording("/data/office"))
    runs = [some_run("a"), other, some_run("b")]
    assert by_recording(runs) == [[0, 2], [1]]
    page = comparison_page([[runs[0], runs[2]], [other]], [[], []])
    together = comparison_page([[runs[0], runs[2]]], [[]])
    assert "3 runs of 2 recordings" in page and "a, b: /data/kitchen" in page and "c: /data/office" in page
    assert checked(page).counts["svg"] == checked(together).counts["svg"] + len(all_plots([other]))
    assert "a, b: /data/kitchen" not in together
    assert 'class="best"' not in page and "cannot be held against each other" in page


def test_paths_are_shown_level() -> None:
    tilt = np.array([[1.0, 0, 0], [0, 0.6, 0.8], [0, -0.8, 0.6]])  # rows right, forward, up: 37 degrees off
    run = some_run()
    path = replace(run.camera_path, positions=np.array([[0.0, 0, 0], [1, 1.2, 1.6]]), truth=None, frames=np.arange(2),
                   level=LevelAxes(tilt, "surfaces", -1.5))  # fmt: skip
    top, side = trajectory_plots([replace(run, camera_path=path)])
    assert np.allclose(top.series[0].x, [0, 1]) and np.allclose(top.series[0].y, [0, 2])
    assert np.allclose(side.series[0].y, [1.5, 1.5]) and "floor" in side.y_label and top.equal and side.equal


def test_stages_add_up_to_the_wall_time() -> None:
    stages = {name: seconds for name, _, seconds in stage_seconds(some_run().timing)}
    assert stages == {"tracking": 0.5, "inserting": 0.25, "rendering": 0.75, "other": 0.5}
    assert stage_seconds(None) == [] == stage_seconds(TimingRecord())
