# SPDX-License-Identifier: Apache-2.0
"""What rtabmap-export writes: calibration, poses by id, and where the camera is on the robot."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from command_line import ggslam
from format_makers import make_rtabmap
from tiny_recordings import FRAMES, pose

from ggslam.errors import SequenceError
from ggslam.scene.camera import Camera
from ggslam.sequences import open_sequence

OPTICAL = np.array([[0.0, 0, 1, 0.12], [-1, 0, 0, 0.03], [0, -1, 0, 0.5], [0, 0, 0, 1]])
"""A camera that looks forward on a robot with x forward, y left, z up."""


def test_poses_by_id(tmp_path: Path) -> None:
    """Ids have gaps and lines are in another order; a node that the graph dropped has no pose, and a time between."""
    folder = make_rtabmap(tmp_path)
    sequence = open_sequence(folder)
    assert sequence.format == "rtabmap" and sequence.camera == Camera(32, 24, 30, 31, 15, 11)
    np.testing.assert_allclose(sequence.timestamps - 1000, np.array([2, 3, 5, 6, 8]) / 30, atol=1e-6)
    lines = (folder / "poses.txt").read_text().splitlines()
    (folder / "poses.txt").write_text("\n".join(line for line in lines if not line.endswith(" 5")))
    fewer = open_sequence(folder)
    assert fewer.ground_truth is not None
    assert np.isnan(fewer.ground_truth[:, 0, 0]).tolist() == [False, False, True, False, False]
    np.testing.assert_allclose(fewer.ground_truth[3:], [pose(3), pose(4)], atol=1e-6)
    np.testing.assert_allclose(fewer.timestamps, sequence.timestamps, atol=1e-6)


@pytest.mark.parametrize("prefix", ["", "walk_"])
def test_poses_of_the_robot(tmp_path: Path, prefix: str) -> None:
    """With a local transform they are turned into the camera's; *_camera_poses.txt are the camera's already."""
    folder = make_rtabmap(tmp_path, prefix, OPTICAL)
    truth = open_sequence(folder).ground_truth
    assert truth is not None
    np.testing.assert_allclose(truth, [pose(i) for i in range(FRAMES)], atol=1e-6)
    rows = [" ".join(map(str, pose(i)[:3].ravel())) for i in range(FRAMES)]
    (folder / f"{prefix}camera_poses.txt").write_text("\n".join(rows))
    of_camera = open_sequence(folder)
    assert of_camera.pose_source == f"{prefix}camera_poses.txt"
    np.testing.assert_allclose(of_camera.ground_truth, [pose(i) for i in range(FRAMES)], atol=1e-12)


def test_intrinsics_of_each_frame(tmp_path: Path) -> None:
    folder = make_rtabmap(tmp_path)
    path = folder / "calib" / "5.yaml"
    path.write_text(path.read_text().replace("30.", "33."))
    assert open_sequence(folder).lens == "intrinsics of each frame brought to the first one's"


def test_two_exports_in_a_folder(tmp_path: Path) -> None:
    make_rtabmap(tmp_path, "a_")
    make_rtabmap(tmp_path, "b_")
    with pytest.raises(SequenceError, match="a_rgb, b_rgb"):
        open_sequence(tmp_path)


def test_from_the_field(shared_data: Path) -> None:
    path = shared_data / "field" / "recordings" / "rtabmap_export"
    if not path.is_dir():
        pytest.skip(f"no recording from the field at {path}")
    told = ggslam("inspect", path).stdout
    assert "fx 120.00 fy 120.00 cx 79.50 cy 59.50" in told and "poses         16 frames" in told
    assert "depth agrees with the poses to 0.5%" in told
