# SPDX-License-Identifier: Apache-2.0
"""What a recording is said to hold, and what is said to look wrong."""

from __future__ import annotations

import shutil
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from ggslam.sequences import inspect_sequence, open_sequence

Make = Callable[[str], Path]


def test_report(make: Make) -> None:
    report = inspect_sequence(open_sequence(make("folder")))
    assert (report.format, report.frames, report.pose_source, report.posed_frames) == ("folder", 5, "poses.txt", 5)
    assert report.rate_hz == pytest.approx(10) and report.duration_s == pytest.approx(0.4)
    assert report.depth_m[1] == pytest.approx(1.2) and 0.99 < report.valid_share < 1
    assert report.motion is not None and report.motion.step_m[0] == pytest.approx(0.1)
    assert report.motion.turn_deg[2] == pytest.approx(np.degrees(0.1))
    assert report.mask_ids == [1, 2, 3, 4, 5] and report.labelled_share == pytest.approx(0.5)


def test_suspicious_depth_scale(make: Make) -> None:
    folder = make("replica")
    for scale in (10.0, 50000.0):
        report = inspect_sequence(open_sequence(folder, depth_scale=scale))
        assert any(f"depth scale {scale:g} is suspicious" in warning for warning in report.warnings)
    assert not any("suspicious" in warning for warning in inspect_sequence(open_sequence(folder)).warnings)


def test_damaged_frames_are_told(make: Make) -> None:
    folder = make("replica")
    (folder / "results" / "depth000004.png").write_bytes(b"")
    report = inspect_sequence(open_sequence(folder))
    assert len(report.damaged) == 1 and any("file is empty" in warning for warning in report.warnings)


def test_wrong_pose_convention_shows(shared_data: Path, tmp_path: Path) -> None:
    source = shared_data / "livingroom"
    good = inspect_sequence(open_sequence(source, stride=3, scale=0.5))
    assert good.warnings == [] and good.pose_depth_error is not None and good.pose_depth_error < 0.01
    poses = np.loadtxt(source / "traj.txt").reshape(-1, 4, 4)
    (tmp_path / "results").symlink_to(source / "results")
    shutil.copy(source / "cam_params.json", tmp_path / "cam_params.json")
    np.savetxt(tmp_path / "traj.txt", np.linalg.inv(poses).reshape(-1, 16))
    bad = inspect_sequence(open_sequence(tmp_path, stride=3, scale=0.5))
    assert any("true poses look like world to camera" in warning for warning in bad.warnings)
    np.savetxt(tmp_path / "traj.txt", (poses @ np.diag([1.0, -1, -1, 1])).reshape(-1, 16))
    bad = inspect_sequence(open_sequence(tmp_path, stride=3, scale=0.5))
    assert any("true poses look like OpenGL" in warning for warning in bad.warnings)
