# SPDX-License-Identifier: Apache-2.0
"""`ggslam localize` and `ggslam submaps` on a small run, a recording, laser scans and clouds."""

from __future__ import annotations

import hashlib
import json
import re
import shutil
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from typer.testing import CliRunner, Result
from worlds.cloud import cloud_tiles
from worlds.plan import make_world
from worlds.scanner import Scanner
from worlds.walk import walk

from ggslam.cli.main import app
from ggslam.errors import GgslamError
from ggslam.formats.trajectory import read_tum, write_tum
from ggslam.jobs.submaps.cell_gaussians import GAUSSIANS
from ggslam.runs.folder import RunFolder
from ggslam.submaps.grid import GridStore
from ggslam.submaps.recorder import load_points
from ggslam.volumes.occupancy import OccupancyMap
from ggslam.volumes.octomap_files import write_octomap

ORIGIN = "0 0 0 0 0 0 1"


def ggslam(*arguments: object) -> Result:
    """The command line within this process; an error of ours is in `exception`."""
    return CliRunner().invoke(app, [str(argument) for argument in arguments], env={"COLUMNS": "140"})


def done(*arguments: object) -> str:
    result = ggslam(*arguments)
    assert result.exit_code == 0 and result.exception is None, (result.output, result.exception)
    return " ".join(result.output.split())  # lines may break anywhere


def summary(out: Path) -> dict[str, Any]:
    return json.loads((out / "localization.json").read_text())["summary"]


def one_error(result: Result, *words: str) -> None:
    assert isinstance(result.exception, GgslamError) and result.exception.exit_code == 2, result
    assert all(word in str(result.exception) for word in words), str(result.exception)


@pytest.fixture(autouse=True)
def elsewhere(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Results go to the working folder where `--out` says nothing."""
    monkeypatch.chdir(tmp_path)


@pytest.fixture(scope="module")
def run(room: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    out = tmp_path_factory.mktemp("runs") / "room"
    done("run", room, "--out", out, "--stop", 12, "--iterations", 1, "--set", "masks.source=none", "--no-eval",
         "--set", "mapping.first_frame_iterations=2")  # fmt: skip
    return out


@pytest.fixture(scope="module")
def scans(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with the scans of a walk, their poses, and the cloud of the world around: cloud.npy beside it."""
    folder = tmp_path_factory.mktemp("scans") / "walk"
    (folder / "scans").mkdir(parents=True)
    world = make_world(30.0, seed=0)
    poses = walk(world, 2.0, seed=0)[:12]
    for number, T in enumerate(poses):
        np.save(folder / "scans" / f"{number:06d}.npy", Scanner(columns=450).scan(world, T, number).points)
    write_tum(folder / "trajectory.txt", np.arange(len(poses)) / 10, poses)
    points = np.concatenate([points for points, _ in cloud_tiles(world, 0.15)])
    near = np.linalg.norm(points[:, :2] - poses[0, :2, 3], axis=1) < 8
    np.save(folder.parent / "cloud.npy", points[near])
    return folder


def contents(folder: Path) -> dict[str, str]:
    return {
        str(path.relative_to(folder)): hashlib.sha256(path.read_bytes()).hexdigest() if path.is_file() else "folder"
        for path in sorted(folder.rglob("*"))
    }


def test_a_recording_is_located_in_a_run(run: Path, room: Path, tmp_path: Path) -> None:
    before = contents(run)
    output = done("localize", run, room, "--out", tmp_path / "out")
    found = summary(tmp_path / "out")
    assert found["located_share"] == 1 and found["frames"] == 24 and found["rmse_aligned_m"] < 0.01
    assert "cut into cells" in output and "frames located" in output and "100.0 % of 24" in output
    poses = read_tum(tmp_path / "out" / "trajectory.txt")
    own = read_tum(run / "trajectory.txt")  # the map's world is the run's
    apart = np.linalg.norm(poses.T_world_camera[:12, :3, 3] - own.T_world_camera[:, :3, 3], axis=1)
    assert len(poses) == 24 and apart.max() < 0.02
    (cells,) = tmp_path.glob("*.grid")
    with GridStore.open(cells) as store:
        cells = [store.cell(key) for key in store.cells()]
    gaussians = sum(c.parts[GAUSSIANS].count for c in cells if GAUSSIANS in c.parts)
    assert gaussians == len(RunFolder.open(run).gaussians())
    assert "cut into cells" not in done("localize", run, room, "--stop", 2, "--out", tmp_path / "again")
    full = ["--full-map", "--start-pose", ORIGIN, "--stop", 6]
    done("localize", run, room, *full, "--out", tmp_path / "full")
    assert summary(tmp_path / "full")["full_map"] and summary(tmp_path / "full")["located_share"] == 1
    assert contents(run) == before and sorted(path.name for path in tmp_path.glob(".*")) == []
    done("verify", run)


def test_results_in_the_folder_of_a_run_do_not_bring_cells_there(run: Path, room: Path, tmp_path: Path) -> None:
    copy = shutil.copytree(run, tmp_path / "copy")
    before = contents(copy)
    done("localize", copy, room, "--stop", 2, "--out", copy / "again")
    added = set(contents(copy)) - set(before)
    assert added and all(name.startswith("again") for name in added)


def test_scans_are_located_in_a_cloud(scans: Path, tmp_path: Path) -> None:
    cloud = scans.parent / "cloud.npy"
    done("localize", cloud, scans, "--start-pose", "given", "--out", tmp_path / "out")
    found = summary(tmp_path / "out")
    assert found["located_share"] == 1 and found["rmse_m"] < 0.03 and found["map_points_mean"] > 0
    done("submaps", cloud, "--out", tmp_path / "map.grid", "--axes", "xy", "--voxel", "0", "--visit", "survey")
    output = done("submaps", tmp_path / "map.grid", "--since", "survey")
    assert "along xy" in output and "points.pcd" in output and "cells since survey" in output
    done("localize", tmp_path / "map.grid", scans, "--start-pose", "given", "--radius", 6, "--out", tmp_path / "small")
    small = summary(tmp_path / "small")
    assert small["located_share"] == 1 and small["map_points_mean"] < found["map_points_mean"]
    assert small["damaged_cells"] == []
    with GridStore.open(tmp_path / "map.grid") as store:
        version = store.cell(store.cells()[len(store.cells()) // 2]).version
    damaged = next((tmp_path / "map.grid" / "cells").glob(f"*/{version}/points.pcd"))
    damaged.write_bytes(damaged.read_bytes()[:-1])
    output = done("localize", tmp_path / "map.grid", scans, "--start-pose", "given", "--out", tmp_path / "torn")
    assert summary(tmp_path / "torn")["located_share"] == 1 and "left out" in output and "points.pcd" in output


def test_scans_are_found_without_a_start_pose(scans: Path, tmp_path: Path) -> None:
    cloud = scans.parent / "cloud.npy"
    truth = read_tum(scans / "trajectory.txt").T_world_camera
    done("localize", cloud, scans, "--out", tmp_path / "cloud")
    done("submaps", scans, "--out", tmp_path / "map.grid", "--axes", "xy", "--radius", 1.5)
    assert "scan_places.npz" in done("submaps", tmp_path / "map.grid")
    x, y = truth[0, :2, 3]
    near = ["--near", f"{x + 1:.1f} {y:.1f} 2", "--no-start-pose"]
    done("localize", tmp_path / "map.grid", scans, *near, "--out", tmp_path / "store")
    for out in ("cloud", "store"):
        found = summary(tmp_path / out)
        assert found["located_share"] == 1 and found["rmse_m"] < 0.03 and found["statuses"]["found"] == 1
    far = ["--near", f"{x + 100:.1f} {y:.1f} 2"]
    for path in (tmp_path / "map.grid", cloud):
        one_error(ggslam("localize", path, scans, *far), "--near", "has nothing within 6")


def test_a_scan_without_points_is_lost_and_the_ride_goes_on(scans: Path, tmp_path: Path) -> None:
    shutil.copytree(scans, tmp_path / "ride")
    files = sorted((tmp_path / "ride").rglob("*.npy"))[:4]
    np.save(files[1], np.full_like(np.load(files[1]), np.nan))
    np.save(files[2], np.load(files[2])[:0])
    cloud = scans.parent / "cloud.npy"
    command = ["localize", cloud, tmp_path / "ride", "--start-pose", "given", "--stop", 4, "--out", tmp_path / "out"]
    done(*command)
    frames = json.loads((tmp_path / "out" / "localization.json").read_text())["frames"]
    assert [frame["status"] == "lost" for frame in frames] == [False, True, True, False]
    for file in files:
        np.save(file, np.full((9, 3), np.nan, np.float32))
    one_error(ggslam(*command), str(tmp_path / "ride"), "none of 4 scans has a point")


def test_a_start_pose_that_is_not_used_is_told(scans: Path, tmp_path: Path) -> None:
    x, y, z = read_tum(scans / "trajectory.txt").T_world_camera[0, :3, 3]
    cloud, wrong = scans.parent / "cloud.npy", f"{x:.2f} {y:.2f} {z + 30:.2f} 0 0 0 1"
    output = done("localize", cloud, scans, "--start-pose", wrong, "--stop", 1, "--out", tmp_path / "out")
    assert "the start pose was not used" in " ".join(output.split()) and "30.0 m" in output
    output = done("localize", cloud, scans, "--start-pose", "given", "--stop", 1, "--out", tmp_path / "given")
    assert "not used" not in output


def test_scans_are_located_in_an_octomap(scans: Path, tmp_path: Path) -> None:
    points = np.load(scans.parent / "cloud.npy")
    occupancy = OccupancyMap(0.1)
    centre = read_tum(scans / "trajectory.txt").T_world_camera[0, :3, 3]
    occupancy.insert(points.astype(np.float32), centre)
    write_octomap(occupancy, tmp_path / "map.bt")
    done("localize", tmp_path / "map.bt", scans, "--start-pose", "given", "--stop", 6, "--out", tmp_path / "out")
    found = summary(tmp_path / "out")
    assert found["located_share"] == 1 and found["rmse_m"] < 0.07  # a wall is anywhere in its voxels of 10 cm
    done("submaps", tmp_path / "map.bt", "--out", tmp_path / "map.grid")
    with GridStore.open(tmp_path / "map.grid") as store:
        held = np.concatenate([load_points(store, key)["points"] for key in store.cells()])
    centres, sizes = occupancy.occupied_centers()
    assert len(held) >= len(centres)
    inside = (np.abs(held[:, None, :3] - centres[None, :200]).max(2) <= sizes[None, :200] / 2 + 1e-4).any(0)
    assert inside.all()


@pytest.mark.parametrize("suffix", [".las", ".e57", ".pcap", ".ot", ".bag"])
def test_kinds_that_are_not_read_are_named(scans: Path, tmp_path: Path, suffix: str) -> None:
    path = tmp_path / f"map{suffix}"
    path.write_bytes(b"anything")
    one_error(ggslam("localize", path, scans, "--out", tmp_path / "o"), suffix, "is not read")
    one_error(ggslam("submaps", path, "--out", tmp_path / "m.grid"), suffix, "is not read")


def test_a_visit_is_recorded_with_poses_from_localisation(room: Path, run: Path, tmp_path: Path) -> None:
    store = tmp_path / "room.grid"
    done("submaps", run, "--out", store, "--visit", "first", "--at", 0)
    done("localize", store, room, "--stop", 8, "--out", tmp_path / "out")
    poses = ["--poses", tmp_path / "out" / "trajectory.txt"]
    output = done(
        "submaps", room, "--stop", 8, "--out", store, *poses, "--visit", "second", "--at", 1000, "--radius", 2
    )
    assert re.search(r"\d+ cells? written", output)
    with GridStore.open(store) as opened:
        assert opened.visits() == ["first", "second"] and opened.changed_since("second")


def test_what_cannot_be_done_is_one_error(run: Path, room: Path, scans: Path, tmp_path: Path) -> None:
    cloud = scans.parent / "cloud.npy"
    one_error(ggslam("localize", tmp_path / "none", room), "none", "no such folder")
    one_error(ggslam("localize", room, room), str(room), "neither a grid store")
    one_error(ggslam("localize", tmp_path / "no.pcd", room, "--start-pose", ORIGIN), "no.pcd")
    one_error(ggslam("localize", cloud, scans, "--near", "1 2"), "--near", "'1 2'")
    one_error(ggslam("localize", run, room, "--near", "500 500 1"), "no places to look up within 3 m of (500, 500)")
    one_error(ggslam("localize", cloud, room), "no places")
    one_error(ggslam("localize", run, room, "--scale", 0.5), "camera", "--scale")
    one_error(ggslam("localize", run, room, "--start-pose", "1 2 3"), "--start-pose", "'1 2 3'")
    one_error(ggslam("localize", run, room, "--start-pose", "100"), "--start")
    one_error(ggslam("localize", run, room, "--start-pose", "1e300 0 0 0 0 0 1"), "--start-pose")
    one_error(ggslam("localize", run, room, "--start-pose", ORIGIN, "--no-start-pose"), "one of them")
    one_error(ggslam("submaps", room), "no grid store")
    one_error(ggslam("submaps", tmp_path / "none"), "none")
    bare = shutil.copytree(scans, tmp_path / "bare")
    (bare / "trajectory.txt").write_text("0 0 0 0 0 0 0 1\n")
    one_error(ggslam("localize", cloud, bare, "--start-pose", ORIGIN), "trajectory.txt", "1 pose for 12 scans")
    (bare / "trajectory.txt").unlink()
    one_error(ggslam("submaps", bare, "--out", tmp_path / "bare.grid"), "no poses")
    one_error(ggslam("localize", cloud, bare, "--start-pose", "given"), "no pose")
    (bare / "scans" / "000001.npy").write_bytes(b"?")
    torn = ggslam("localize", cloud, bare, "--start-pose", ORIGIN, "--out", tmp_path / "torn")
    one_error(torn, "000001.npy", "cannot be read")
    (scans.parent / "damaged.grid").mkdir()
    (scans.parent / "damaged.grid" / "index.sqlite").write_bytes(b"nothing of the kind" * 100)
    one_error(ggslam("localize", scans.parent / "damaged.grid", room), "damaged.grid")


def test_damaged_places_are_left_out(run: Path, room: Path, tmp_path: Path) -> None:
    store = tmp_path / "room.grid"
    done("submaps", run, "--out", store)
    parts = sorted((store / "cells").rglob("places.npz"))
    parts[0].write_bytes(parts[0].read_bytes()[:-1])
    output = done("localize", store, room, "--stop", 3, "--start-pose", ORIGIN, "--out", tmp_path / "torn")
    assert summary(tmp_path / "torn")["located_share"] == 1 and "left out" in output and "places.npz" in output
    assert "places.npz" in done("submaps", store)
    for part in parts[1:]:
        part.unlink()
    one_error(ggslam("localize", store, room), "--start-pose is needed", "places.npz")


def test_the_robots_body_is_left_out_of_scans_that_are_located(scans: Path, tmp_path: Path) -> None:
    cloud, box = scans.parent / "cloud.npy", "-0.9,-0.4,-0.6,-0.3,0.4,0.3"
    low, high = np.array([-0.93, -0.43, -0.63]), np.array([-0.27, 0.43, 0.33])  # with the margin of 3 cm
    for name in ("seen", "bare"):
        shutil.copytree(scans, tmp_path / name)
    share = []
    for path in sorted((scans / "scans").iterdir()):
        points = np.load(path).astype(float)
        with np.errstate(divide="ignore"):
            ends = np.sort([low / points, high / points], 0)
        enter, leave = ends[0].max(1), ends[1].min(1)
        hidden = (enter <= leave) & (enter > 0) & (enter < 1)
        near = points[hidden] * (enter[hidden, None] + 0.05)  # what the scanner sees there: the body
        np.save(tmp_path / "bare" / "scans" / path.name, points[~hidden].astype(np.float32))
        seen = np.where(hidden[:, None], 0, points)
        seen[hidden] = near
        np.save(tmp_path / "seen" / "scans" / path.name, seen.astype(np.float32))
        share.append(hidden.mean())
    assert 0.03 < np.mean(share) < 0.5
    common = ("--start-pose", "given")
    done("localize", cloud, tmp_path / "bare", *common, "--out", tmp_path / "a")
    done("localize", cloud, tmp_path / "seen", *common, "--body", box, "--out", tmp_path / "b")
    done("localize", cloud, tmp_path / "seen", *common, "--out", tmp_path / "c")
    overlap = [
        np.mean([f["overlap"] for f in json.loads((tmp_path / name / "localization.json").read_text())["frames"]])
        for name in "abc"
    ]
    found = [read_tum(tmp_path / name / "trajectory.txt").T_world_camera for name in "ab"]
    truth = read_tum(scans / "trajectory.txt").T_world_camera
    assert np.linalg.norm(found[1][:, :3, 3] - truth[:, :3, 3], axis=1).max() < 0.03
    np.testing.assert_allclose(found[1], found[0], atol=2e-3)  # points at the box's very edge may differ
    assert overlap[1] == pytest.approx(overlap[0], abs=2e-3) and overlap[2] < overlap[0] - 0.01
    one_error(ggslam("localize", cloud, scans, "--body", "1,2,3"), "body", "'1,2,3'")


def test_the_radius_may_follow_what_is_seen(scans: Path, tmp_path: Path) -> None:
    cloud = scans.parent / "cloud.npy"
    done("localize", cloud, scans, "--start-pose", "given", "--radius", "auto", "--out", tmp_path / "auto")
    found = summary(tmp_path / "auto")
    assert found["located_share"] == 1 and found["rmse_m"] < 0.03
    one_error(ggslam("localize", cloud, scans, "--radius", "far"), "--radius", "or auto", "'far'")
    one_error(ggslam("localize", cloud, scans, "--radius", "auto", "--full-map"), "--radius", "auto", "--full-map")


def test_another_camera_is_located_from_a_start_pose(run: Path, room: Path, tmp_path: Path) -> None:
    output = done("localize", run, room, "--scale", 0.5, "--stop", 3, "--start-pose", ORIGIN, "--out", tmp_path / "out")
    assert summary(tmp_path / "out")["located_share"] == 1 and "lost frames are not looked up" in output


@pytest.mark.parametrize(
    ("command", "option", "value"),
    [("localize", "--radius", -1), ("localize", "--voxel", 0), ("localize", "--start", -1), ("submaps", "--radius", -1)]
)
def test_numbers_out_of_range_are_named_as_they_were_given(
    run: Path, room: Path, tmp_path: Path, command: str, option: str, value: int
) -> None:
    result = ggslam(command, run, *([room] if command == "localize" else []), "--out", tmp_path / "o", option, value)
    assert f"{option}: expected a " in str(result.exception) and f"found '{value}'" in str(result.exception)


def test_a_damaged_scan_in_the_middle_loses_nothing(scans: Path, tmp_path: Path) -> None:
    torn = shutil.copytree(scans, tmp_path / "torn")
    (torn / "scans" / "000007.npy").write_bytes(b"?")
    result = ggslam("localize", scans.parent / "cloud.npy", torn, "--start-pose", "given", "--out", tmp_path / "out")
    one_error(result, "000007.npy")
    assert summary(tmp_path / "out")["frames"] == 7 and len(read_tum(tmp_path / "out" / "trajectory.txt")) == 7


def test_a_run_whose_adding_was_cut_off_is_added_whole(
    run: Path, room: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    store, puts = tmp_path / "room.grid", []
    put_cells = GridStore.put_cells

    def cut_off(self: GridStore, writes: Any) -> None:
        puts.append(1)
        if len(puts) == 2:
            raise OSError("disk full")
        put_cells(self, writes)

    monkeypatch.setattr(GridStore, "put_cells", cut_off)
    assert ggslam("submaps", run, "--out", store).exit_code != 0 and len(puts) == 2
    monkeypatch.undo()
    done("submaps", run, "--out", store)
    listed = done("submaps", store)
    assert all(part in listed for part in ("points.pcd", "gaussians.npz", "places.npz"))
    done("localize", store, room, "--stop", 2, "--out", tmp_path / "out")
