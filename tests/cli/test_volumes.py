# SPDX-License-Identifier: Apache-2.0
"""`ggslam volumes` on a small generated recording and a run of it."""

from __future__ import annotations

import json
import re
import shutil
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from typer.testing import CliRunner, Result

from ggslam.cli.main import app
from ggslam.errors import GgslamError
from ggslam.formats.triangle_mesh import read_mesh
from ggslam.jobs.volumes.frames import far_away
from ggslam.runs.folder import RunFolder
from ggslam.volumes.octomap_files import read_octomap
from ggslam.volumes.tsdf_file import load_tsdf

QUICK = ["--voxel", 0.05, "--set", "volumes.tsdf.max_depth=4"]


def ggslam(*arguments: object) -> Result:
    """The command line within this process; an error of ours is in `exception`."""
    return CliRunner().invoke(app, [str(argument) for argument in arguments], env={"COLUMNS": "120"})


def made(*arguments: object) -> str:
    result = ggslam("volumes", *arguments)
    assert result.exit_code == 0 and result.exception is None, (result.output, result.exception)
    return result.output


def record(folder: Path) -> dict[str, Any]:
    return json.loads((folder / "volumes.json").read_text())


def one_error(result: Result, *words: str) -> None:
    assert isinstance(result.exception, GgslamError) and result.exception.exit_code == 2, result
    assert all(word in str(result.exception) for word in words), str(result.exception)


@pytest.fixture(scope="module")
def of_recording(room: Path, tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, str]:
    out = tmp_path_factory.mktemp("volumes") / "room"
    wanted = ["--esdf", "--occupancy", 0.1, "--object-meshes", "--driving", "--speeds", "1,3"]
    return out, made(room, "--out", out, *QUICK, *wanted)


def test_a_recording_with_poses_needs_no_run(of_recording: tuple[Path, str]) -> None:
    out, printed = of_recording
    found = record(out)
    assert found["complete"] and found["frames"] == 24 and not found["live"]
    mesh = read_mesh(out / "mesh.ply")
    assert mesh is not None and len(mesh.triangles) == found["mesh"]["triangles"] > 1000
    assert len(load_tsdf(out / "tsdf.npz")) == found["tsdf"]["blocks"]
    for picture in ("mesh.png", "objects.png", "esdf.png", "occupancy.png"):
        image = cv2.imread(str(out / picture))
        assert image is not None and image.std() > 10, picture
    assert "poses of the recording itself" in printed


def test_a_robot_is_blind_for_latencies_and_waits(of_recording: tuple[Path, str]) -> None:
    """Two frames of 33.3 ms and a controller's turn of 50 ms on top of map, sensor (33 ms) and plan (50 ms)."""
    printed = " ".join(of_recording[1].split())
    maps, worst, blind = (
        float(found[1])
        for name in (r"know of a frame ([\d.]+) ms", r"at worst (\d+) ms", r"blind for (\d+) ms")
        if (found := re.search(name, printed))
    )
    slow = maps > 33.3
    assert worst == pytest.approx((33.3 + 2 * maps if slow else 66.6) + 50, abs=1)
    assert blind == pytest.approx(maps + 33 + 50 + worst, abs=1.5)
    metres = re.search(r"1 m/s\W+([\d.]+) m\W+([\d.]+) m", printed)
    assert metres is not None and float(metres[1]) == pytest.approx(blind / 1e3, abs=0.006)
    assert float(metres[2]) == pytest.approx(blind / 1e3 + 1 / (2 * 0.5 * 9.81), abs=0.01)


def test_the_generated_room_stands_upright_on_its_floor(of_recording: tuple[Path, str]) -> None:
    """Its floor is at y = 0 and its y axis points down, the camera is held at eye height."""
    found = record(of_recording[0])["up"]
    assert np.allclose(found["up"], [0, 0, 1], atol=0.02) or np.allclose(found["up"], [0, -1, 0], atol=0.02)
    assert found["floor"] == pytest.approx(0, abs=0.05) and found["support"] > 0.1


def test_the_ros_map_says_what_stands_in_the_way(of_recording: tuple[Path, str]) -> None:
    out, _ = of_recording
    image = cv2.imread(str(out / "map.pgm"), cv2.IMREAD_UNCHANGED)
    assert set(np.unique(image)) == {0, 205, 254}
    assert "resolution: 0.05" in (out / "map.yaml").read_text()


def test_the_occupancy_map_holds_the_surface(of_recording: tuple[Path, str]) -> None:
    out, _ = of_recording
    occupancy = read_octomap(out / "occupancy.bt")
    mesh = read_mesh(out / "mesh.ply")
    assert mesh is not None
    near = np.zeros(len(mesh.vertices), bool)
    for shift in 0.05 * np.array([*np.eye(3), *-np.eye(3), np.zeros(3)]):
        near |= occupancy.states(mesh.vertices + shift) == 1
    assert near.mean() > 0.9


def test_objects_get_meshes_under_their_names(of_recording: tuple[Path, str], room: Path) -> None:
    out, _ = of_recording
    files = sorted(out.glob("object_*.ply"))
    assert len(files) == len(record(out)["mesh"]["objects"]) > 5
    total = sum(len(mesh.triangles) for mesh in map(read_mesh, files) if mesh is not None)
    assert total <= record(out)["mesh"]["triangles"]


def test_the_report_is_the_equation(of_recording: tuple[Path, str]) -> None:
    out, printed = of_recording
    map_s, period = record(out)["times"]["all"]["p95_ms"] / 1e3, 0.0333
    # Two frames until what was free is occupied, or the map's own pace where that is slower; then the controller.
    wait = 2 * period if map_s <= period else period + 2 * map_s
    latency = map_s + 0.033 + 0.05 + wait + 0.05
    distance = 3 * latency + 9 / (2 * 0.5 * 9.81)
    assert f"{3 * latency:.2f} m" in printed and f"{distance:.2f} m" in printed


def test_a_run_gives_its_poses_and_its_objects(room_run: RunFolder, room: Path, tmp_path: Path) -> None:
    run = Path(shutil.copytree(room_run.path, tmp_path / "run"))
    printed = made(run, *QUICK, "--mesh", tmp_path / "meshes" / "room.ply")
    found = record(run / "volumes")
    assert found["frames"] == 10 and found["mesh"]["objects"]
    assert (tmp_path / "meshes" / "room.ply").is_file() and not (run / "volumes" / "esdf.png").exists()
    assert str(run / "volumes") in printed.replace("\n", "")
    one_error(ggslam("volumes", run, "--mesh", run / "points.ply"), "points.ply", "run")
    one_error(ggslam("volumes", run, "--stop", 3), "--stop", "recordings")
    # Once more, over what is there, at another size, with a distance field.
    made(run, "--voxel", 0.08, "--scale", 0.5, "--esdf", "--slice", 1.0, "--no-objects")
    found = record(run / "volumes")
    assert found["settings"]["tsdf"]["voxel"] == 0.08 and not found["mesh"]["objects"]
    assert found["esdf"]["slice_height"] == pytest.approx(1.0)
    # A new run in the same place does not keep volumes of the old one.
    again = ["--stop", 4, "--iterations", 1, "--no-eval", "--overwrite"]
    assert ggslam("run", room, "--out", run, *again).exception is None
    assert not (run / "volumes").exists()


def test_live_volumes_come_with_a_run(room: Path, tmp_path: Path) -> None:
    without_poses = Path(shutil.copytree(room, tmp_path / "room"))
    (without_poses / "poses.txt").unlink()
    out = tmp_path / "run"
    one_error(ggslam("volumes", without_poses, "--out", out), "no poses", "--live")
    few = ["--stop", 8, "--set", "mapping.iterations_per_frame=1"]
    printed = made(without_poses, "--live", "--out", out, *few, *QUICK)
    assert (out / "map.ply").is_file() and record(out / "volumes")["live"]
    assert record(out / "volumes")["frames"] == 8 and "8 frames" in printed
    assert record(out / "volumes")["mesh"]["objects"]


def test_a_map_is_continued(of_recording: tuple[Path, str], room: Path, tmp_path: Path) -> None:
    start = of_recording[0] / "tsdf.npz"
    made(room, "--out", tmp_path / "more", "--stop", 2, "--onto", start)
    assert record(tmp_path / "more")["tsdf"]["blocks"] >= record(of_recording[0])["tsdf"]["blocks"]
    one_error(ggslam("volumes", room, "--out", tmp_path / "x", "--onto", start, "--voxel", 0.02), "--voxel", "--onto")
    rays = ["--set", "volumes.tsdf.integrator=rays"]
    one_error(ggslam("volumes", room, "--onto", start, *rays), "volumes.tsdf.integrator", "--onto", "as in the file")


def test_what_was_fused_before_a_damaged_frame_is_written(room: Path, tmp_path: Path) -> None:
    damaged = Path(shutil.copytree(room, tmp_path / "room"))
    victim = sorted((damaged / "depth").glob("*.png"))[5]
    victim.write_bytes(victim.read_bytes()[:200])
    one_error(ggslam("volumes", damaged, "--out", tmp_path / "out", *QUICK), victim.name)
    found = record(tmp_path / "out")
    assert found["frames"] == 5 and victim.name in found["stopped_by"]
    made(damaged, "--out", tmp_path / "out", *QUICK, "--skip-bad-frames")
    assert record(tmp_path / "out")["frames"] == 23


def test_a_frame_far_from_the_others_is_found() -> None:
    poses = {k: np.eye(4) for k in range(9)}
    for k, T in poses.items():
        T[0, 3] = 0.1 * k
    assert far_away(poses) == []
    poses[6][1, 3] = 1e5
    assert far_away(poses) == [6]


def test_mistakes_are_named(room: Path, tmp_path: Path) -> None:
    (tmp_path / "mine").mkdir()
    (tmp_path / "mine" / "letter.txt").write_text("keep me")
    one_error(ggslam("volumes", room, "--out", tmp_path / "mine"), "not empty", "mine")
    one_error(ggslam("volumes", room, "--voxel", 0), "voxel")
    one_error(ggslam("volumes", room, "--occupancy", -1, "--out", tmp_path / "a"), "occupancy")
    one_error(ggslam("volumes", room, "--mesh", "mesh.stl"), "mesh.stl", ".ply")
    one_error(ggslam("volumes", room, "--band", "2,1"), "--band")
    one_error(ggslam("volumes", room, "--realtime", 5), "--realtime", "--live")
    one_error(ggslam("volumes", room, "--friction", 0), "friction")
    one_error(ggslam("volumes", room, "--esdf", "--slice", "nan"), "--slice")
    one_error(ggslam("volumes", room, "--overwrite"), "--overwrite", "--live")
    one_error(ggslam("volumes", room, "--device", "meta"), "--device")
    one_error(ggslam("volumes", room, "--mesh", sorted((room / "rgb").glob("*"))[0] / "x.ply"), "cannot be made")
    nothing = ["--set", "volumes.tsdf.min_depth=90", "--set", "volumes.tsdf.max_depth=95"]
    one_error(ggslam("volumes", room, *nothing, "--out", tmp_path / "b"), "no depth")
    one_error(ggslam("volumes", room, "--set", "volumes.tsdf.voxl=1"), "voxl", "voxel")
    one_error(ggslam("volumes", room, "--onto", tmp_path / "none.npz"), "none.npz")
    assert not Path("volumes").exists() and not (tmp_path / "a").exists()


def test_what_was_there_stays_if_anything_goes_wrong(
    of_recording: tuple[Path, str], room: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    out = Path(shutil.copytree(of_recording[0], tmp_path / "room"))
    (out / "notes.txt").write_text("keep me")
    before = {path.name: path.read_bytes() for path in out.iterdir()}

    def interrupted(*arguments: object) -> None:
        raise KeyboardInterrupt

    from ggslam.volumes.esdf import DistanceField

    few = ["--stop", 3, *QUICK]
    with monkeypatch.context() as patched:
        patched.setattr("ggslam.jobs.volumes.outputs.write_octomap", interrupted)
        assert ggslam("volumes", room, "--out", out, *few, "--occupancy", 0.1).exit_code == 130
    assert {path.name: path.read_bytes() for path in out.iterdir()} == before
    update, calls = DistanceField.update, []

    def second_is_interrupted(field: DistanceField, *arguments: object) -> object:
        calls.append(field)
        return interrupted() if len(calls) == 2 else update(field, *arguments)

    with monkeypatch.context() as patched:
        patched.setattr(DistanceField, "update", second_is_interrupted)
        assert ggslam("volumes", room, "--out", out, *few, "--esdf", "--driving").exit_code == 130
    found = record(out)
    assert found["frames"] == 1 and "KeyboardInterrupt" in found["stopped_by"]
    assert (out / "notes.txt").is_file() and not (out / "occupancy.bt").exists()
    blocked = tmp_path / "blocked"
    made(room, "--out", blocked, *few)
    (blocked / "esdf.png").mkdir()
    one_error(ggslam("volumes", room, "--out", blocked, *few), "esdf.png", "folder")
    assert (blocked / "tsdf.npz").is_file()


def test_a_band_higher_than_the_room_is_cut(room: Path, tmp_path: Path) -> None:
    made(room, "--out", tmp_path / "a", "--stop", 3, *QUICK, "--esdf", "--band", "0.1,900000")
    low, high = record(tmp_path / "a")["esdf"]["band"]
    assert 0 < low < high < 10


def test_robots_get_maps_of_their_own(room: Path, tmp_path: Path) -> None:
    out = tmp_path / "a"
    robots = ["--robot", "0.3,0.1", "--robot", "tall:1.4,0.2,0.1"]
    assert "tall:" in made(room, "--out", out, "--stop", 6, *QUICK, "--esdf", *robots)
    names = {"map_robot.pgm", "map_robot.yaml", "costmap_robot.png", "costmap_robot.yaml", "robot_robot.png"}
    names |= {name.replace("_robot", "_tall") for name in names}
    found = record(out)
    assert names <= set(found["files"]) and all((out / name).is_file() for name in names)
    assert set(found["esdf"]["robots"]) == {"robot", "tall"} and found["esdf"]["robots"]["tall"]["step"] == 0.1
    low, tall = (cv2.imread(str(out / f"map_{name}.pgm"), cv2.IMREAD_UNCHANGED) for name in ("robot", "tall"))
    costs = cv2.imread(str(out / "costmap_tall.png"), cv2.IMREAD_UNCHANGED)
    assert low.shape == tall.shape == costs.shape[:2] and not np.array_equal(low, tall)
    assert np.array_equal(tall == 0, (costs[..., 0] == 0) & (costs[..., 3] == 255))
    made(room, "--out", out, "--stop", 6, *QUICK, "--esdf")
    assert not (out / "map_tall.pgm").exists()


def test_wrong_robots_are_refused(room: Path, tmp_path: Path) -> None:
    few = [room, "--out", tmp_path / "a", "--stop", 1, *QUICK]
    one_error(ggslam("volumes", *few, "--robot", "1,0.2"), "robot", "esdf")
    one_error(ggslam("volumes", *few, "--esdf", "--robot", "tall"), "HEIGHT,RADIUS")
    one_error(ggslam("volumes", *few, "--esdf", "--robot", "a:1,0.2", "--robot", "A:1,0.3"), "twice")
    one_error(ggslam("volumes", *few, "--esdf", "--robot", "1,0.2", "--inflation", "1"), "RADIUS,FACTOR")
    assert not (tmp_path / "a" / "volumes.json").exists()


def test_the_robots_own_body_is_left_out(room: Path, tmp_path: Path) -> None:
    """A box before the lower half of the camera hides the floor and what stands on it."""
    few = [room, "--stop", 4, *QUICK, "--occupancy", 0.1]
    made(*few, "--out", tmp_path / "a")
    made(*few, "--out", tmp_path / "b", "--body", "-2,0,0.3,2,1,0.5")
    whole, cut = (read_mesh(tmp_path / name / "mesh.ply") for name in "ab")
    assert whole is not None and cut is not None and 0.1 < len(cut.vertices) / len(whole.vertices) < 0.8
    urdf = tmp_path / "cart.urdf"
    urdf.write_text(
        '<robot name="a"><link name="camera"><collision><origin xyz="0 0.5 0.4"/><geometry><box size="4 1 0.2"/>'
        "</geometry></collision></link></robot>"
    )
    made(*few, "--out", tmp_path / "c", "--body", urdf, "--body-frame", "camera")
    same = read_mesh(tmp_path / "c" / "mesh.ply")
    assert same is not None and np.array_equal(same.vertices, cut.vertices)
    bad = [*few, "--out", tmp_path / "d", "--body"]
    one_error(ggslam("volumes", *bad, tmp_path / "no.urdf", "--body-frame", "a"), "no.urdf")
    one_error(ggslam("volumes", *bad, "1,2"), "XMIN")
    assert not (tmp_path / "d").exists()
