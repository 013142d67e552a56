# SPDX-License-Identifier: Apache-2.0
"""Every command of the cookbook does what is asked for, in the order of the page, on small recordings."""

from __future__ import annotations

import json
import re
import shlex
import shutil
from pathlib import Path

import numpy as np
import pytest
from command_line import ggslam

import ggslam as library

ROOT = Path(__file__).parents[1]
PAGE = ROOT / "docs" / "cookbook.md"
pytestmark = pytest.mark.skipif(not PAGE.is_file(), reason="not in a checkout")


def commands() -> list[str]:
    return re.findall(r"```bash\nggslam (.*)\n```", PAGE.read_text())


@pytest.fixture(scope="module")
def place(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """What the page takes for granted: a recording and its run, a later run, a scan, a selection of the page."""
    place = tmp_path_factory.mktemp("cookbook")
    library.write_synthetic_sequence(place / "data" / "kitchen", frames=12, width=160, height=120, seed=0)
    settings = ["refine_iterations=0", "mapping.iterations_per_frame=2"]
    for name, first in (("kitchen", 0), ("evening", 2)):
        library.run_recording(place / "data" / "kitchen", place / "runs" / name, overrides=settings, start=first)
    run = library.RunFolder.open(place / "runs" / "kitchen")
    cloud = library.surface_points(run, voxel_size=0.03)
    library.write_point_cloud(place / "scan.ply", cloud.points, {"color": cloud.colors})
    middle = np.median(cloud.points, axis=0).round(3).tolist()
    shape = {"kind": "sphere", "center": middle, "radius": 0.5}
    (place / "selection.json").write_text(json.dumps([{"mode": "set", "shape": shape}]))
    return place


def test_there_are_enough_questions() -> None:
    text = PAGE.read_text()
    assert len(commands()) >= 25 and len(re.findall(r"^\*\*.*?\?\*\*|^\*\*.*?\.\*\*", text, re.M)) >= 25
    assert len(commands()) == text.count("```bash")  # one line each


MADE = {
    "--html": "kitchen.html", "--film": "round.mp4", "--plan": "plan.png", "--pose": "view.png",
    "--crop": "runs/cropped", "@selection": "runs/clean", "--inpaint": "runs/without", "merge": "runs/both",
    "mesh": "kitchen.glb",
    "spz": "kitchen.spz", "encode": "kitchen.bin", "colmap": "colmap", "align": "registered.json",
    "trajectory --out": "trajectory.txt", "localize": "found", "changes": "changes",
    "report": "runs/kitchen/report.html", "refine": "runs/finer", "--iterations": "runs/fast",
}  # fmt: skip
"""Words of a command, and what it leaves behind."""


@pytest.mark.long("all commands of the page, most of which render or train")
def test_every_command_does_what_is_asked(place: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(place)
    failed = {}
    for command in commands():
        done = ggslam(*shlex.split(command))
        if done.returncode or "error" in done.stderr:
            failed[command] = done.stderr[-400:] or done.stdout[-400:]
        for words, made in MADE.items():
            if words in command and not (place / made).exists():
                failed[f"{command}: {made}"] = "is not there"
    assert not failed, "\n".join(f"{command}\n    {why}" for command, why in failed.items())
    kept = library.RunFolder.open(place / "runs" / "cropped").gaussians().means.numpy()
    assert (np.abs(kept - [0, 0, 2]) <= np.array([3, 3, 4]) / 2 + 1e-4).all() and len(kept) > 100
    shutil.rmtree(place / "runs")
