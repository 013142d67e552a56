# SPDX-License-Identifier: Apache-2.0
"""scripts/benchmarks/field.py: what counts as met, and its tables."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import pytest

SCRIPTS = Path(__file__).parents[1] / "scripts" / "benchmarks"
sys.path.insert(0, str(SCRIPTS))

from field_cases import CASES, Between, Case, Ends, Outcome, Says, naming  # noqa: E402

SAID = "recording     mirror_depth (folder)\nwarning: depth scale 5 is off; try --depth-scale 470\n"


def test_a_mistake_counts_as_named_in_a_line_that_complains(tmp_path: Path) -> None:
    told = Outcome(SAID, 0, tmp_path)
    assert not naming("mirror").met(told)  # the recording's name is no complaint
    assert naming("depth scale").found(told) == "warning: depth scale 5 is off; try --depth-scale 470"
    assert Says(r"^recording\s+mirror").met(told)


def test_numbers_are_read_and_compared(tmp_path: Path) -> None:
    told = Outcome(SAID, 2, tmp_path)
    scale = Between(r"--depth-scale ([0-9.]+)", 400, 550)
    assert scale.met(told) and scale.value(told) == "470"
    assert not Between(r"--depth-scale ([0-9.]+)", 900, 1100).met(told)
    assert not Between(r"nothing ([0-9.]+)", -1e9, 1e9).met(told)
    assert not Between("ATE", 0, 1e9).met(told)  # there is no run
    assert Ends(2).met(told) and not Ends(0).met(told)


def test_a_case_is_met_if_it_is_named_or_mended(tmp_path: Path) -> None:
    case = Case("a", ("inspect", "{case}"), "right", naming("off"), (Ends(0), Says("right")))
    assert case.met(Outcome("warning: it is off", 0, tmp_path))
    assert case.met(Outcome("right", 0, tmp_path)) and not case.met(Outcome("right", 1, tmp_path))
    assert not Case("a", (), "right", naming("off")).met(Outcome("", 0, tmp_path))
    assert case.command(Path("/d"), tmp_path)[3:] == ["inspect", "/d/recordings/a"]


def test_every_case_is_there(shared_data: Path) -> None:
    data = shared_data / "field"
    if not data.is_dir():
        pytest.skip(f"no field cases at {data}")
    assert [case.title for case in CASES if not (data / case.below / case.name).is_dir()] == []
    named = {case.name for case in CASES}
    assert {path.name for path in (data / "recordings").iterdir()} <= named | {"calibrations"}


@pytest.mark.long("starts ggslam in processes of their own")
def test_recordings_by_the_defaults_in_a_table(room: Path) -> None:
    done = subprocess.run(
        [sys.executable, SCRIPTS / "field.py", room, room / "nowhere", "--scale", "0.5", "--stop", "6"],
        capture_output=True, text=True, timeout=600,
    )  # fmt: skip
    lines = [[cell.strip() for cell in line.split("|")[1:-1]] for line in done.stdout.splitlines()]
    assert done.returncode == 0 and lines[0][0] == "recording" and lines[0][-1] == "exit code", done.stderr
    found = dict(zip(lines[0], lines[2], strict=True))
    assert found["frames"] == "6" and found["lost"] == "0" and found["exit code"] == "0"
    assert float(found["ATE cm"]) < 1 and found["verdict"].split()[0] in ("good", "doubtful")
    assert lines[3][0] == "nowhere" and lines[3][-1] == "2"


@pytest.mark.long("a process that loads everything")
def test_cases_that_are_not_there_are_told(tmp_path: Path) -> None:
    done = subprocess.run(
        [sys.executable, SCRIPTS / "field.py", "--data", tmp_path, "--only", "npy_depth"],
        capture_output=True, text=True, timeout=600,
    )  # fmt: skip
    assert "| npy_depth |  |  | read, 1 unit a metre | not there |" in done.stdout
    assert "0 of 1 cases met, 1 not there" in done.stdout and done.returncode == 0
