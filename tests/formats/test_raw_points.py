# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from ggslam.errors import FormatError
from ggslam.formats.raw_points import read_pose_graph, read_raw_points


def test_points_are_read_back(tmp_path: Path) -> None:
    points = np.random.default_rng(0).normal(size=(7, 4)).astype("<f4")
    points.tofile(tmp_path / "a.bin")
    assert np.array_equal(read_raw_points(tmp_path / "a.bin", 4), points)


def test_damaged_points_are_refused(tmp_path: Path) -> None:
    (tmp_path / "a.bin").write_bytes(b"\0" * 13)
    with pytest.raises(FormatError, match="13 bytes, expected a multiple of 12"):
        read_raw_points(tmp_path / "a.bin")
    np.array([[0, 0, 0], [0, np.nan, 0]], "<f4").tofile(tmp_path / "b.bin")
    with pytest.raises(FormatError, match="point 1 is"):
        read_raw_points(tmp_path / "b.bin")
    with pytest.raises(FormatError, match="file is missing"):
        read_raw_points(tmp_path / "c.bin")


def test_poses_are_read_in_order(tmp_path: Path) -> None:
    (tmp_path / "graph.txt").write_text("v1 1 2 3 0 0 0.70710678 0.70710678\n\nv0 0 0 0 0 0 0 1\n")
    poses = read_pose_graph(tmp_path / "graph.txt")
    assert list(poses) == ["v1", "v0"]
    assert np.allclose(poses["v1"], [[0, -1, 0, 1], [1, 0, 0, 2], [0, 0, 1, 3], [0, 0, 0, 1]], atol=1e-6)


@pytest.mark.parametrize(
    ("text", "reason"),
    [("", "no poses"), ("v0 1 2 3", "line 1: expected a name and 7"), ("v0 1 2 3 0 0 x 1", "line 1"),
     ("v0 1 2 3 0 0 0 2", "no unit quaternion"), ("v0 nan 2 3 0 0 0 1", "no unit quaternion")],
)  # fmt: skip
def test_damaged_poses_are_refused(tmp_path: Path, text: str, reason: str) -> None:
    (tmp_path / "graph.txt").write_text(text)
    with pytest.raises(FormatError, match=reason):
        read_pose_graph(tmp_path / "graph.txt")
