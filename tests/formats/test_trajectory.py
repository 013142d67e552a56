# SPDX-License-Identifier: Apache-2.0
"""Trajectories survive a round trip; damaged ones are refused with file and line."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from ggslam.errors import FormatError
from ggslam.formats.trajectory import read_matrices, read_trajectory, read_tum, write_tum
from ggslam.scene.poses import matrix_to_quaternion, se3_exp


def poses(count: int = 20) -> np.ndarray:
    generator = np.random.default_rng(1)
    return np.stack([se3_exp(generator.normal(size=6)) for _ in range(count)])


def test_tum_round_trip(tmp_path: Path) -> None:
    times = 1.3e9 + np.arange(20) / 30
    assert write_tum(tmp_path / "a.txt", times, poses()) == 20
    found = read_tum(tmp_path / "a.txt")
    np.testing.assert_allclose(found.timestamps, times, atol=3e-7)
    np.testing.assert_allclose(found.T_world_camera, poses(), atol=5e-9)


def test_tum_files_are_xyzw(tmp_path: Path) -> None:
    turned = np.eye(4)  # 90 degrees about z: x goes to y
    turned[:3, :3] = [[0, -1, 0], [1, 0, 0], [0, 0, 1]]
    write_tum(tmp_path / "a.txt", [0.5], turned[None])
    row = [float(word) for word in (tmp_path / "a.txt").read_text().splitlines()[-1].split()]
    np.testing.assert_allclose(row, [0.5, 0, 0, 0, 0, 0, np.sqrt(0.5), np.sqrt(0.5)], atol=1e-9)
    (tmp_path / "b.txt").write_text("1 0 0 0 0.7071067811865476 0 0 0.7071067811865476\n")
    np.testing.assert_allclose(read_tum(tmp_path / "b.txt").T_world_camera[0, :3, :3] @ [0, 1, 0], [0, 0, 1], atol=1e-9)


def test_lost_frames_are_left_out(tmp_path: Path) -> None:
    some = poses(5)
    some[2] = np.nan
    assert write_tum(tmp_path / "a.txt", range(5), some) == 4
    assert read_tum(tmp_path / "a.txt").timestamps.tolist() == [0, 1, 3, 4]


@pytest.mark.parametrize("columns", [12, 16])
def test_matrix_rows(tmp_path: Path, columns: int) -> None:
    path = tmp_path / "traj.txt"
    np.savetxt(path, poses().reshape(20, 16)[:, :columns])
    for found in (read_matrices(path), read_trajectory(path)):
        np.testing.assert_allclose(found.T_world_camera, poses(), atol=1e-9)
        assert found.timestamps.tolist() == list(range(20))


def test_missing_poses_only_where_allowed(tmp_path: Path) -> None:
    rows = poses(3).reshape(3, 16)
    rows[1] = -np.inf
    np.savetxt(tmp_path / "traj.txt", rows)
    with pytest.raises(FormatError, match=r"traj\.txt, line 2: .* 1 .*-inf"):
        read_matrices(tmp_path / "traj.txt")
    found = read_matrices(tmp_path / "traj.txt", allow_missing=True).T_world_camera
    assert np.isnan(found[1]).all() and np.isfinite(found[[0, 2]]).all()


@pytest.mark.parametrize(
    ("line", "reason"),
    [
        ("1 0 0 0 0 0 0", "8.* 7"),
        ("1 0 0 0 0 0 0 1 5", "8.* 9"),
        ("1 0 nan 0 0 0 0 1", " 3 .*nan"),
        ("1 0 0 0 0 0 0 inf", " 8 .*inf"),
        ("1 0 0 zero 0 0 0 1", "zero"),
        ("1 0 0 0 0 0 0 0", "0 0 0 0 .* 0"),
        ("1 0 0 0 3 0 0 1", r"3\.16"),
    ],
)
def test_damaged_tum_lines_are_named(tmp_path: Path, line: str, reason: str) -> None:
    (tmp_path / "t.txt").write_text("# a comment\n\n0 0 0 0 0 0 0 1\n" + line + "\n")
    with pytest.raises(FormatError, match=rf"t\.txt, line 4: .*{reason}"):
        read_tum(tmp_path / "t.txt")


def test_other_damage(tmp_path: Path) -> None:
    path = tmp_path / "t.txt"
    path.write_text("# nothing\n")
    for read in (read_tum, read_matrices, read_trajectory):
        with pytest.raises(FormatError, match=r"t\.txt.*no poses"):
            read(path)
        with pytest.raises(FormatError, match=r"none\.txt.*missing"):
            read(tmp_path / "none.txt")
    path.write_bytes(b"\xff\xfe\x00")
    with pytest.raises(FormatError, match=r"t\.txt.*text"):
        read_tum(path)
    path.write_text(" ".join(map(str, (2 * np.eye(4)).ravel())))
    with pytest.raises(FormatError, match=r"t\.txt, line 1: .*rigid"):
        read_matrices(path)


def test_shared_recordings(shared_data: Path) -> None:
    path = shared_data / "livingroom" / "traj.txt"
    if not path.exists():
        pytest.skip("no livingroom")
    assert len(read_trajectory(path)) == 200
    assert len(read_trajectory(shared_data / "rgbd_dataset_freiburg3_cabinet" / "groundtruth.txt")) > 50


def euroc_lines(times: list[int], rest: str = "") -> list[str]:
    rows = []
    for time, T in zip(times, poses(len(times)), strict=True):
        numbers = [*T[:3, 3], *matrix_to_quaternion(T[:3, :3])]
        rows.append(f"{time}," + ",".join(f"{number:.9f}" for number in numbers) + rest)
    return rows


@pytest.mark.parametrize("rest", ["", ",0.1,0.2,0.3", ",0.1,0.2,0.3,1,2,3,4,5,6"])
def test_euroc_tables_are_wxyz_in_nanoseconds(tmp_path: Path, rest: str) -> None:
    times = [1403636579763555584 + 50_000_000 * n for n in range(5)]
    header = "#timestamp, p_RS_R_x [m], p_RS_R_y [m], p_RS_R_z [m], q_RS_w [], q_RS_x [], q_RS_y [], q_RS_z []"
    (tmp_path / "data.csv").write_text("\n".join([header, *euroc_lines(times, rest)]) + "\n")
    found = read_trajectory(tmp_path / "data.csv")
    np.testing.assert_allclose(found.timestamps, np.array(times) * 1e-9, atol=3e-7)
    np.testing.assert_allclose(found.T_world_camera, poses(5), atol=1e-8)
    (tmp_path / "short.csv").write_text("1403636579763555584,1,2,3\n")
    with pytest.raises(FormatError, match=r"short\.csv, line 1: .*8.*4"):
        read_trajectory(tmp_path / "short.csv")


@pytest.mark.parametrize("mark", ["#", ""])
def test_tables_with_more_columns_are_read_in_the_order_of_their_header(tmp_path: Path, mark: str) -> None:
    rows = [line.split(",") for line in euroc_lines([10**18 * n for n in range(1, 4)])]
    turned = [",".join([*row[:4], *row[5:8], row[4], "1", "2", "3", "4"]) for row in rows]
    head = f"{mark}timestamp [ns], px, py, pz, qx, qy, qz, qw, vx, vy, vz, bw"
    (tmp_path / "turned.csv").write_text("\n".join([head, *turned]) + "\n")
    np.testing.assert_allclose(read_trajectory(tmp_path / "turned.csv").T_world_camera, poses(3), atol=1e-8)


@pytest.mark.parametrize(("unit", "factor"), [("ns", 10**9), ("us", 10**6), ("ms", 1000), ("s", 1)])
def test_times_of_tum_files_may_be_in_nanoseconds(tmp_path: Path, unit: str, factor: int) -> None:
    rows = [f"{(1700000000 + n) * factor} 0 0 {n} 0 0 0 1" for n in range(4)]
    (tmp_path / f"{unit}.txt").write_text("\n".join(rows))
    found = read_trajectory(tmp_path / f"{unit}.txt")
    np.testing.assert_allclose(found.timestamps, 1700000000 + np.arange(4), atol=1e-6)
    assert found.T_world_camera[:, 2, 3].tolist() == [0, 1, 2, 3]


def test_pose_graphs_of_g2o(tmp_path: Path) -> None:
    lines = []
    for number, T in reversed(list(enumerate(poses(6)))):
        w, x, y, z = matrix_to_quaternion(T[:3, :3])
        numbers = " ".join(f"{value:.9f}" for value in (*T[:3, 3], x, y, z, w))
        lines.append(f"VERTEX_SE3:QUAT {number} {numbers}")
    edge = "EDGE_SE3:QUAT 0 1 " + " ".join(["0"] * 6 + ["1"] * 22)
    (tmp_path / "graph.g2o").write_text("\n".join(["FIX 0", *lines, edge]))
    found = read_trajectory(tmp_path / "graph.g2o")
    assert found.timestamps.tolist() == [0, 1, 2, 3, 4, 5]
    np.testing.assert_allclose(found.T_world_camera, poses(6), atol=1e-8)
    (tmp_path / "twice.g2o").write_text("\n".join([lines[0], lines[0]]))
    with pytest.raises(FormatError, match=r"twice\.g2o, line 2"):
        read_trajectory(tmp_path / "twice.g2o")
    (tmp_path / "edges.g2o").write_text(edge)
    with pytest.raises(FormatError, match="no poses"):
        read_trajectory(tmp_path / "edges.g2o")
