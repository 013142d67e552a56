# SPDX-License-Identifier: Apache-2.0
"""Files of poses: what is no pose is named and does not pass as one."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from ggslam.sequences.pose_files import read_pose_rows

SHIFTED = "1 0 0 {x} 0 1 0 2 0 0 1 3"


@pytest.mark.parametrize(
    ("wrong", "reason"), [("2 0 0 0 0 2 0 0 0 0 2 0", "rotation"), ("1 0 0 nan 0 1 0 0 0 0 1 0", "NaN")]
)
def test_a_row_that_is_no_pose_is_not_a_number(tmp_path: Path, wrong: str, reason: str) -> None:
    path = tmp_path / "poses.txt"
    path.write_text("\n".join([SHIFTED.format(x=5), wrong, SHIFTED.format(x=7) + " 0 0 0 1"]))
    rows = read_pose_rows(path)
    poses, problems = rows.poses, rows.problems
    assert np.isnan(poses[1]).all() and list(problems) == [1]
    assert "poses.txt, line 2" in problems[1] and reason in problems[1]
    assert poses[0, :3, 3].tolist() == [5, 2, 3] and poses[2, :3, 3].tolist() == [7, 2, 3]
    assert poses[2, 3].tolist() == [0, 0, 0, 1]


def test_a_tum_line_without_a_rotation_is_named(tmp_path: Path) -> None:
    path = tmp_path / "trajectory.txt"
    path.write_text("# time tx ty tz qx qy qz qw\n0.5 1 2 3 0 0 0 1\n0.6 1 2 3 0 0 0 0\n")
    rows = read_pose_rows(path)
    times, poses, problems = rows.stamps, rows.poses, rows.problems
    assert times is not None
    assert times.tolist() == [0.5, 0.6] and list(problems) == [1] and "line 3" in problems[1]
    np.testing.assert_array_equal(poses[0], [[1, 0, 0, 1], [0, 1, 0, 2], [0, 0, 1, 3], [0, 0, 0, 1]])
    assert np.isnan(poses[1]).all()


@pytest.mark.parametrize("row", ["0 0 0 0 0 0 0", "0.1 0 0 0 0 0 0 0"])
def test_a_quaternion_of_zeros_is_named_as_what_it_is(tmp_path: Path, row: str) -> None:
    good = row[:-1] + "1"
    (tmp_path / "poses.txt").write_text(f"{good}\n{row}\n{good}\n")
    rows = read_pose_rows(tmp_path / "poses.txt")
    assert rows.problems == {1: f"{tmp_path}/poses.txt, line 2: pose holds a quaternion of length 0, not 1"}
