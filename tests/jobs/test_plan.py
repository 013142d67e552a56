# SPDX-License-Identifier: Apache-2.0
"""Paths through maps of all kinds that people have, by one call and from the command line."""

from __future__ import annotations

import json
import sys
from pathlib import Path

import cv2
import numpy as np
import pytest
from command_line import ggslam, refuse, succeed

sys.path.insert(0, str(Path(__file__).parents[1] / "driving"))
from plan_scenes import Y_DOWN, Column, Room, along, exact_clearance, room_tsdf  # noqa: E402

from ggslam.driving.robot import Robot  # noqa: E402
from ggslam.errors import ConfigError, FormatError, InputError  # noqa: E402
from ggslam.jobs.plan.plan_path import plan_path  # noqa: E402
from ggslam.jobs.plan.ros_maps import read_ros_map  # noqa: E402
from ggslam.jobs.plan.store_maps import StoreFloor, StoreSpace  # noqa: E402
from ggslam.jobs.volumes.cell_volumes import BlocksTask, CellBlocks, field_cell  # noqa: E402
from ggslam.jobs.volumes.store_volumes import ESDF, TSDF  # noqa: E402
from ggslam.scene.arrays import arrays_to_bytes, read_all_arrays  # noqa: E402
from ggslam.scene.poses import inverse, transform_points  # noqa: E402
from ggslam.submaps.grid import GridStore  # noqa: E402
from ggslam.submaps.settings import SubmapSettings  # noqa: E402
from ggslam.volumes.esdf import FieldSettings  # noqa: E402
from ggslam.volumes.occupancy import OccupancyMap  # noqa: E402
from ggslam.volumes.octomap_files import write_octomap  # noqa: E402
from ggslam.volumes.tsdf_file import blocks_within, save_tsdf  # noqa: E402

VOXEL = 0.08
ROOM = Room((9.0, 3.0, 2.4), (
    Column((3.0, 0.9), (0.1, 0.9), 0.0, 0.0, 2.4, False), Column((5.0, 2.2), (0.15, 0.8), 0.0, 0.0, 2.4, False),
    Column((7.0, 1.2), (0.3, 0.3), 0.0, 0.0, 0.8, True),
))  # fmt: skip
START, GOAL = np.array([0.8, 0.8, 0.5]), np.array([8.2, 0.9, 1.2])
"""On the floor's axes."""


def in_map(place: np.ndarray) -> list[float]:
    return transform_points(place[None], inverse(Y_DOWN))[0].tolist()


@pytest.fixture(scope="module")
def volumes(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with the room's volume."""
    out = tmp_path_factory.mktemp("plans") / "room"
    out.mkdir()
    save_tsdf(out / "tsdf.npz", room_tsdf(ROOM, VOXEL, None, Y_DOWN))
    return out


@pytest.fixture(scope="module", params=[True, False], ids=["with distances", "without"])
def store(volumes: Path, request: pytest.FixtureRequest) -> Path:
    """The same in cells of 1.5 m."""
    out = volumes.parent / f"store-{request.param}"
    arrays = read_all_arrays(volumes / "tsdf.npz", "a TSDF")
    GridStore.create(out, SubmapSettings(spacing=1.5, axes="xz")).close()
    with GridStore.create(out / "volumes", SubmapSettings(spacing=1.5, axes="xz")) as made:
        made.begin_visit("room")
        for x in range(-1, 8):
            for z in range(-1, 4):
                cell = CellBlocks.of(made.grid, (x, 0, z), VOXEL)
                own = blocks_within(arrays, *cell.around(0))
                if not len(own["dense"]) + len(own["free"]):
                    continue
                parts = {TSDF: arrays_to_bytes(**own)}
                if request.param:
                    near = arrays_to_bytes(**blocks_within(arrays, *cell.around(3)))
                    task = BlocksTask((x, 0, z), cell, near, FieldSettings(max_distance=1.0))
                    parts[ESDF] = field_cell(task).data
                made.put((x, 0, z), parts)
    return out


def nearest(points: np.ndarray, fly: bool, T_floor_map: np.ndarray = Y_DOWN) -> float:
    """Least exact clearance of a path in the map."""
    return float(exact_clearance(ROOM, along(transform_points(points, T_floor_map)), 3 if fly else 2).min())


@pytest.mark.parametrize("fly", [False, True], ids=["drive", "fly"])
def test_volumes(volumes: Path, tmp_path: Path, fly: bool) -> None:
    path = plan_path(volumes, in_map(START), in_map(GOAL), fly=fly, clearance=0.25, out=tmp_path)
    assert path.is_found, path.reason
    assert 7.4 < path.length < 8.8 and path.least_clearance >= 0.25 - 1e-6
    assert nearest(path.points, fly) >= 0.25 - VOXEL / 2
    record = json.loads((tmp_path / "path.json").read_text())
    assert record["found"] and record["map"] == "room" and record["frame"] == "map"
    assert np.allclose(record["points"], path.points) and len(record["clearances_m"]) == len(path.points)
    assert (record["yaws_rad"] is None) == fly
    picture = cv2.imread(str(tmp_path / "path.png"))
    assert picture is not None and len(np.unique(picture.reshape(-1, 3), axis=0)) > 30


def test_the_floor_frame(volumes: Path) -> None:
    place = [*START[:2], 0.0], [*GOAL[:2], 0.0]
    path = plan_path(volumes, place[0], place[1], frame="floor")
    assert path.is_found and np.abs(path.points[:, 2]).max() < 1e-6
    assert path.points[0] == pytest.approx(place[0], abs=0.02)  # the floor is found from surfaces
    assert path.yaw is not None and abs(path.yaw[0]) < np.pi / 2


@pytest.mark.parametrize("fly", [False, True], ids=["drive", "fly"])
def test_a_store_is_read_along_the_path(store: Path, volumes: Path, fly: bool) -> None:
    whole = plan_path(volumes, in_map(START), in_map(GOAL), fly=fly, clearance=0.25)
    path = plan_path(store, in_map(START), in_map(GOAL), fly=fly, clearance=0.25)
    assert path.is_found, path.reason
    assert path.length == pytest.approx(whole.length, rel=0.03)
    assert nearest(path.points, fly) >= 0.25 - VOXEL / 2


@pytest.mark.parametrize("fly", [False, True], ids=["drive", "fly"])
def test_cells_far_from_the_path_are_not_read(store: Path, fly: bool, monkeypatch: pytest.MonkeyPatch) -> None:
    read: set[object] = set()
    kind = StoreSpace if fly else StoreFloor
    close = kind.close

    def note(pages: StoreSpace | StoreFloor) -> None:
        read.update(pages.cells.read)
        close(pages)  # type: ignore[arg-type]

    monkeypatch.setattr(kind, "close", note)
    path = plan_path(store, in_map(START), in_map(np.array([1.6, 2.1, 0.6])), fly=fly, clearance=0.25)
    assert path.is_found and path.pages > 0
    with GridStore.open(store / "volumes") as made:
        assert 0 < len(read) < 0.8 * len(made.cells())


@pytest.mark.parametrize("ending", [".bt", ".ot"])
def test_octomaps(tmp_path: Path, ending: str) -> None:
    occupancy, file = OccupancyMap(VOXEL), tmp_path / f"room{ending}"
    rng = np.random.default_rng(0)
    for x in (0.6, 2.0, 3.9, 4.6, 6.0, 8.0):
        eye = np.array([x, 1.5 if x != 4.6 else 0.7, 1.1])
        way = rng.normal(size=(8_000, 3))
        way /= np.linalg.norm(way, axis=1, keepdims=True)
        far = np.zeros(len(way))
        for _ in range(80):
            far += np.maximum(ROOM.distance(eye + far[:, None] * way), 0)
        occupancy.insert(eye + far[:, None] * way, eye)
    write_octomap(occupancy, file)
    for fly in (False, True):
        start = START if fly else np.array([*START[:2], 0.0])
        path = plan_path(file, start.tolist(), GOAL.tolist(), fly=fly, clearance=0.3)
        assert path.is_found, path.reason
        assert nearest(path.points, fly, np.eye(4)) >= 0.3 - VOXEL


def ros_map(folder: Path, yaw: float = 0.0) -> Path:
    """An L of free cells of 10 cm: 3 m along x, then 2 m up along y at its end; else unknown."""
    pixels = np.full((30, 40), 205, np.uint8)
    pixels[18:28, 2:32] = 254
    pixels[2:28, 22:32] = 254
    pixels[15, 24:28] = 0
    (folder / "l.pgm").write_bytes(b"P5\n# by hand\n40 30\n255\n" + pixels.tobytes())
    (folder / "l.yaml").write_text(
        f"image: l.pgm\nresolution: 0.1\norigin: [-1.0, 2.0, {yaw}]\nnegate: 0\noccupied_thresh: 0.65\n"
        "free_thresh: 0.196\n"
    )
    return folder / "l.yaml"


@pytest.mark.parametrize("yaw", [0.0, 0.5])
def test_ros_maps(tmp_path: Path, yaw: float) -> None:
    file = ros_map(tmp_path, yaw)
    turn = np.array([[np.cos(yaw), -np.sin(yaw)], [np.sin(yaw), np.cos(yaw)]])
    ends = np.array([[0.5, 0.5], [2.9, 2.5]]) @ turn.T + (-1.0, 2.0)  # from the lower left corner, right and up
    path = plan_path(file, [*ends[0], 0], [*ends[1], 0], clearance=0.2)
    assert path.is_found, path.reason
    own = (along(path.points)[:, :2] - (-1.0, 2.0)) @ turn
    column, from_bottom = np.floor(own / 0.1).astype(int).T
    found = read_ros_map(file)
    assert found.free[from_bottom, column].all()
    middle = np.array([2.6, 1.45])  # of the bar, 40 x 10 cm
    gaps = np.linalg.norm(np.maximum(np.abs(own - middle) - (0.2, 0.05), 0), axis=1)
    assert gaps.min() >= 0.2 - 0.1**2 / (4 * 0.2)  # between cells' centres distances are interpolated
    mirrored = np.array([[0.5, 2.5], [2.9, 0.5]]) @ turn.T + (-1.0, 2.0)
    assert "unknown space" in str(plan_path(file, [*mirrored[0], 0], [*mirrored[1], 0]).reason)
    assert plan_path(file, [*mirrored[0], 0], [*mirrored[1], 0], unknown=True).is_found


def test_the_command(volumes: Path, tmp_path: Path) -> None:
    words = [*map(str, in_map(START)), "--to", *map(str, in_map(GOAL))]
    said = succeed("plan", volumes, "--from", *words, "--out", tmp_path / "out")
    assert "path of" in said and "wrote path.json and path.png" in said
    result = ggslam("plan", volumes, "--from", *words, "--clearance", "1", "--fly", "--out", tmp_path / "none")
    assert result.returncode == 3 and "no path: the start is" in result.stdout
    assert json.loads((tmp_path / "none" / "path.json").read_text())["found"] is False


def test_what_is_no_map(tmp_path: Path, volumes: Path) -> None:
    (tmp_path / "notes.txt").write_text("hello")
    words = ["--from", "0", "0", "0", "--to", "1", "0", "0"]
    for path, reason in ((tmp_path / "notes.txt", "expected volumes"), (tmp_path / "nothing.bt", "missing"),
                         (tmp_path, "expected volumes")):  # fmt: skip
        refuse(ggslam("plan", path, *words), reason)
    refuse(ggslam("plan", volumes, *words, "--robot", "large"), "HEIGHT,RADIUS")


@pytest.mark.parametrize(
    ("change", "reason"),
    [
        ("image: ../l.pgm", "image: expected the name of a file beside it"),
        ("resolution: .nan", "resolution: expected a number"),
        ("origin: [0, 0]", "an origin of three numbers"),
    ],
)
def test_damaged_ros_maps(tmp_path: Path, change: str, reason: str) -> None:
    file, name = ros_map(tmp_path), change.split(":")[0]
    lines = [change if line.startswith(name + ":") else line for line in file.read_text().splitlines()]
    file.write_text("\n".join(lines))
    with pytest.raises(FormatError, match=reason):
        read_ros_map(file)


def test_cut_off_images(tmp_path: Path) -> None:
    file = ros_map(tmp_path)
    image = tmp_path / "l.pgm"
    image.write_bytes(image.read_bytes()[:-1])
    with pytest.raises(FormatError, match="cut off"):
        read_ros_map(file)


def test_a_robot_under_a_table(tmp_path: Path) -> None:
    """What is higher than the robot is no obstacle."""
    table = Room((4.0, 2.0, 2.0), (Column((2.0, 1.0), (0.5, 1.2), 0.0, 0.7, 0.75, False),))
    save_tsdf(tmp_path / "tsdf.npz", room_tsdf(table, 0.05, None, Y_DOWN))
    ends = in_map(np.array([0.6, 1.0, 0.0])), in_map(np.array([3.4, 1.0, 0.0]))
    under = plan_path(tmp_path / "tsdf.npz", *ends, robot=Robot(0.5, 0.2))
    assert under.is_found and under.length == pytest.approx(2.8, abs=0.02)
    high = plan_path(tmp_path, *ends, robot=Robot(1.2, 0.2))
    assert not high.is_found and "no way" in str(high.reason)


def test_a_robot_in_words_is_the_same(volumes: Path) -> None:
    ends = in_map(START), in_map(GOAL)
    told, made = (plan_path(volumes, *ends, robot=robot) for robot in ("0.7,0.23,0.1", Robot(0.7, 0.23, 0.1)))
    assert told.asked == 0.23 and np.array_equal(told.points, made.points) and told.is_found
    with pytest.raises(ConfigError, match="HEIGHT,RADIUS"):
        plan_path(volumes, *ends, robot="0.7")
    with pytest.raises(InputError, match="goal: expected three finite numbers of metres, found kitchen"):
        plan_path(volumes, ends[0], "kitchen")  # type: ignore[arg-type]
