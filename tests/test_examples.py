# SPDX-License-Identifier: Apache-2.0
"""The programs in examples/ run as their first lines say."""

from __future__ import annotations

import os
import re
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from ggslam.formats.gaussian_ply import read_gaussian_ply
from ggslam.formats.trajectory import read_trajectory
from ggslam.run_folder import RunFolder

ROOT = Path(__file__).parents[1]
EXAMPLES = ROOT / "examples"
pytestmark = pytest.mark.skipif(not EXAMPLES.is_dir(), reason="not in a checkout")


def run(program: str, *arguments: object, cwd: Path) -> str:
    command = [sys.executable, str(EXAMPLES / program) if program.endswith(".py") else "-m", *map(str, arguments)]
    paths = os.pathsep.join([str(ROOT), str(EXAMPLES)])
    done = subprocess.run(
        command, cwd=cwd, capture_output=True, text=True, check=False, env={**os.environ, "PYTHONPATH": paths}
    )
    assert done.returncode == 0, done.stdout + done.stderr
    return done.stdout


def ggslam(*arguments: object, cwd: Path) -> str:
    return run("-m", "ggslam.cli.main", *arguments, cwd=cwd)


@pytest.fixture(scope="module")
def finished(room: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A run of the first half of the room."""
    folder = tmp_path_factory.mktemp("examples")
    ggslam("run", room, "--stop", 12, "--config", "fast-cpu", "--no-eval", "--out", "run", cwd=folder)
    return folder / "run"


def test_run_slam(room: Path, tmp_path: Path) -> None:
    said = run("run_slam.py", room, "out", cwd=tmp_path)
    assert "frame 0: keyframe" in said and "24 frames" in said
    assert len(read_trajectory(tmp_path / "out" / "trajectory.txt")) == 24
    assert len(read_gaussian_ply(tmp_path / "out" / "map.ply")) > 1000


def test_own_camera(tmp_path: Path) -> None:
    assert run("own_camera.py", 4, cwd=tmp_path).count("ok,") == 3
    live = ["python:own_camera:DrawnRoom", "--stop", 4, "--record", "walk", "--out", "run", "--iterations", 1]
    ggslam("run", *live, cwd=tmp_path)
    assert len(list((tmp_path / "walk" / "rgb").iterdir())) == 4 and (tmp_path / "run" / "metrics.json").is_file()


def test_remove_object(finished: Path, tmp_path: Path) -> None:
    said = run("remove_object.py", finished, "sofa", "without", cwd=tmp_path)
    assert said.startswith("objects: ") and said.count("_color.png") == 3
    before, after = (RunFolder.open(path).object_table() for path in (finished, tmp_path / "without"))
    assert {o.name for o in before.objects} - {o.name for o in after.objects} == {"sofa"}


def test_export_everything(finished: Path, tmp_path: Path) -> None:
    said = run("export_everything.py", finished, "out", cwd=tmp_path)
    written = said.count("wrote ")
    assert written + said.count("left out: ") == 14 and written >= 11
    assert (tmp_path / "out" / "object_meshes").is_dir() and (tmp_path / "out" / "mesh.ply").is_file()


def test_localise(finished: Path, room: Path, tmp_path: Path) -> None:
    said = run("localise.py", finished, room, "visit", 6, 10, cwd=tmp_path)
    assert len(re.findall(r"frame \d+: \[", said)) == 4
    found = read_trajectory(tmp_path / "visit" / "trajectory.txt").T_world_camera
    known = RunFolder.open(finished).trajectory().T_world_camera[6:10]
    assert np.linalg.norm(found[:, :3, 3] - known[:, :3, 3], axis=1).max() < 0.03


def test_all_examples_are_listed_and_tested() -> None:
    listed = re.findall(r"\]\((\w+\.py)\)", (EXAMPLES / "README.md").read_text())
    assert sorted(listed) == sorted(path.name for path in EXAMPLES.glob("*.py"))
    here = Path(__file__).read_text()
    assert all(f'run("{name}"' in here for name in listed)
