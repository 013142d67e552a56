# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from worlds.pose_graph import read_pose_graph

from ggslam.errors import FormatError
from ggslam.formats.raw_points import read_raw_points


def test_points_are_read_back(tmp_path: Path) -> None:
    points = np.random.default_rng(0).normal(size=(7, 4)).astype("<f4")
    points.tofile(tmp_path / "a.bin")
    assert np.array_equal(read_raw_points(tmp_path / "a.bin", 4), points)


def test_damaged_points_are_refused(tmp_path: Path) -> None:
    (tmp_path / "a.bin").write_bytes(b"\0" * 13)
    with pytest.raises(FormatError, match=r"a\.bin.*\b13\b.*\b4\b"):
        read_raw_points(tmp_path / "a.bin")
    (tmp_path / "a.bin").write_bytes(b"\0" * 16)
    with pytest.raises(FormatError, match=r"a\.bin.*\b16\b.*\b12\b"):
        read_raw_points(tmp_path / "a.bin", 3)
    with pytest.raises(FormatError, match=r"c\.bin.*missing"):
        read_raw_points(tmp_path / "c.bin")


def lidar_numbers(columns: int, seed: int = 0) -> np.ndarray:
    """A scan float32 [n, columns] of 32 rings in a hall: x y z, then intensity, ring, time."""
    rng = np.random.default_rng(seed)
    turn, ring = np.meshgrid(np.linspace(0, 2 * np.pi, 240, endpoint=False), np.arange(32), indexing="ij")
    slope = np.radians(ring - 25.0).ravel()
    reach = np.minimum(np.minimum(1.8 / np.maximum(-np.sin(slope), 1e-3), 12 + 6 * np.sin(3 * turn.ravel())), 60)
    x, y = reach * np.cos(slope) * np.cos(turn.ravel()), reach * np.cos(slope) * np.sin(turn.ravel())
    others = [x, y, reach * np.sin(slope), rng.integers(0, 100, len(x)), ring.ravel(), turn.ravel() / 63]
    return np.stack(others[:columns], 1).astype("<f4")


@pytest.mark.parametrize("columns", [3, 4, 5, 6])
@pytest.mark.parametrize("name", ["a.bin", "a.pcd.bin"])
def test_the_numbers_tell_their_columns(tmp_path: Path, columns: int, name: str) -> None:
    numbers = lidar_numbers(columns)
    for kept in (len(numbers), 60 * 64):  # multiples of each other's widths, too
        numbers[:kept].tofile(tmp_path / name)
        assert np.array_equal(read_raw_points(tmp_path / name), numbers[:kept])
        assert np.array_equal(read_raw_points(tmp_path / name, columns), numbers[:kept])
    for other in {3, 4, 5, 6} - {columns, 2 * columns}:
        if numbers[:kept].size % other == 0:
            with pytest.raises(FormatError, match=f"{name}.* {other} .* {columns}"):
                read_raw_points(tmp_path / name, other)


def test_few_numbers_tell_nothing(tmp_path: Path) -> None:
    points = np.random.default_rng(1).normal(size=(60, 1)).astype("<f4")
    points.tofile(tmp_path / "a.bin")
    points.tofile(tmp_path / "a.pcd.bin")
    assert read_raw_points(tmp_path / "a.bin").shape == (15, 4)
    assert read_raw_points(tmp_path / "a.pcd.bin").shape == (12, 5)
    assert read_raw_points(tmp_path / "a.bin", 3).shape == (20, 3)


def test_poses_are_read_in_order(tmp_path: Path) -> None:
    (tmp_path / "graph.txt").write_text("v1 1 2 3 0 0 0.70710678 0.70710678\n\nv0 0 0 0 0 0 0 1\n")
    poses = read_pose_graph(tmp_path / "graph.txt")
    assert list(poses) == ["v1", "v0"]
    assert np.allclose(poses["v1"], [[0, -1, 0, 1], [1, 0, 0, 2], [0, 0, 1, 3], [0, 0, 0, 1]], atol=1e-6)


@pytest.mark.parametrize(
    ("text", "reason"),
    [("", "no poses"), ("v0 1 2 3", "line 1: .*7"), ("v0 1 2 3 0 0 x 1", "line 1"),
     ("v0 1 2 3 0 0 0 2", "no unit quaternion"), ("v0 nan 2 3 0 0 0 1", "no unit quaternion")],
)  # fmt: skip
def test_damaged_poses_are_refused(tmp_path: Path, text: str, reason: str) -> None:
    (tmp_path / "graph.txt").write_text(text)
    with pytest.raises(FormatError, match=reason):
        read_pose_graph(tmp_path / "graph.txt")
