# SPDX-License-Identifier: Apache-2.0
"""The programs in examples/ run as their first lines say."""

from __future__ import annotations

import re
import runpy
import shutil
import sys
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from typer.testing import CliRunner

from ggslam.cli.main import app
from ggslam.formats.gaussian_ply import read_gaussian_ply
from ggslam.formats.trajectory import read_trajectory
from ggslam.runs.folder import RunFolder

ROOT = Path(__file__).parents[1]
EXAMPLES = ROOT / "examples"
pytestmark = pytest.mark.skipif(not EXAMPLES.is_dir(), reason="not in a checkout")


Program = Callable[..., str]


@pytest.fixture
def run(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> Program:
    """Runs a program of the folder in an empty folder; gives what it printed."""

    def started(program: str, *arguments: object) -> str:
        monkeypatch.chdir(tmp_path)
        monkeypatch.setattr(sys, "argv", [program, *map(str, arguments)])
        runpy.run_path(str(EXAMPLES / program), run_name="__main__")
        return capsys.readouterr().out

    return started


def ggslam(*arguments: object) -> None:
    result = CliRunner().invoke(app, [str(argument) for argument in arguments])
    assert result.exit_code == 0 and result.exception is None, (result.output, result.exception)


@pytest.fixture(scope="module")
def finished(room_run: RunFolder, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A run of the first part of the room."""
    return Path(shutil.copytree(room_run.path, tmp_path_factory.mktemp("examples") / "run"))


def test_run_slam(run: Program, room: Path, tmp_path: Path) -> None:
    said = run("run_slam.py", room, "out")
    assert "frame 0: keyframe at [0. 0. 0.]" in said and "24 frames" in said and "sofa (" in said
    assert len(read_trajectory(tmp_path / "out" / "trajectory.txt")) == 24
    assert len(read_gaussian_ply(tmp_path / "out" / "map.ply")) > 1000


@pytest.mark.long("a training that has to get somewhere")
def test_train_gaussians(run: Program, room: Path, tmp_path: Path) -> None:
    said = run("train_gaussians.py", room, "trained.ply", 4, 12)
    before, after = map(float, re.findall(r"PSNR ([\d.]+) dB before, ([\d.]+) dB after", said)[0])
    assert after > before + 4
    assert len(read_gaussian_ply(tmp_path / "trained.ply")) > 1000


@pytest.mark.long("two trainings that have to get somewhere")
def test_densify_gaussians(run: Program, room: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.syspath_prepend(str(EXAMPLES))  # as Python does for the program itself
    said = run("densify_gaussians.py", room, "dense.ply", 4, 40)
    rows = re.findall(r"densification: (\d+) to (\d+) Gaussians, ([\d.]+) dB", said)
    (first, same, sparse), (_, more, dense) = [tuple(map(float, row)) for row in rows]
    assert same == first and more > 3 * first
    assert dense > sparse + 0.5
    assert len(read_gaussian_ply(tmp_path / "dense.ply")) == more


def test_own_camera(run: Program, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    assert run("own_camera.py", 4).count("ok,") == 3
    monkeypatch.syspath_prepend(str(EXAMPLES))
    live = ["python:own_camera:DrawnRoom", "--stop", 4, "--record", "walk", "--out", "run", "--iterations", 1]
    ggslam("run", *live)
    assert len(list((tmp_path / "walk" / "rgb").iterdir())) == 4 and (tmp_path / "run" / "metrics.json").is_file()


def test_own_loss(run: Program, room: Path, tmp_path: Path) -> None:
    plain, sharp = map(float, re.findall(r"0\.\d+", run("own_loss.py", room, "--frames", 4)))
    assert sharp < plain
    own = ["--loss", EXAMPLES / "own_loss.py:same_saturation"]
    ggslam("run", room, "--stop", 2, "--out", "run", "--iterations", 1, *own)
    assert (tmp_path / "run" / "metrics.json").is_file()


def test_remove_object(run: Program, finished: Path, tmp_path: Path) -> None:
    said = run("remove_object.py", finished, "sofa", "without")
    assert said.startswith("objects: ") and said.count("_color.png") == 3
    before, after = (RunFolder.open(path).object_table() for path in (finished, tmp_path / "without"))
    assert {o.name for o in before.objects} - {o.name for o in after.objects} == {"sofa"}


def test_export_everything(run: Program, finished: Path, tmp_path: Path) -> None:
    said = run("export_everything.py", finished, "out")
    written = said.count("wrote ")
    assert written + said.count("left out: ") == 18 and written >= 14
    assert (tmp_path / "out" / "object_meshes").is_dir() and (tmp_path / "out" / "mesh.ply").is_file()


def test_localise(run: Program, finished: Path, room: Path, tmp_path: Path) -> None:
    said = run("localise.py", finished, room, "visit", 6, 10)
    assert len(re.findall(r"frame \d+: \[", said)) == 4
    found = read_trajectory(tmp_path / "visit" / "trajectory.txt").T_world_camera
    known = RunFolder.open(finished).trajectory().T_world_camera[6:10]
    assert np.linalg.norm(found[:, :3, 3] - known[:, :3, 3], axis=1).max() < 0.03


def test_all_examples_are_listed_and_tested() -> None:
    listed = re.findall(r"\]\((\w+\.py)\)", (EXAMPLES / "README.md").read_text())
    assert sorted(listed) == sorted(path.name for path in EXAMPLES.glob("*.py"))
    here = Path(__file__).read_text()
    assert all(f'run("{name}"' in here for name in listed)
