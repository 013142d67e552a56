# SPDX-License-Identifier: Apache-2.0
"""`ggslam submaps` and `ggslam localize` with scans of a LiDAR: what suits it, what is set, what is warned of."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from typer.testing import CliRunner
from worlds.scanner import Scanner
from worlds.world import World

from ggslam.cli.main import app
from ggslam.driving.body_options import read_body
from ggslam.errors import GgslamError
from ggslam.formats.trajectory import read_tum, write_tum
from ggslam.jobs.submaps.sensor_settings import settings_of_cloud, settings_of_scans, with_chosen
from ggslam.jobs.submaps.stores import INDOORS
from ggslam.localization.scans import ScanSequence
from ggslam.scene.poses import se3_exp
from ggslam.submaps.grid import GridStore
from ggslam.submaps.recorder import load_points


def done(*arguments: object) -> str:
    result = CliRunner().invoke(app, [str(argument) for argument in arguments], env={"COLUMNS": "140"})
    assert result.exit_code == 0 and result.exception is None, (result.output, result.exception)
    return " ".join(result.output.split())


def summary(out: Path) -> dict:
    return json.loads((out / "localization.json").read_text())["summary"]


@pytest.fixture(scope="module")
def ride(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Scans along 8 m of a street of boxes, seen up to 60 m."""
    folder = tmp_path_factory.mktemp("rides") / "street"
    (folder / "scans").mkdir(parents=True)
    generator = np.random.default_rng(2)
    boxes = []
    while len(boxes) < 90:
        x, y = generator.uniform(2, 98), 50 + generator.choice([-1, 1]) * generator.uniform(3.5, 25)
        half, height = generator.uniform(0.2, 2.5, 2), generator.uniform(1.0, 7.0)
        if abs(y - 50) > 2 + half.max() * 1.5:
            boxes.append([x, y, height / 2, *half, height / 2, generator.uniform(0, np.pi)])
    world = World(100.0, 30.0, 2, np.array(boxes), np.zeros((0, 2)), np.zeros((0, 2), np.int64))
    scanner = Scanner(columns=900, rings=32, lowest_deg=-20, highest_deg=10, farthest=60.0, noise=0.01)
    poses = np.array([se3_exp(np.array([0, 0, 0, 0, 0, 0.02 * n])) for n in range(9)])
    poses[:, :3, 3] = [[46.0 + n, 50.0, 1.7] for n in range(9)]
    for number, T in enumerate(poses):
        np.save(folder / "scans" / f"{number:06d}.npy", scanner.scan(world, T, number).points)
    write_tum(folder / "trajectory.txt", np.arange(9) / 10, poses)
    return folder


def errors(out: Path, ride: Path) -> np.ndarray:
    found, truth = (read_tum(folder / "trajectory.txt").T_world_camera for folder in (out, ride))
    return np.linalg.norm(found[:, :3, 3] - truth[: len(found), :3, 3], axis=1)


def test_a_store_by_defaults_suits_the_scanner_and_locates_its_scans(ride: Path, tmp_path: Path) -> None:
    ranges = np.concatenate([np.linalg.norm(scan.points, axis=1) for scan in ScanSequence(ride).stream()])
    output = done("submaps", ride, "--out", tmp_path / "street.grid")
    with GridStore.open(tmp_path / "street.grid") as store:
        settings = store.settings
    assert np.percentile(ranges, 95) < settings.partial_radius < 1.2 * np.percentile(ranges, 95) + 5
    assert settings.sensor_range >= np.percentile(ranges, 99) and settings.spacing > 5 and settings.voxel > 0.05
    assert output.count("suit the scanner") == 1 and f"R' {settings.partial_radius:g} m" in output
    output = done("localize", tmp_path / "street.grid", ride, "--start-pose", "given", "--out", tmp_path / "out")
    assert summary(tmp_path / "out")["located_share"] == 1 and errors(tmp_path / "out", ride).max() < 0.02
    assert "suit the scanner" not in output  # the store keeps its own
    assert settings_of_scans(ScanSequence(ride), cut=True).spacing < settings.spacing


def test_a_scanner_that_sees_few_metres_is_recorded_wherever_it_walks(tmp_path: Path) -> None:
    """1.3 m above the ground, 1 m beside the centres of cells: far from all of them by R 1."""
    ride = tmp_path / "yard"
    (ride / "scans").mkdir(parents=True)
    rng = np.random.default_rng(5)
    boxes = []
    while len(boxes) < 60:
        x, y = rng.uniform(-14, 26), rng.uniform(-12, 12)
        half, height = rng.uniform(0.15, 0.8, 2), rng.uniform(0.7, 2.5)
        if abs(y - 1) > 1.2 + half.max():
            boxes.append([x, y, height / 2, *half, height / 2, rng.uniform(0, np.pi)])
    world = World(100.0, 30.0, 2, np.array(boxes), np.zeros((0, 2)), np.zeros((0, 2), np.int64))
    scanner = Scanner(columns=450, rings=16, lowest_deg=-25, highest_deg=5, farthest=9.0, noise=0.01)
    poses = np.array([se3_exp(np.array([0, 0, 0, 0, 0, 0.03 * n])) for n in range(25)])
    poses[:, :3, 3] = [[0.5 * n, 1.0, 1.3] for n in range(25)]
    for number, T in enumerate(poses):
        np.save(ride / "scans" / f"{number:06d}.npy", scanner.scan(world, T, number).points)
    write_tum(ride / "trajectory.txt", np.arange(25) / 10, poses)
    output = done("submaps", ride, "--out", tmp_path / "yard.grid")
    assert "that nothing was recorded of" not in output and "7 cells written" in output
    done("localize", tmp_path / "yard.grid", ride, "--start-pose", "given", "--out", tmp_path / "out")
    assert summary(tmp_path / "out")["located_share"] == 1 and errors(tmp_path / "out", ride).max() < 0.03
    output = done("submaps", ride, "--out", tmp_path / "few.grid", "--radius", 1)
    assert "25 of 25 poses lie in cells that nothing was recorded of" in output and "submaps.radius=1.74" in output


@pytest.mark.long("locates a ride three times")
def test_what_is_set_wins_and_a_map_that_is_too_small_is_warned_of(ride: Path, tmp_path: Path) -> None:
    seed = ["--spacing", 2, "--radius", 1.5, "--sensor-range", 10, "--voxel", 0.05]
    done("submaps", ride, "--out", tmp_path / "small.grid", *seed, "--set", "submaps.partial_radius=10")
    with GridStore.open(tmp_path / "small.grid") as store:
        s = store.settings
    assert (s.spacing, s.radius, s.sensor_range, s.voxel, s.partial_radius) == (2, 1.5, 10, 0.05, 10)
    output = done("localize", tmp_path / "small.grid", ride, "--start-pose", "given", "--out", tmp_path / "out")
    found = summary(tmp_path / "out")
    assert found["located_share"] == 1 and errors(tmp_path / "out", ride).max() < 0.03
    assert found["beyond_map_median"] > 0.5 and "beyond the map in memory (R' 10 m)" in found["warnings"][0]
    assert "lie beyond the map in memory" in output
    strict = [word for one in ("scans.min_overlap=0.9", "scans.min_counted=1000000") for word in ("--set", one)]
    strict += ["--out", tmp_path / "strict"]
    done("localize", tmp_path / "small.grid", ride, "--start-pose", "given", *strict)
    frames = json.loads((tmp_path / "strict" / "localization.json").read_text())["frames"]
    assert {frame["status"] for frame in frames} <= {"found", "lost"}  # what tracking loses is looked up
    found = [frame["overlap"] for frame in frames if frame["status"] == "found"]
    assert found and min(found) >= 0.9


def test_settings_that_do_not_exist_are_one_error(ride: Path, tmp_path: Path) -> None:
    for words, text in ((["scans.reach=1"], "scans.reach"), (["scans.sigma=-1"], "scans.sigma"), (["x"], "name=value")):
        command = ["localize", tmp_path / "none.ply", ride, "--start-pose", "given", "--set", *words]
        error = CliRunner().invoke(app, [str(word) for word in command]).exception
        assert isinstance(error, GgslamError) and error.exit_code == 2 and text in str(error) and "--set" in str(error)
    command = ["submaps", str(ride), "--out", str(tmp_path / "g"), "--set", "scans.sigma=1"]
    error = CliRunner().invoke(app, command).exception
    assert isinstance(error, GgslamError) and "scans" in str(error)


def test_small_scenes_keep_their_settings(tmp_path: Path) -> None:
    rng = np.random.default_rng(0)
    (tmp_path / "near").mkdir()
    np.save(tmp_path / "near" / "0.npy", rng.uniform(-4, 4, (5000, 3)))
    near = settings_of_scans(ScanSequence(tmp_path / "near"))
    assert near == replace(INDOORS, radius=near.radius) and near.radius >= np.sqrt(3) / 2 * near.spacing
    assert with_chosen(near, {"spacing": 1.0}).radius == pytest.approx(0.9)
    assert settings_of_cloud(rng.uniform(-10, 10, (5000, 3))) == INDOORS
    assert settings_of_cloud(np.zeros((0, 3))) == INDOORS
    outdoors = settings_of_cloud(rng.uniform(-80, 80, (5000, 3)) * [1, 1, 0.05])
    assert outdoors.partial_radius == 30 and outdoors.spacing == 5
    assert with_chosen(outdoors, {"spacing": 3.0}).radius == pytest.approx(2.7)
    assert with_chosen(outdoors, {"spacing": 3.0, "radius": 1.0}).radius == 1.0


@pytest.mark.long("locates scans of a LiDAR")
def test_the_lidar_of_the_field_is_located(shared_data: Path, tmp_path: Path) -> None:
    """Raw scans of KITTI in a map of three of them: as near the given poses as against the whole map."""
    case = shared_data / "field" / "maps" / "lidar_radius"
    if not case.is_dir():
        pytest.skip(f"{case} is not there")
    for name, options in (("partial", []), ("full", ["--full-map"])):
        command = ["localize", case / "map.ply", case, "--columns", 3, "--start-pose", "given", *options]
        done(*command, "--out", tmp_path / name)
        assert summary(tmp_path / name)["statuses"] == {"ok": 2}
        assert errors(tmp_path / name, case).max() < 0.006
    turned = "1.4 -1.4 0 0 0 0.0871557 0.9961947"  # 2 m and 10 degrees off
    command = ["localize", case / "map.ply", case, "--columns", 3, "--start-pose", turned, "--out", tmp_path / "far"]
    done(*command)
    assert errors(tmp_path / "far", case).max() < 0.006


def test_the_robots_body_is_left_out_of_scans(ride: Path, tmp_path: Path) -> None:
    """A box behind the scanner, where it sees the street."""
    done("submaps", ride, "--out", tmp_path / "a.grid", "--voxel", 0, "--stop", 1)
    done("submaps", ride, "--out", tmp_path / "b.grid", "--voxel", 0, "--stop", 1, "--body", "-3,-0.5,-1.6,-1,0.5,1")
    counts = []
    for name in ("a.grid", "b.grid"):
        with GridStore.open(tmp_path / name) as store:
            counts.append(sum(len(load_points(store, key)["points"]) for key in store.cells()))
    scan = ScanSequence(ride, stop=1).scan(0).points
    body = read_body(["-3,-0.5,-1.6,-1,0.5,1"])
    assert body is not None and 0 < body.hides(scan).mean() < 0.3
    assert counts[1] / counts[0] == pytest.approx(1 - body.hides(scan).mean(), abs=0.1) and counts[1] < counts[0]
