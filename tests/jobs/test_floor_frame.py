# SPDX-License-Identifier: Apache-2.0
"""Files for ROS lie in one frame, with z = 0 on the floor: measured in an exact room whose map lies askew."""

from __future__ import annotations

import re
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
import pytest
import yaml
from command_line import ggslam, refuse, succeed
from scipy.spatial import cKDTree
from scipy.spatial.transform import Rotation

from ggslam.formats.triangle_mesh import read_mesh
from ggslam.volumes.occupancy import OccupancyMap
from ggslam.volumes.octomap_files import read_octomap

HALF, TOP = np.array([2.0, 1.5]), 2.4
"""The room: half its length and width, and the height of its ceiling, metres. In its middle is the floor's origin."""
BOX_LOW, BOX_HIGH = np.array([0.9, -0.3, 0.0]), np.array([1.4, 0.4, 0.7])
WIDTH, HEIGHT, FOCAL = 128, 96, 80.0
SCALE = 10_000
"""Units of depth a metre: a tenth of a millimetre each."""
VOXEL, CELL = 0.04, 0.08
T_MAP_ROOM = np.eye(4)
T_MAP_ROOM[:3, :3] = Rotation.from_euler("xyz", (97.0, 4.0, 31.0), degrees=True).as_matrix()
T_MAP_ROOM[:3, 3] = (0.3, 1.3, -0.7)


def poses() -> np.ndarray:
    """T_room_camera [n, 4, 4] of a camera 1.2 m up that turns about itself twice, looking down and level."""
    out = []
    for pitch in (28.0, 2.0):
        for yaw in np.arange(0.0, 360.0, 30.0):
            T = np.eye(4)
            level = np.array([[0.0, 0, 1], [-1, 0, 0], [0, -1, 0]])  # looks along x, its y axis down
            T[:3, :3] = Rotation.from_euler("ZY", (yaw, pitch), degrees=True).as_matrix() @ level
            T[:3, 3] = (-0.4, 0.1, 1.2)
            out.append(T)
    return np.stack(out)


def depth_of(T: np.ndarray) -> np.ndarray:
    """Depth [H, W] of the room and the box in it, metres, from a camera at T_room_camera."""
    v, u = np.mgrid[:HEIGHT, :WIDTH]
    rays = np.stack([(u - 63.5) / FOCAL, (v - 47.5) / FOCAL, np.ones(u.shape)], -1) @ T[:3, :3].T
    with np.errstate(divide="ignore"):
        low, high = ((np.array(side) - T[:3, 3]) / rays for side in ((*-HALF, 0.0), (*HALF, TOP)))
        wall = np.maximum(low, high).min(-1)
        low, high = ((side - T[:3, 3]) / rays for side in (BOX_LOW, BOX_HIGH))
    enter, leave = np.minimum(low, high).max(-1), np.maximum(low, high).min(-1)
    return np.where((enter < leave) & (enter > 0), np.minimum(enter, wall), wall)


@pytest.fixture(scope="module")
def askew(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("askew") / "room"
    for name in ("rgb", "depth"):
        (folder / name).mkdir(parents=True)
    rows = ""
    for i, T in enumerate(poses()):
        color = np.random.default_rng(i).integers(60, 200, (HEIGHT, WIDTH, 3)).astype(np.uint8)
        assert cv2.imwrite(str(folder / "rgb" / f"{i:03d}.png"), color)
        assert cv2.imwrite(str(folder / "depth" / f"{i:03d}.png"), np.rint(depth_of(T) * SCALE).astype(np.uint16))
        rows += " ".join(f"{x:.12f}" for x in (T_MAP_ROOM @ T).ravel()) + "\n"
    (folder / "poses.txt").write_text(rows)
    (folder / "camera.yaml").write_text(
        f"width: {WIDTH}\nheight: {HEIGHT}\nfx: {FOCAL}\nfy: {FOCAL}\ncx: 63.5\ncy: 47.5\ndepth_scale: {SCALE}\n"
    )
    return folder


@dataclass
class Made:
    folder: Path
    said: str
    T_map_floor: np.ndarray


def make(askew: Path, out: Path, frame: str, mesh: str) -> Made:
    words = ("--esdf", "--occupancy", CELL, "--voxel", VOXEL, "--mesh", out / mesh, "--frame", frame, "--out", out)
    out.mkdir()
    said = succeed("volumes", askew, *words)
    told = yaml.safe_load((out / "floor.yaml").read_text())
    assert (told["frame_id"], told["child_frame_id"], told["files_are_in"]) == ("map", "floor", frame)
    T, turn, place = np.eye(4), told["rotation"], told["translation"]
    T[:3, :3] = Rotation.from_quat([turn[k] for k in "xyzw"]).as_matrix()
    T[:3, 3] = [place[k] for k in "xyz"]
    assert np.abs(np.array(told["T_floor_map"]).reshape(4, 4) @ T - np.eye(4)).max() < 1e-7
    return Made(out, said, T)


@pytest.fixture(scope="module")
def level(askew: Path, tmp_path_factory: pytest.TempPathFactory) -> Made:
    return make(askew, tmp_path_factory.mktemp("level") / "volumes", "floor", "mesh.ply")


@pytest.fixture(scope="module")
def tilted(askew: Path, tmp_path_factory: pytest.TempPathFactory) -> Made:
    return make(askew, tmp_path_factory.mktemp("tilted") / "volumes", "map", "mesh.ply")


def vertices_of(made: Made) -> np.ndarray:
    mesh = read_mesh(made.folder / "mesh.ply")
    assert mesh is not None
    return mesh.vertices


def on_open_floor(points: np.ndarray, T_room_points: np.ndarray, above: float) -> np.ndarray:
    """Which points are within `above` metres of the floor, and 25 cm from walls and box."""
    room = points @ T_room_points[:3, :3].T + T_room_points[:3, 3]
    inside = (np.abs(room[:, :2]) < HALF - 0.25).all(1) & (np.abs(room[:, 2]) < above)
    box = ((room[:, :2] > BOX_LOW[:2] - 0.25) & (room[:, :2] < BOX_HIGH[:2] + 0.25)).all(1)
    return inside & ~box


def T_room_floor(made: Made) -> np.ndarray:
    return np.linalg.inv(T_MAP_ROOM) @ made.T_map_floor


def obstacles(made: Made) -> tuple[np.ndarray, np.ndarray, float]:
    """Centres [N, 2] of the occupied and free cells of map.pgm, and their edge, as map_server reads them."""
    told = yaml.safe_load((made.folder / "map.yaml").read_text())
    kind, size, most, pixels = (made.folder / told["image"]).read_bytes().split(b"\n", 3)
    width, height = map(int, size.split())
    assert (kind, most, len(pixels)) == (b"P5", b"255", width * height)
    grey = np.frombuffer(pixels, np.uint8).reshape(height, width)[::-1]
    occupancy = (255 - grey) / 255.0

    def centres(chosen: np.ndarray) -> np.ndarray:
        return np.array(told["origin"][:2]) + (np.argwhere(chosen)[:, ::-1] + 0.5) * told["resolution"]

    thresholds = (told["occupied_thresh"], told["free_thresh"])
    return centres(occupancy > thresholds[0]), centres(occupancy < thresholds[1]), float(told["resolution"])


def occupied_voxels(path: Path) -> np.ndarray:
    """Centres [N, 3] of the occupied voxels of an OctoMap file, as OctoMap reads it, where there is its binding."""
    pyoctomap = pytest.importorskip("pyoctomap")
    if path.suffix == ".bt":
        tree = pyoctomap.OcTree(CELL)
        assert tree.readBinary(str(path))
    else:
        tree = pyoctomap.OcTree(CELL).read(str(path))
    found = []
    for leaf in tree.begin_leafs():
        if tree.isNodeOccupied(leaf):
            size, centre = leaf.getSize(), np.array(leaf.getCoordinate())
            steps = (np.arange(round(size / CELL)) + 0.5) * CELL - size / 2
            found.append(centre + np.stack(np.meshgrid(steps, steps, steps), -1).reshape(-1, 3))
    return np.concatenate(found)


def test_the_floor_is_found_where_it_is(level: Made, tilted: Made) -> None:
    """Within 2 mm of height and a tenth of a degree; both kinds of files tell the same."""
    T = T_room_floor(level)
    assert abs(T[2, 3]) < 0.002 and np.degrees(np.arccos(min(1.0, T[2, 2]))) < 0.1
    assert np.array_equal(level.T_map_floor, tilted.T_map_floor)
    assert np.abs(level.T_map_floor[:3, 3] @ level.T_map_floor[:3, :2]).max() < 1e-6  # below the map's origin


def test_mesh_on_the_floor(level: Made, tilted: Made) -> None:
    vertices = vertices_of(level)
    floor = vertices[on_open_floor(vertices, T_room_floor(level), 0.1)]
    assert len(floor) > 500
    assert abs(np.median(floor[:, 2])) < 0.002 and np.percentile(np.abs(floor[:, 2]), 95) < 0.008
    moved = vertices_of(tilted) @ level.T_map_floor[:3, :3] - level.T_map_floor[:3, 3] @ level.T_map_floor[:3, :3]
    assert np.abs(moved - vertices).max() < 2e-6


@pytest.mark.parametrize("ending", ["bt", "ot"])
def test_octomap_on_the_floor_and_on_the_mesh(level: Made, ending: str) -> None:
    """Voxels have a boundary at z = 0, so the floor is in the ones beside it; walls are where the mesh has them."""
    centres = occupied_voxels(level.folder / f"occupancy.{ending}")
    floor = centres[on_open_floor(centres, T_room_floor(level), 0.2)]
    assert len(floor) > 300 and (np.abs(floor[:, 2]) < CELL / 2 + 1e-6).all()
    far = cKDTree(vertices_of(level)).query(centres)[0]
    assert np.percentile(far, 95) < np.sqrt(3) / 2 * CELL + VOXEL and np.median(far) < 0.6 * CELL


def test_octomap_of_the_maps_frame_stays_there(tilted: Made) -> None:
    found = read_octomap(tilted.folder / "occupancy.bt").occupied_centers()[0]
    assert np.median(cKDTree(vertices_of(tilted)).query(found)[0]) < 0.6 * CELL


def test_ros_map_on_the_mesh(level: Made) -> None:
    """What is 0.1 to 1.5 m high in the mesh is occupied, and what is occupied beside free cells is such; walls stand
    where they stand in the room, within half a cell on the average."""
    occupied, free, cell = obstacles(level)
    vertices = vertices_of(level)
    high = vertices[(vertices[:, 2] > 0.15) & (vertices[:, 2] < 1.45)][:, :2]
    assert (cKDTree(occupied).query(high)[0] < cell).mean() > 0.99
    rim = occupied[cKDTree(free).query(occupied)[0] < 1.1 * cell]  # behind it, too, all is occupied
    assert len(rim) > 200 and (cKDTree(high).query(rim)[0] < 1.5 * cell).mean() > 0.97
    T = T_room_floor(level)
    room = np.column_stack([rim, np.zeros(len(rim))]) @ T[:3, :3].T + T[:3, 3]
    for axis in (0, 1):
        for side in (-1, 1):
            along = np.abs(room[:, 1 - axis]) < HALF[1 - axis] - 0.3
            wall = side * room[along, axis]
            wall = wall[np.abs(wall - HALF[axis]) < 0.3]
            assert len(wall) > 20 and abs(np.mean(wall) - HALF[axis]) < cell / 2


def test_the_command_that_is_printed(level: Made, tilted: Made) -> None:
    for made in (level, tilted):
        words = re.search(r"static_transform_publisher (.*)", made.said.replace("\n", " "))
        assert words is not None
        value = dict(re.findall(r"--([a-z-]+) (\S+)", words[1]))
        assert (value["frame-id"], value["child-frame-id"]) == ("map", "floor")
        T = np.eye(4)
        T[:3, :3] = Rotation.from_quat([float(value[f"q{k}"]) for k in "xyzw"]).as_matrix()
        T[:3, 3] = [float(value[k]) for k in "xyz"]
        assert np.abs(T - made.T_map_floor).max() < 1e-8


def test_live_volumes_know_the_floor_too_late(askew: Path) -> None:
    refuse(ggslam("volumes", askew, "--live", "--occupancy", 0.1, "--frame", "floor"), "--frame floor", "--live")


def test_pyoctomap_is_what_our_own_reader_reads(level: Made) -> None:
    ours: OccupancyMap = read_octomap(level.folder / "occupancy.bt")
    centres, sizes = ours.occupied_centers()
    assert len(occupied_voxels(level.folder / "occupancy.bt")) == round(float(((sizes / CELL) ** 3).sum()))
    assert len(centres)
