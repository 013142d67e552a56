# SPDX-License-Identifier: Apache-2.0
"""`run --energy`: what each part of a run used, on a made-up board of 10 W, on the console, in timing.json and in the
report; the run itself is as without."""

from __future__ import annotations

import json
from contextlib import nullcontext
from functools import partial
from pathlib import Path
from typing import Any

import pytest
from typer.testing import CliRunner

from ggslam.cli.main import app
from ggslam.jobs.run import pipeline
from ggslam.jobs.run.run_recording import run_recording
from ggslam.jobs.run.slam_loop import make_slam
from ggslam.runs.folder import RunFolder
from ggslam.runs.verification import verify_run
from ggslam.slam.schedules import BesideTraining
from ggslam.slam.slam import Slam
from ggslam.system.energy import EnergyMeter

FEW = ["mapping.iterations_per_frame=2", "refine_iterations=20"]
"""As the run that the tests share was made."""
STEPS = ["tracking", "mapping", "objects", "final refinement", "writing"]


@pytest.fixture
def board(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """A machine whose board takes 10 W all the time."""
    place = tmp_path / "sys" / "class" / "hwmon" / "hwmon0"
    place.mkdir(parents=True)
    for name, text in (("name", "ina3221"), ("in1_label", "VDD_IN"), ("in1_input", "5000"), ("curr1_input", "2000")):
        (place / name).write_text(text)
    monkeypatch.setattr(pipeline, "EnergyMeter", partial(EnergyMeter, tmp_path / "sys"))


@pytest.mark.usefixtures("board")
def test_parts_of_a_run_add_up_to_the_whole(room: Path, room_run: RunFolder, tmp_path: Path) -> None:
    outcome = run_recording(room, tmp_path / "run", overrides=FEW, stop=10, energy=True)
    energy = outcome.folder.timing().energy
    assert energy is not None and energy == outcome.energy and energy.source == "INA VDD_IN" and energy.note == ""
    assert set(STEPS) <= set(energy.parts) and {"scoring", "reading and the rest"} <= set(energy.parts)
    for name in STEPS:
        used = energy.parts[name]
        assert used.cpu_s > 0 and used.joules == pytest.approx(10 * used.seconds, rel=0.2, abs=0.5), name
    assert energy.whole.joules == pytest.approx(sum(used.joules or 0 for used in energy.parts.values()))
    assert energy.whole.joules == pytest.approx(10 * energy.whole.seconds, rel=0.02)
    timing = outcome.folder.timing()
    assert energy.parts["tracking"].seconds == pytest.approx(timing.tracking_s, rel=0.3, abs=0.05)
    assert energy.parts["final refinement"].seconds == pytest.approx(timing.refinement_s, rel=0.3, abs=0.1)
    assert energy.whole.seconds > timing.wall_s + timing.refinement_s
    assert "loops" in energy.parts and not energy.beside and timing.beside_s == 0 < timing.loops_s
    report = (outcome.folder.path / "report.html").read_text()
    assert "Energy of the whole machine (INA VDD_IN)" in report and "final refinement" in report
    assert verify_run(outcome.folder.path).good
    same = (tmp_path / "run" / "map.ply").read_bytes() == (room_run.path / "map.ply").read_bytes()
    assert same and room_run.timing().energy is None


def test_machines_without_sensors_tell_the_processors_seconds(
    room: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(pipeline, "EnergyMeter", partial(EnergyMeter, tmp_path / "nothing"))
    words = ["run", str(room), "--stop", "6", "--no-eval", "--out", str(tmp_path / "run"), "--energy"]
    words += [word for setting in FEW for word in ("--set", setting)]
    done = CliRunner().invoke(app, words)
    assert done.exit_code == 0, done.output
    told = " ".join(done.output.split())
    assert "no energy: this machine has no RAPL counters" in told and "processor time" in told
    energy = json.loads((tmp_path / "run" / "timing.json").read_text())["energy"]
    assert energy["source"] is None and energy["parts"]["tracking"]["joules"] is None
    assert energy["parts"]["tracking"]["cpu_s"] > 0 and "joules" not in energy["whole"]
    assert "No energy" in (tmp_path / "run" / "report.html").read_text()


@pytest.mark.usefixtures("board")
def test_side_by_side_is_one_part(room: Path, tmp_path: Path) -> None:
    outcome = run_recording(room, tmp_path / "run", overrides=[*FEW, "realtime_fps=30"], stop=10, energy=True)
    assert outcome.energy is not None
    assert "tracking and mapping, side by side" in outcome.energy.parts
    assert not {"tracking", "mapping"} & set(outcome.energy.parts)


@pytest.mark.usefixtures("board")
def test_what_another_thread_did_beside_the_frames_stands_apart(
    room: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """As on a GPU."""

    def make(*arguments: Any) -> Slam:
        slam = make_slam(*arguments)
        slam.schedule = BesideTraining(nullcontext())
        return slam

    monkeypatch.setattr("ggslam.jobs.run.slam_loop.make_slam", make)
    outcome = run_recording(room, tmp_path / "run", overrides=FEW, stop=10, energy=True)
    energy, timing = outcome.energy, outcome.folder.timing()
    assert energy is not None and timing.energy == energy
    assert "loops" not in energy.parts and list(energy.beside) == ["mapping", "loops"]
    assert all(used.seconds > 0 < used.cpu_s and used.joules is None for used in energy.beside.values())
    beside = sum(used.seconds for used in energy.beside.values())
    assert 0 < timing.loops_s <= energy.beside["loops"].seconds  # each is measured within the next
    assert timing.loops_s < timing.beside_s <= beside
    assert energy.whole.seconds == pytest.approx(sum(used.seconds for used in energy.parts.values()))
    assert f"beside the frames: mapping {energy.beside['mapping'].seconds:.1f} s, loops " in energy.text()
    report = (outcome.folder.path / "report.html").read_text()
    assert f"Beside these stages another thread worked for {timing.beside_s:.2f} s" in report
    assert "loops, beside the frames" in report
