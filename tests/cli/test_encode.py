# SPDX-License-Identifier: Apache-2.0
"""Clouds, runs and maps go through `ggslam encode`, `inspect` and `decode`; mistakes get one clear line."""

from __future__ import annotations

import json
import shutil
import sys
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
import torch

from ggslam.cli.main import main
from ggslam.coding import CodecSettings, decode_cloud
from ggslam.coding.listing import list_units
from ggslam.formats.gaussian_ply import read_gaussian_ply, write_gaussian_ply
from ggslam.formats.point_cloud import read_point_cloud, write_point_cloud
from ggslam.formats.point_ply import read_points, write_points
from ggslam.formats.point_sampling import VoxelCloud
from ggslam.jobs.encode.coding import study_cloud
from ggslam.runs.folder import RunFolder
from ggslam.scene.gaussian_map import GaussianMap

Ggslam = Callable[..., tuple[int, str, str]]


@pytest.fixture
def ggslam(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> Ggslam:
    """Runs a command in this process: exit code, output, errors."""

    def run(*words: object) -> tuple[int, str, str]:
        monkeypatch.setattr(sys, "argv", ["ggslam", *(str(word) for word in words)])
        try:
            main()
            code = 0
        except SystemExit as end:
            code = int(end.code or 0)
        out, err = capsys.readouterr()
        return code, " ".join(out.split()), " ".join(err.split())

    return run


def voxel_cloud(side: int = 40) -> VoxelCloud:
    """A wavy sheet of four objects, sorted as voxel clouds are."""
    x, y = (v.reshape(-1) for v in np.meshgrid(np.arange(side), np.arange(side), indexing="ij"))
    z = np.rint(5 + 5 * np.sin(x / 5) * np.cos(y / 6)).astype(int)
    z -= z.min()  # grids of runs begin at their lowest points
    colors = np.stack([100 + 90 * np.sin(x / 6), 120 + 80 * np.cos(y / 9), 10 * z], 1).clip(0, 255).astype(np.uint8)
    ids = (7 * (x > side // 2) + 300 * (y > side // 2)).astype(np.int32)
    return VoxelCloud(np.stack([x, y, z], 1).astype(np.int32), colors, ids, 0.02, np.array([-0.4, 1.2, 0.06]))


def by_grid(cloud: VoxelCloud) -> np.ndarray:
    """Grid and id rows, sorted."""
    assert cloud.object_id is not None
    rows = np.column_stack([cloud.grid, cloud.object_id])
    return rows[np.lexsort(rows.T[::-1])]


@pytest.mark.parametrize("options", [[], ["--slices", 4], ["--slices", 4, "--split", "interval", "--threads", 1],
                                     ["--slices", 6, "--split", "octree"]])  # fmt: skip
def test_voxel_clouds_come_back_with_their_grid_and_ids(ggslam: Ggslam, tmp_path: Path, options: list[object]) -> None:
    cloud = voxel_cloud()
    write_points(tmp_path, cloud)
    code, out, err = ggslam("encode", tmp_path / "points.ply", tmp_path / "a.bin", "--qp", 4, *options)
    assert code == 0 and "object_id" in out and "1600 points" in out, err
    code, out, err = ggslam("decode", tmp_path / "a.bin", tmp_path / "back.ply")
    assert code == 0 and "1600 points" in out, err
    back = read_points(tmp_path / "back.ply")
    np.testing.assert_array_equal(by_grid(back), by_grid(cloud))
    np.testing.assert_allclose(back.points.min(0), cloud.points.min(0), atol=1e-9)
    order = np.lexsort(back.grid.T[::-1])
    assert np.abs(back.colors[order].astype(int) - cloud.colors).max() < 8
    listing = list_units((tmp_path / "a.bin").read_bytes())
    assert listing.points == 1600 and (listing.slices >= 4 if options else listing.slices == 1)


def test_parts_of_a_stream(ggslam: Ggslam, tmp_path: Path) -> None:
    cloud = voxel_cloud()
    write_points(tmp_path, cloud)
    assert ggslam("encode", tmp_path / "points.ply", tmp_path / "a.bin", "--slices", 4)[0] == 0
    parts = []
    for number in range(4):
        code, _, err = ggslam("decode", tmp_path / "a.bin", tmp_path / "part.ply", "--slice", number)
        assert code == 0, err
        parts.append(by_grid(read_points(tmp_path / "part.ply")))
    rows = np.concatenate(parts)
    np.testing.assert_array_equal(rows[np.lexsort(rows.T[::-1])], by_grid(cloud))
    low, high = np.array([-0.2, 1.3, 0.06]), np.array([0.1, 1.5, 0.2])  # corners on the grid belong to the box
    box = " ".join(f"{v:g}" for v in [*low, *high])
    code, _, err = ggslam("decode", tmp_path / "a.bin", tmp_path / "box.ply", "--box", box)
    assert code == 0, err
    inside = ((cloud.points > low - 1e-9) & (cloud.points < high + 1e-9)).all(1)
    found = by_grid(read_points(tmp_path / "box.ply"))
    assert 20 < inside.sum() < 1500
    np.testing.assert_array_equal(found, np.column_stack([cloud.grid, cloud.object_id])[inside])


def test_coarser_geometry_and_clouds_in_metres(ggslam: Ggslam, tmp_path: Path) -> None:
    cloud = voxel_cloud()
    write_points(tmp_path, cloud)
    assert ggslam("encode", tmp_path / "points.ply", tmp_path / "a.bin", "--geometry-scale", 0.5)[0] == 0
    assert ggslam("decode", tmp_path / "a.bin", tmp_path / "half.ply")[0] == 0
    half = read_point_cloud(tmp_path / "half.ply")
    assert 300 < len(half) < 800 and half.voxel_size == 0.04
    distance = np.abs(cloud.points[:, None] - half.points[None]).max(2).min(1)
    assert distance.max() < 0.0201  # half of a voxel of 4 cm
    scattered = np.random.default_rng(0).random((500, 3)) * 3
    attributes = {"color": np.full((500, 3), 90, np.uint8), "label": np.arange(500) - 200}
    write_point_cloud(tmp_path / "scan.pcd", scattered, attributes)
    code, out, err = ggslam("encode", tmp_path / "scan.pcd", tmp_path / "b.bin", "--voxel", 0.01)
    assert code == 0, err
    assert ggslam("decode", tmp_path / "b.bin", tmp_path / "back.pcd")[0] == 0
    back = read_point_cloud(tmp_path / "back.pcd")
    first = np.argsort(back.labels["label"])
    assert back.labels["label"][first].tolist() == list(range(-200, 300))
    assert np.abs(back.points[first] - scattered).max() < 0.00501


def test_whole_gaussians_come_back_as_a_map(ggslam: Ggslam, tmp_path: Path) -> None:
    generator = torch.Generator().manual_seed(0)
    gaussians = GaussianMap(1)
    rows = gaussians.insert(
        torch.rand(400, 3, generator=generator), torch.randn(400, 4, generator=generator),
        torch.rand(400, 3, generator=generator) * 3 - 6, torch.randn(400, generator=generator) * 2,
        torch.rand(400, 3, generator=generator), object_id=torch.randint(0, 5, (400,), generator=generator),
    )  # fmt: skip
    gaussians.sh[rows, 1:] = torch.randn(400, 3, 3, generator=generator) * 0.1
    write_gaussian_ply(tmp_path / "map.ply", gaussians, ("object_id",))
    errors = []
    for rate in ("r01", "r04"):
        code, out, err = ggslam("encode", tmp_path / "map.ply", tmp_path / "m.bin", "--preset", "splat", "--rate", rate)
        assert code == 0 and "rotation_w" in out and "sh_3" in out, err
        code, out, err = ggslam("decode", tmp_path / "m.bin", tmp_path / "back.ply")
        assert code == 0 and "400 Gaussians" in out, err
        back = read_gaussian_ply(tmp_path / "back.ply")
        distance = (gaussians.means[:, None] - back.means[None]).norm(dim=2)
        nearest = distance.argmin(1)
        voxel = {"r01": 1 / 8, "r04": 1 / 64}[rate] * float(gaussians.log_scales.median(1).values.median().exp())
        assert distance.min(1).values.max() < 3**0.5 * 0.51 * voxel and len(nearest.unique()) == 400
        assert (back.object_id[nearest] == gaussians.object_id).all()
        errors.append((back.sh[nearest] - gaussians.sh).abs().mean().item())
        if rate == "r04":
            scales = [m.sort(1).values for m in (back.log_scales[nearest], gaussians.log_scales)]  # axes are renamed
            assert (scales[0] - scales[1]).abs().max() < 0.1
    assert errors[1] < 0.02 < errors[0] < 1


def test_inspect_lists_every_unit(ggslam: Ggslam, tmp_path: Path) -> None:
    write_points(tmp_path, voxel_cloud())
    assert ggslam("encode", tmp_path / "points.ply", tmp_path / "a.bin", "--slices", 3, "--qp", 28)[0] == 0
    code, out, _ = ggslam("inspect", tmp_path / "a.bin")
    assert code == 0
    for words in ("sequence parameters", "geometry parameters", "QP 28", "color: 3 x 8 bits", "slices: 3", "slice 2:"):
        assert words in out, words
    data = (tmp_path / "a.bin").read_bytes()
    listing = list_units(data)
    assert sum(unit.size for unit in listing.units) == sum(listing.parts.values()) == len(data)
    assert set(listing.parts) == {"headers", "geometry", "color", "object_id"} and not listing.problems
    (tmp_path / "cut.bin").write_bytes(data[:-5])
    code, out, _ = ggslam("inspect", tmp_path / "cut.bin")
    assert code == 0 and "damaged or not supported" in out


def test_streams_of_others_are_listed(shared_data: Path) -> None:
    folder = shared_data.parent / "gpcc" / "golden"
    if not folder.is_dir():
        pytest.skip(f"no {folder}")
    listing = list_units((folder / "slices_qp22.bin").read_bytes())
    assert listing.slices == 4 and listing.points == 65_819 and not listing.problems
    assert sum(listing.parts.values()) == 12_218


def test_a_sweep_writes_a_study(ggslam: Ggslam, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("ggslam.coding.study.sweep_steps.__defaults__", ((10, 40), (0.5, 1.0), (8,)))
    write_points(tmp_path, voxel_cloud())
    code, out, err = ggslam("encode", tmp_path / "points.ply", tmp_path / "study", "--sweep", "all", "--no-plots")
    assert code == 0 and "QP 40" in out and "scale 0.5" in out and "geometry QP 8" in out, err
    record = json.loads((tmp_path / "study" / "study.json").read_text())
    assert [row["sweep"] for row in record["rows"]] == ["qp"] * 2 + ["geometry"] * 2 + ["geometry_qp"]
    assert record["points"] == 1600 and record["voxels_per_unit"] == pytest.approx(50)
    assert (tmp_path / "study" / "clouds_qp.png").is_file()
    for sweep, kinds in (("both", {"qp", "geometry"}), ("geometry-qp", {"geometry_qp"})):
        assert ggslam("encode", tmp_path / "points.ply", tmp_path / sweep, "--sweep", sweep, "--no-plots")[0] == 0
        assert {row["sweep"] for row in json.loads((tmp_path / sweep / "study.json").read_text())["rows"]} == kinds


def test_the_cloud_s_own_voxel_size_loses_nothing(ggslam: Ggslam, tmp_path: Path) -> None:
    cloud = voxel_cloud()
    write_points(tmp_path, cloud)
    code, _, err = ggslam("encode", tmp_path / "points.ply", tmp_path / "a.bin", "--voxel", cloud.voxel_size)
    assert code == 0, err
    decoded = decode_cloud((tmp_path / "a.bin").read_bytes())
    assert len(decoded) == len(cloud.grid)
    np.testing.assert_allclose(decoded.points.min(0), cloud.points.min(0), atol=1e-9)  # metres, without the command
    for named in (None, cloud.voxel_size):
        study = study_cloud(tmp_path / "points.ply", CodecSettings(voxel_size=named))
        np.testing.assert_array_equal(study.grid.max(0), np.ptp(cloud.grid, axis=0))


def test_outputs_that_make_no_sense_are_refused(ggslam: Ggslam, tmp_path: Path) -> None:
    write_points(tmp_path, voxel_cloud())
    points, stream = tmp_path / "points.ply", tmp_path / "a.bin"
    before = points.read_bytes()
    for words in (("encode", points, points), ("decode", stream, stream), ("decode", stream, tmp_path / "o.txt")):
        ggslam("encode", points, stream)
        code, _, err = ggslam(*words)
        assert code == 2 and words[-1].name in err  # type: ignore[union-attr]
    assert points.read_bytes() == before


def test_only_coded_files_are_replaced(ggslam: Ggslam, room_run: RunFolder, tmp_path: Path) -> None:
    write_points(tmp_path, voxel_cloud())
    points, run = tmp_path / "points.ply", tmp_path / "run"
    shutil.copytree(room_run.path, run)
    (tmp_path / "mine.bin").write_bytes(b"mine")
    before = {path: path.read_bytes() for path in (*run.iterdir(), *tmp_path.iterdir()) if path.is_file()}
    for out, more, reason in (
        (run / "points.ply", (), "input itself"), (run / "map.ply", (), "folder of a run"),
        (run / "new.ggz", (), "folder of a run"),
        (tmp_path / "mine.bin", (), "no coded file of this kind"), (points, ("--preset", "splat"), "no coded file"),
        (Path("/dev/null"), (), "no coded file"), (Path("/proc/x.bin"), (), "cannot be written"),
    ):  # fmt: skip
        code, _, err = ggslam("encode", run, out, *more)
        assert code == 2 and reason in err, (out, err)
    assert all(path.read_bytes() == held for path, held in before.items())
    for name in ("a.bin", "a.ggz"):
        for _ in range(2):
            assert ggslam("encode", run, tmp_path / name)[0] == 0
    code, _, err = ggslam("encode", run, tmp_path / "a.bin", "--preset", "splat")
    assert code == 0, err


def test_mistakes_are_named(ggslam: Ggslam, tmp_path: Path) -> None:
    write_points(tmp_path, voxel_cloud())
    points, stream = tmp_path / "points.ply", tmp_path / "a.bin"
    assert ggslam("encode", points, stream)[0] == 0
    (tmp_path / "noise.bin").write_bytes(b"\x07" * 50)
    plain = tmp_path / "plain.ply"
    write_point_cloud(plain, np.random.default_rng(0).random((9, 3)), {})
    for words, expected in (
        (("encode", tmp_path / "none.ply", stream), "none.ply"),
        (("encode", stream, tmp_path / "b.bin"), "may be a coded cloud"),
        (("encode", tmp_path, tmp_path / "b.bin"), "no run.json"),
        (("encode", points, tmp_path / "b.bin", "--preset", "splat"), "no Gaussians"),
        (("encode", points, tmp_path / "b.bin", "--voxel", "1e-8"), "voxels"),
        (("encode", points, tmp_path / "b.bin", "--sweep", "qp", "--preset", "splat"), "--sweep"),
        (("encode", points, tmp_path / "b.bin", "--qp", "22", "--preset", "splat"), "--qp goes with"),
        (("encode", points, tmp_path / "b.bin", "--rate", "r01"), "--rate goes with"),
        (("encode", points, tmp_path / "b.bin", "--geometry-qp", 8, "--preset", "splat"), "--geometry-qp goes with"),
        (("encode", points, tmp_path / "b.ggz", "--geometry-qp", 8), "--geometry-qp goes with"),
        (("encode", points, tmp_path / "b.ggc", "--geometry-qp", 8), "--geometry-qp goes with"),
        (("encode", points, tmp_path / "b.bin", "--sweep", "both", "--geometry-scale", "0.5"), "--sweep varies"),
        (("encode", points, tmp_path / "b.bin", "--no-plots"), "--plots goes with"),
        (("encode", plain, tmp_path / "study", "--sweep", "qp", "--no-plots"), "no colours"),
        (("decode", tmp_path / "none.bin", tmp_path / "b.ply"), "none.bin"),
        (("decode", points, tmp_path / "b.ply"), "points.ply"),
        (("decode", tmp_path / "noise.bin", tmp_path / "b.ply"), "noise.bin"),
        (("decode", stream, tmp_path / "b.ply", "--slice", 9), "no slice 9"),
        (("decode", stream, tmp_path / "b.ply", "--box", "0 0 0 1 1"), "x0 y0 z0"),
        (("decode", stream, tmp_path / "b.ply", "--box", "50 50 50 60 60 60"), "no points in the box"),
        (("decode", stream, tmp_path / "b.ply", "--box", "0 0 0 1 1 1", "--slice", 0), "not both"),
        (("inspect", points), "is a point cloud"),
        (("inspect", tmp_path / "none.bin"), "file is missing"),
    ):
        code, _, err = ggslam(*words)
        assert code == 2 and expected in err, (words, err)
    assert not (tmp_path / "b.bin").exists() and not (tmp_path / "b.ply").exists()


def test_what_is_left_out_is_said(ggslam: Ggslam, tmp_path: Path) -> None:
    write_point_cloud(tmp_path / "a.pcd", np.array([[0.0, 1, 2], [np.nan, 0, 0], [3, 4, 5]]), {})
    assert "left out 1 of 3 points" in ggslam("encode", tmp_path / "a.pcd", tmp_path / "a.bin")[1]
    gaussians = GaussianMap()
    means, quaternions = torch.rand(20, 3), torch.tensor([[1.0, 0, 0, 0]]).repeat(20, 1)
    gaussians.insert(means, quaternions, torch.full((20, 3), -3.0), torch.zeros(20), torch.rand(20, 3))
    write_gaussian_ply(tmp_path / "map.ply", gaussians)
    assert "--preset splat" in ggslam("encode", tmp_path / "map.ply", tmp_path / "b.bin")[1]


def test_ctrl_c_is_said(ggslam: Ggslam, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def interrupted(*_: object) -> None:
        raise KeyboardInterrupt

    monkeypatch.setattr("ggslam.jobs.encode.coding.encode_file", interrupted)
    code, _, err = ggslam("encode", tmp_path / "a.ply", tmp_path / "a.bin")
    assert code == 130 and err == "interrupted"


@pytest.mark.parametrize("command", ["encode", "decode", "inspect"])
def test_help_has_an_example(ggslam: Ggslam, command: str) -> None:
    code, out, _ = ggslam(command, "--help")
    assert code == 0 and "Examples" in out and f"ggslam {command}" in out
