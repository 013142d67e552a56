# SPDX-License-Identifier: Apache-2.0
"""Sweeps: sizes and qualities move the right way, tables and pictures hold what was measured."""

from __future__ import annotations

import csv
import json
from pathlib import Path

import cv2
import numpy as np
import pytest

from ggslam.coding import CodecSettings
from ggslam.coding.study import SWEEPS, GridCloud, on_grid, run_sweep, sweep_steps
from ggslam.errors import ConfigError
from ggslam.jobs.encode.study import write_study
from ggslam.system.energy import EnergyMeter


def surface(side: int = 64) -> tuple[np.ndarray, np.ndarray]:
    """A wavy, colourful sheet of side x side voxels, in metres at 1 cm."""
    x, y = (v.reshape(-1) for v in np.meshgrid(np.arange(side), np.arange(side)))
    z = np.rint(10 + 5 * np.sin(x / 9) * np.cos(y / 7))
    noise = np.random.default_rng(0).integers(-9, 9, (side * side, 3))
    colors = np.stack([120 + 80 * np.sin(x / 6), 100 + 70 * np.cos(y / 8), 90 + z], 1) + noise
    return (np.stack([x, y, z], 1) + 0.5) * 0.01, colors.clip(0, 255).astype(np.uint8)


@pytest.fixture(scope="module")
def cloud() -> GridCloud:
    return on_grid(*surface(), CodecSettings(voxel_size=0.01))


def test_the_grid_holds_one_point_per_voxel_with_the_mean_colour(cloud: GridCloud) -> None:
    assert len(cloud.grid) == 64 * 64 and cloud.grid.min() == 0 and cloud.peak == 63
    points = np.array([[-0.004, 0, 0], [0.004, 0, 0], [0.022, 0, 0]])
    colors = np.array([[10, 0, 9], [20, 0, 9], [200, 100, 0]], np.uint8)
    merged = on_grid(points, colors, CodecSettings(voxel_size=0.01))
    assert merged.grid.tolist() == [[0, 0, 0], [2, 0, 0]] and merged.colors.tolist() == [[15, 0, 9], [200, 100, 0]]
    np.testing.assert_allclose(merged.quantization.restore(merged.grid)[:, 0], [0, 0.02])


def test_sweeps_move_the_right_way(cloud: GridCloud) -> None:
    steps = sweep_steps(["qp", "geometry"], [4, 22, 40], [0.25, 0.5, 1.0])
    results = list(run_sweep(cloud, steps, CodecSettings(threads=1), EnergyMeter()))
    qp, geometry = [row for row, _ in results[:3]], [row for row, _ in results[3:]]
    assert [row.total_bytes for row in qp] == sorted((row.total_bytes for row in qp), reverse=True)
    assert [row.color.y for row in qp] == sorted((row.color.y for row in qp), reverse=True)
    assert qp[0].color.y > 48 > qp[1].color.y > 36 > qp[2].color.y > 25
    assert all(row.d1 == row.d2 == np.inf and row.decoded_points == len(cloud.grid) for row in qp)
    assert len({row.geometry_bytes for row in qp}) == 1
    assert geometry[0].decoded_points < geometry[1].decoded_points < geometry[2].decoded_points == len(cloud.grid)
    assert geometry[0].d1 < geometry[1].d1 < geometry[2].d1 == np.inf
    assert geometry[0].d1 < geometry[0].d2 and geometry[2].color.y > 55
    # Half the resolution moves every other coordinate by a voxel: a squared distance of 3 * 0.5 on average.
    assert geometry[1].d1 >= 10 * np.log10(3 * 63**2 / 1.5) - 0.1
    for row, decoded in results:
        assert row.encode_cpu_s > 0 and row.encode_s > 0 and row.decode_s > 0 and len(decoded) == row.decoded_points
        values = row.values()
        assert values["total_bpp"] == pytest.approx(8 * row.total_bytes / len(cloud.grid))
        assert row.geometry_bytes + row.color_bytes < row.total_bytes
    with pytest.raises(ConfigError, match="scale 1"):
        list(run_sweep(cloud, sweep_steps(["geometry"], scales=[2.0]), CodecSettings(), EnergyMeter()))


def test_the_quantiser_of_positions_is_swept_beside_the_scale(cloud: GridCloud) -> None:
    """Doubling the step halves the grid: points as far off, in about as many bytes; but those half-way between two
    steps go up or down by turns, while the scale rounds them up."""
    steps = sweep_steps(["geometry", "geometry_qp"], scales=[0.25, 0.5], geometry_qps=[16, 8, 3, 0])
    assert [step.words() for step in steps][1:3] == ["scale 0.5", "geometry QP 16"]
    rows = [row for row, _ in run_sweep(cloud, steps, CodecSettings(threads=1), EnergyMeter())]
    for scaled, quantised in ((rows[0], rows[2]), (rows[1], rows[3])):
        assert scaled.d1 == pytest.approx(quantised.d1)
        assert scaled.decoded_points == pytest.approx(quantised.decoded_points, rel=0.08)
        assert abs(scaled.geometry_bytes - quantised.geometry_bytes) < 16
    sizes, errors = ([getattr(row, name) for row in rows[2:]] for name in ("geometry_bytes", "d1"))
    assert sizes == sorted(sizes) and errors == sorted(errors) and errors[-1] == np.inf > errors[-2]


def test_tables_and_pictures(cloud: GridCloud, tmp_path: Path) -> None:
    steps, seen = sweep_steps(["qp", "geometry"], [10, 34], [0.5]), []
    settings = CodecSettings(slices=2, threads=1)
    study = write_study(cloud, steps, settings, tmp_path / "study", plots=False, progress=seen.append)
    assert study.rows == seen and len(seen) == 3 and all(path.is_file() for path in study.files)
    with (tmp_path / "study" / "study.csv").open() as file:
        table = list(csv.DictReader(file))
    assert [row["qp"] for row in table] == ["10", "34", "4"] and {row["slices"] for row in table} == {"2"}
    assert float(table[0]["psnr_y"]) == seen[0].color.y and table[0]["d1"] == "inf"
    record = json.loads((tmp_path / "study" / "study.json").read_text())
    assert record["rows"][0]["d1"] is None and record["rows"][2]["d1"] == pytest.approx(seen[2].d1)
    assert record["peak"] == 63 and record["rows"][0]["total_bytes"] == seen[0].total_bytes
    pictures = {name: cv2.imread(str(tmp_path / "study" / f"cloud_{name}.png")) for name in ("qp_10", "qp_34")}
    assert all((picture < 250).any(2).mean() > 0.1 for picture in pictures.values())
    assert (pictures["qp_10"] != pictures["qp_34"]).any()
    sheet = cv2.imread(str(tmp_path / "study" / "clouds_qp.png"))
    assert sheet.shape[1] == 3 * pictures["qp_10"].shape[1]  # the original beside both
    assert {path.name for path in tmp_path.joinpath("study").iterdir()} == {
        "study.csv", "study.json", "cloud_qp_10.png", "cloud_qp_34.png", "cloud_scale_0.5.png", "clouds_qp.png",
        "clouds_geometry.png",
    }  # fmt: skip


def test_plots(cloud: GridCloud, tmp_path: Path) -> None:
    steps = sweep_steps(SWEEPS, [10, 34], [0.5], [8, 16])
    study = write_study(cloud, steps, CodecSettings(threads=1), tmp_path)
    assert (tmp_path / "cloud_geometry_qp_08.png").is_file()
    names = {path.name for path in study.files}
    for name in ("rate_distortion_qp", "rate_distortion_geometry", "time_qp", "time_geometry",
                 "rate_distortion_geometry_qp", "time_geometry_qp"):  # fmt: skip
        assert {f"{name}.png", f"{name}.svg"} <= names
        picture = cv2.imread(str(tmp_path / f"{name}.png"))
        assert picture.std() > 5 and (tmp_path / f"{name}.svg").read_text().count("<path") >= 2
