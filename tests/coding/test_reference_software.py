# SPDX-License-Identifier: Apache-2.0
"""Streams and clouds go to the reference software and come from it (`GGSLAM_TMC3`: a tmc3 binary of release-v12.9)."""

from __future__ import annotations

import json
import os
import subprocess
import zlib
from collections.abc import Sequence
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial import cKDTree

from ggslam.coding import CodecSettings, decode_cloud, encode_cloud
from ggslam.formats.point_cloud import read_point_cloud, write_point_cloud
from ggslam.formats.point_ply import VoxelCloud, write_points
from ggslam.jobs.encode.coding import decode_file, encode_file

TOOLS = ["--trisoupNodeSizeLog2=0", "--mergeDuplicatedPoints=1", "--positionQuantizationScale=1", "--transformType=0"]


@pytest.fixture(scope="module")
def tmc3() -> str:
    binary = os.environ.get("GGSLAM_TMC3")
    if not binary:
        pytest.skip("GGSLAM_TMC3 names no tmc3 binary of release-v12.9")
    return binary


def run(binary: str, *options: str) -> None:
    done = subprocess.run([binary, *options], capture_output=True, text=True, timeout=120)
    assert done.returncode == 0 and "Error" not in done.stdout, done.stdout + done.stderr


def reference_decodes(binary: str, stream: Path, voxel_size: float = 1.0) -> np.ndarray:
    """Rows of x y z in voxels and attributes, sorted."""
    out = stream.with_suffix(".theirs.ply")
    run(binary, "--mode=1", f"--compressedStreamPath={stream}", f"--reconstructedDataPath={out}",
        "--convertPlyColourspace=1", "--outputBinaryPly=1")  # fmt: skip
    return sorted_rows(out, voxel_size)


def sorted_rows(path: Path, voxel_size: float = 1.0) -> np.ndarray:
    cloud = read_point_cloud(path)
    voxels = cloud.points / voxel_size
    assert np.abs(voxels - np.rint(voxels)).max() < 0.01
    columns = [np.rint(voxels)]
    columns += [] if cloud.colors is None else [cloud.colors]
    columns += [] if cloud.reflectance is None else [cloud.reflectance[:, None]]
    rows = np.concatenate([column.astype(np.float64) for column in columns], 1)
    return rows[np.lexsort(rows.T[::-1])]


def our_rows(stream: Path, *attributes: str) -> np.ndarray:
    cloud = decode_cloud(stream.read_bytes())
    points = cloud.grid_points * cloud.quantization.global_scale + np.array(cloud.quantization.origin)
    columns = [points, *(cloud.attributes[name].reshape(len(points), -1) for name in attributes)]
    rows = np.concatenate([np.asarray(column, np.float64) for column in columns], 1)
    return rows[np.lexsort(rows.T[::-1])]


@pytest.fixture
def voxels(surface: tuple[np.ndarray, np.ndarray]) -> VoxelCloud:
    points, colors = surface
    ids = (points[:, 0] // 20 * 37 % 300).astype(np.int32)
    return VoxelCloud(points, colors, ids, 0.02, np.array([-37, 5, 1000]) * 0.02)


@pytest.mark.parametrize("slices", [1, 4])
@pytest.mark.parametrize("ids", [True, False])
def test_our_streams_decode_there(tmc3: str, tmp_path: Path, voxels: VoxelCloud, slices: int, ids: bool) -> None:
    """Slices of differing density, ids or none, a grid of its own scale and origin."""
    write_points(tmp_path, voxels)
    encode_file(tmp_path / "points.ply", tmp_path / "a.bin", CodecSettings(slices=slices, qp=28), ids=ids)
    ours = our_rows(tmp_path / "a.bin", "color")
    theirs = reference_decodes(tmc3, tmp_path / "a.bin", voxels.voxel_size)  # in metres by the stream's own fields
    assert np.array_equal(theirs[:, :6], ours)
    assert theirs.shape[1] == 6 + ids


@pytest.mark.parametrize("slices", [1, 3])
@pytest.mark.parametrize(("ids", "plain"), [([0, 1, 2, 7, 31, 255], True), ([3, 700, 40_000, 65_535], False),
                                            (range(100, 400), False)])  # fmt: skip
def test_ids_arrive_there_as_numbers(
    tmc3: str, tmp_path: Path, voxels: VoxelCloud, ids: Sequence[int], plain: bool, slices: int
) -> None:
    """Small ids as themselves, others as their ranks, whose table stands in the user data: at every point."""
    rng = np.random.default_rng(len(ids))
    known = np.array(list(ids), np.uint16)
    values = known[(voxels.grid[:, 0] // 7 * 37 + rng.integers(0, 3, len(voxels.grid))) % len(known)]
    values[: len(known)] = known
    write_point_cloud(tmp_path / "a.ply", voxels.grid.astype(np.float32), {"color": voxels.colors, "object_id": values})
    encode_file(tmp_path / "a.ply", tmp_path / "a.bin", CodecSettings(qp=28, slices=slices))
    rows = reference_decodes(tmc3, tmp_path / "a.bin")
    numbers = rows[:, 6].astype(int)  # its reflectance
    table = user_data(tmp_path / "a.bin")["tables"]["object_id"]["ids"]
    assert table == (int(known.max()) + 1 if plain else known.tolist())
    found = numbers if plain else np.array(table)[numbers]
    true = {tuple(p): v for p, v in zip(voxels.grid.tolist(), values.tolist(), strict=True)}
    assert found.tolist() == [true[tuple(p)] for p in rows[:, :3].astype(int).tolist()]
    assert np.array_equal(our_rows(tmp_path / "a.bin", "object_id")[:, 3], found)


def user_data(stream: Path) -> dict:
    """What docs/formats.md says of it, read by the standard library alone: units of a byte and a length, JSON."""
    data, at = stream.read_bytes(), 0
    while at < len(data):
        kind, size = data[at], int.from_bytes(data[at + 1 : at + 5], "big")
        payload, at = data[at + 5 : at + 5 + size], at + 5 + size
        if kind == 9 and payload[:8] == b"ggslam-2":
            return dict(json.loads(zlib.decompress(payload[8:])))
    raise AssertionError("no user data")


@pytest.mark.parametrize("planes", [False, True])
@pytest.mark.parametrize(("qp", "slices"), [(1, 1), (8, 3), (13, 1), (29, 2), (50, 1)])
def test_quantised_positions_decode_there(
    tmc3: str, tmp_path: Path, surface: tuple[np.ndarray, np.ndarray], qp: int, slices: int, planes: bool
) -> None:
    settings = CodecSettings(geometry_qp=qp, slices=slices, planes=planes, qp=28)
    (tmp_path / "a.bin").write_bytes(encode_cloud(surface[0], {"color": surface[1]}, settings).data)
    assert np.array_equal(reference_decodes(tmc3, tmp_path / "a.bin"), our_rows(tmp_path / "a.bin", "color"))


@pytest.mark.parametrize("planes", [0, 1])
@pytest.mark.parametrize("direct", [0, 1])
@pytest.mark.parametrize("method", [0, 1, 2])
@pytest.mark.parametrize(("qp", "node"), [(3, 4), (12, 6), (17, 8)])
def test_their_quantised_positions_decode_here(
    tmc3: str, tmp_path: Path, surface: tuple[np.ndarray, np.ndarray], qp: int, node: int, method: int, direct: int,
    planes: int,
) -> None:  # fmt: skip
    """One quantiser, random ones and those by density, told by nodes of 16 to 256 voxels a side."""
    write_point_cloud(tmp_path / "a.ply", surface[0].astype(np.float32), {"color": surface[1]})
    run(tmc3, "--mode=0", f"--uncompressedDataPath={tmp_path / 'a.ply'}", *TOOLS, "--neighbourAvailBoundaryLog2=8",
        f"--inferredDirectCodingMode={direct}", f"--qtbtEnabled={planes}", f"--planarEnabled={planes}",
        "--positionQuantisationEnabled=1", f"--positionBaseQp={qp}", f"--positionIdcmQp={qp}",
        f"--positionQuantisationOctreeSizeLog2={node}", f"--positionQuantisationMethod={method}",
        f"--compressedStreamPath={tmp_path / 'b.bin'}", f"--reconstructedDataPath={tmp_path / 'theirs.ply'}",
        "--outputBinaryPly=1", "--convertPlyColourspace=1", "--colourMatrix=1", "--qp=22", "--bitdepth=8",
        "--attribute=color")  # fmt: skip
    assert np.array_equal(sorted_rows(tmp_path / "theirs.ply"), our_rows(tmp_path / "b.bin", "color"))


@pytest.mark.parametrize("high", [200, 4000, 60000])
def test_reflectance_arrives_there(tmc3: str, tmp_path: Path, voxels: VoxelCloud, high: int) -> None:
    values = (np.arange(len(voxels.grid)) % 97 * high // 97).astype(np.uint16)
    write_point_cloud(tmp_path / "a.ply", voxels.grid.astype(np.float32), {"reflectance": values, "label": values // 9})
    encode_file(tmp_path / "a.ply", tmp_path / "a.bin", CodecSettings(qp=10, slices=2))
    ours = our_rows(tmp_path / "a.bin", "reflectance")
    assert np.array_equal(reference_decodes(tmc3, tmp_path / "a.bin"), ours)
    error = np.abs(np.sort(ours[:, 3]) - np.sort(values)).max()
    assert error < 8 + high / 1000  # the transform's factors have 15 bits


def test_sparse_and_dense_slices_share_their_tools(tmc3: str, tmp_path: Path) -> None:
    rng = np.random.default_rng(0)
    dense = np.stack(np.meshgrid(*[np.arange(20)] * 3, indexing="ij"), -1).reshape(-1, 3)
    points = np.concatenate([dense, [500, 0, 0] + rng.integers(0, 400, (8000, 3))])
    colors = rng.integers(0, 256, points.shape).astype(np.uint8)
    for duplicates in ("merge", "keep"):
        settings = CodecSettings(slices=4, split="interval", duplicates=duplicates, qp=22)
        (tmp_path / "a.bin").write_bytes(encode_cloud(points, {"color": colors}, settings).data)
        assert np.array_equal(reference_decodes(tmc3, tmp_path / "a.bin"), our_rows(tmp_path / "a.bin", "color"))


@pytest.mark.parametrize("name", ["points.ply", "points_grid.ply"])
def test_clouds_of_a_run_are_read_there(tmc3: str, tmp_path: Path, voxels: VoxelCloud, name: str) -> None:
    """And what the reference encoder makes of them decodes here exactly."""
    write_points(tmp_path, voxels)
    scale = "--inputScale=50" if name == "points.ply" else "--inputScale=1"
    run(tmc3, "--mode=0", f"--uncompressedDataPath={tmp_path / name}", f"--compressedStreamPath={tmp_path / 'b.bin'}",
        f"--reconstructedDataPath={tmp_path / 'theirs.ply'}", "--outputBinaryPly=1", *TOOLS, scale,
        "--neighbourAvailBoundaryLog2=8", "--inferredDirectCodingMode=0", "--qtbtEnabled=0", "--planarEnabled=0",
        "--convertPlyColourspace=1", "--colourMatrix=1", "--qp=22", "--bitdepth=8", "--attribute=color")  # fmt: skip
    theirs = sorted_rows(tmp_path / "theirs.ply")
    assert len(theirs) > len(voxels.grid) / 2  # metres are cut off to whole numbers there: neighbours may fall together
    if name == "points_grid.ply":
        assert len(theirs) == len(voxels.grid)
        assert np.array_equal(theirs, our_rows(tmp_path / "b.bin", "color"))


@pytest.fixture
def metres(voxels: VoxelCloud) -> np.ndarray:
    """Points float32 [N, 3] off the grid, on both sides of 0."""
    jitter = np.random.default_rng(5).uniform(-0.5, 0.5, voxels.grid.shape)
    return ((voxels.grid - 60 + jitter) * 0.02).astype(np.float32)


def far_off(points: np.ndarray, path: Path) -> tuple[float, float, int]:
    """Farthest along an axis, and the mean offset, of the points of a file from those nearest to `points`; how many
    there are."""
    found = read_point_cloud(path).points
    _, nearest = cKDTree(found).query(points)
    off = found[nearest] - points
    return float(np.abs(off).max()), float(np.abs(off.mean(0)).max()), len(found)


@pytest.mark.parametrize("on_grid", [True, False])
def test_metric_clouds_lie_there_where_they_were(
    tmc3: str, tmp_path: Path, metres: np.ndarray, on_grid: bool
) -> None:
    points = (np.rint(metres / 0.02) * 0.02).astype(np.float32) if on_grid else metres
    write_point_cloud(tmp_path / "a.ply", points, {"color": np.zeros(points.shape, np.uint8)})
    encode_file(tmp_path / "a.ply", tmp_path / "a.bin", CodecSettings(voxel_size=0.02))
    decode_file(tmp_path / "a.bin", tmp_path / "ours.ply")
    reference_decodes(tmc3, tmp_path / "a.bin", 0.02)
    for name in ("a.theirs.ply", "ours.ply"):
        most, mean, count = far_off(points, tmp_path / name)
        assert most < (1e-5 if on_grid else 0.01 * 1.003) and mean < (1e-6 if on_grid else 2e-4)
        assert count == len(np.unique(np.floor(points / 0.02 + 0.501), axis=0))


@pytest.mark.parametrize("on_grid", [True, False])
def test_their_metric_streams_lie_here_where_they_were(
    tmc3: str, tmp_path: Path, metres: np.ndarray, on_grid: bool
) -> None:
    """By the options of docs/compress.md: read in steps of 0.01 mm (cut off), coded in voxels of 2 cm (rounded)."""
    points = (np.rint(metres / 0.02) * 0.02).astype(np.float32) if on_grid else metres
    write_point_cloud(tmp_path / "a.ply", points, {"color": np.zeros(points.shape, np.uint8)})
    run(tmc3, "--mode=0", f"--uncompressedDataPath={tmp_path / 'a.ply'}", "--inputScale=100000", "--srcUnit=1",
        f"--compressedStreamPath={tmp_path / 'b.bin'}", "--positionQuantizationScale=0.0005",
        "--trisoupNodeSizeLog2=0", "--mergeDuplicatedPoints=1", "--transformType=0", "--convertPlyColourspace=1",
        "--colourMatrix=1", "--qp=22", "--bitdepth=8", "--attribute=color")  # fmt: skip
    decode_file(tmp_path / "b.bin", tmp_path / "ours.ply")
    reference_decodes(tmc3, tmp_path / "b.bin", 0.02)
    for name in ("b.theirs.ply", "ours.ply"):
        most, mean, _ = far_off(points, tmp_path / name)
        assert most < (2e-5 if on_grid else 0.01 * 1.003) and mean < (2e-5 if on_grid else 2e-4)


def test_what_we_decode_is_read_there(tmc3: str, tmp_path: Path, voxels: VoxelCloud) -> None:
    write_points(tmp_path, voxels)
    for source in ("points.ply", "points_grid.ply"):
        encode_file(tmp_path / source, tmp_path / "a.bin", CodecSettings(qp=22))
        decode_file(tmp_path / "a.bin", tmp_path / "decoded.ply")
        run(tmc3, "--mode=0", f"--uncompressedDataPath={tmp_path / 'decoded.ply'}", *TOOLS,
            f"--compressedStreamPath={tmp_path / 'b.bin'}", "--inputScale=50", "--qp=22", "--bitdepth=8",
            "--attribute=color")  # fmt: skip
        assert (tmp_path / "b.bin").stat().st_size > 1000
