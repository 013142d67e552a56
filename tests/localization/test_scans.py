# SPDX-License-Identifier: Apache-2.0
"""Recordings of laser scans: points without a position are left out of every scan, and told of once."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from command_line import ggslam, refuse

from ggslam.errors import FormatError, SequenceError
from ggslam.formats.pcd import pcd_bytes
from ggslam.localization.scans import ScanSequence
from ggslam.scene.poses import matrix_to_quaternion, se3_exp


@pytest.mark.parametrize("suffix", [".bin", ".npy"])
def test_points_without_a_position_are_left_out_and_told_of_once(
    tmp_path: Path, suffix: str, caplog: pytest.LogCaptureFixture
) -> None:
    rng = np.random.default_rng(0)
    scans = [rng.normal(size=(400, 4)).astype("<f4") * [30, 30, 3, 0.1] for _ in range(4)]
    for number, gone in enumerate([0, 30, 0, 70]):
        scans[number] = scans[number].astype("<f4")
        scans[number][:gone, 1] = np.nan
        path = tmp_path / f"{number:06}{suffix}"
        scans[number].tofile(path) if suffix == ".bin" else np.save(path, scans[number])
    read = list(ScanSequence(tmp_path).stream())
    for scan, stored, gone in zip(read, scans, [0, 30, 0, 70], strict=True):
        assert scan.points.dtype == np.float32 and np.array_equal(scan.points, stored[gone:, :3])
    told = [record.getMessage() for record in caplog.records]
    assert len(told) == 1 and f"000001{suffix}: left out 30 of 400 points" in told[0]


def test_poses_of_scans_may_stand_in_their_own_headers(tmp_path: Path) -> None:
    rng = np.random.default_rng(0)
    poses = [se3_exp(rng.normal(size=6)) for _ in range(4)]
    points = rng.normal(size=(50, 3)).astype(np.float32)
    data = pcd_bytes({name: points[:, axis] for axis, name in enumerate("xyz")})
    own = b"VIEWPOINT 0 0 0 1 0 0 0"
    assert own in data
    for number in range(len(poses)):
        (tmp_path / f"{number}.pcd").write_bytes(data)
    assert ScanSequence(tmp_path).ground_truth is None
    for number, T in enumerate(poses):
        numbers = [*T[:3, 3], *matrix_to_quaternion(T[:3, :3])]
        line = "VIEWPOINT " + " ".join(f"{value:.9f}" for value in numbers)
        (tmp_path / f"{number}.pcd").write_bytes(data.replace(own, line.encode()))
    scans = ScanSequence(tmp_path, start=1)
    np.testing.assert_allclose(scans.ground_truth, poses[1:], atol=1e-8)
    np.testing.assert_array_equal(scans.scan(0).points, points)
    (tmp_path / "trajectory.txt").write_text("".join(f"{n} 0 0 {n} 0 0 0 1\n" for n in range(4)))
    assert ScanSequence(tmp_path).ground_truth[3][2, 3] == 3
    (tmp_path / "trajectory.txt").unlink()
    (tmp_path / "2.pcd").write_bytes(data.replace(own + b"\n", b""))
    with pytest.raises(SequenceError, match=r"2\.pcd: .*VIEWPOINT"):
        ScanSequence(tmp_path)
    (tmp_path / "2.pcd").write_bytes(data.replace(own, b"VIEWPOINT 0 0 0 0 0 0 0"))
    with pytest.raises(FormatError, match=r"2\.pcd: VIEWPOINT"):
        ScanSequence(tmp_path)


@pytest.mark.parametrize("command", [("localize", "{map}", "{scans}"), ("submaps", "{scans}", "--out", "{out}")])
@pytest.mark.parametrize("ending", ["las", "e57", "pcap"])
def test_folders_of_scans_of_other_kinds_are_named(tmp_path: Path, command: tuple[str, ...], ending: str) -> None:
    (tmp_path / "scans").mkdir()
    (tmp_path / "scans" / f"0.{ending}").write_bytes(b"LASF")
    paths = {"map": tmp_path.parent / f"{tmp_path.name}.npy", "scans": tmp_path, "out": tmp_path / "store"}
    np.save(paths["map"], np.random.default_rng(0).normal(size=(100, 3)))
    refuse(ggslam(*(word.format(**paths) for word in command)), f"0.{ending}: is not read")
