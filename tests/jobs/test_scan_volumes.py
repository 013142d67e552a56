# SPDX-License-Identifier: Apache-2.0
"""`ggslam volumes` of laser scans in a generated world, whose surfaces are known."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from command_line import ggslam, refuse, succeed
from worlds.distance import NEAR, world_distance
from worlds.plan import make_world
from worlds.scanner import Scanner
from worlds.walk import walk
from worlds.world import World

from ggslam.formats.trajectory import write_tum
from ggslam.formats.triangle_mesh import read_mesh
from ggslam.runs.records.volumes import VolumesRecord
from ggslam.scene.poses import transform_points
from ggslam.volumes.octomap_files import read_octomap

SCANNER = Scanner(rings=64, columns=720, lowest_deg=-24.0, highest_deg=20.0, noise=0.01)


@pytest.fixture(scope="module")
def world() -> World:
    return make_world(25.0, 3)


@pytest.fixture(scope="module")
def poses(world: World) -> np.ndarray:
    return walk(world, 4.0, 1)[::4]


@pytest.fixture(scope="module")
def scans(world: World, poses: np.ndarray, tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("scans") / "walk"
    (folder / "scans").mkdir(parents=True)
    for k, T in enumerate(poses):
        np.save(folder / "scans" / f"{k:06d}.npy", SCANNER.scan(world, T, k).points)
    write_tum(folder / "trajectory.txt", 0.1 * np.arange(len(poses)), poses)
    return folder


def test_scans_become_all_volumes(world: World, poses: np.ndarray, scans: Path, tmp_path: Path) -> None:
    out = tmp_path / "out"
    said = succeed("volumes", scans, "--out", out, "--voxel", 0.06, "--esdf", "--occupancy", 0.1)
    off = np.abs(world_distance(world, read_mesh(out / "mesh.ply").vertices))
    assert len(off) > 20_000 and np.median(off) < 0.003 and np.percentile(off, 95) < 0.02  # noise of a cm
    facts: Any = VolumesRecord.read(out)
    count = sum(len(SCANNER.scan(world, T, k).points) for k, T in enumerate(poses))
    assert f"{count:,} points" in said and facts.points["count"] == count
    assert np.degrees(np.arccos(facts.up["up"][2])) < 1.0 and abs(facts.up["floor"]) < 0.03
    occupancy = read_octomap(out / "occupancy.ot")
    centers, _ = occupancy.occupied_centers()
    near = np.abs(world_distance(world, centers))
    assert near.max() < 0.1 * np.sqrt(3) / 2 + 0.06 < NEAR  # and the noise
    held = transform_points(SCANNER.scan(world, poses[0], 0).points.astype(float), poses[0])
    assert (occupancy.states(held) == 1).mean() > 0.97


def test_poses_may_stand_elsewhere(scans: Path, poses: np.ndarray, tmp_path: Path) -> None:
    """Of half of the scans, in a file of times."""
    other = tmp_path / "found.txt"
    write_tum(other, 0.1 * np.arange(0, len(poses), 2), poses[::2])
    said = succeed("volumes", scans, "--out", tmp_path / "out", "--poses", other, "--voxel", 0.1)
    facts: Any = VolumesRecord.read(tmp_path / "out")
    assert facts.frames == len(poses[::2]) and f"{len(poses) // 2} scans without a pose are left out" in said


def test_the_occupancy_map_lies_on_the_floor_if_wanted(scans: Path, world: World, tmp_path: Path) -> None:
    words = ("--out", tmp_path / "out", "--voxel", 0.1, "--occupancy", 0.1, "--frame", "floor", "--stop", 6)
    succeed("volumes", scans, *words)
    centers, _ = read_octomap(tmp_path / "out" / "occupancy.ot").occupied_centers()
    assert centers[:, 2].min() > -0.15 and centers[:, 2].max() < world.height + 0.15


def test_what_does_not_go_with_scans_is_refused(scans: Path, tmp_path: Path) -> None:
    bare = tmp_path / "bare"
    bare.mkdir()
    np.save(bare / "000000.npy", np.ones((50, 3), np.float32))
    refuse(ggslam("volumes", bare, "--out", tmp_path / "a"), "no poses", "localize")
    refuse(ggslam("volumes", scans, "--out", tmp_path / "b", "--scale", 0.5), "laser scans", "--stride")
    refuse(ggslam("volumes", scans, "--out", tmp_path / "c", "--poses", tmp_path / "none.txt"), "none.txt")
    assert not any((tmp_path / name).exists() for name in "abc")


def test_the_robots_body_behind_the_scanner_is_left_out(scans: Path, poses: np.ndarray, tmp_path: Path) -> None:
    """A mast is seen in all scans."""
    marked, mast = tmp_path / "marked", np.array([-0.5, 0.0, -0.4])
    (marked / "scans").mkdir(parents=True)
    points = mast + 0.04 * np.random.default_rng(0).uniform(-1, 1, (400, 3))
    for path in sorted((scans / "scans").iterdir()):
        np.save(marked / "scans" / path.name, np.concatenate([np.load(path), points.astype(np.float32)]))
    write_tum(marked / "trajectory.txt", 0.1 * np.arange(len(poses)), poses)
    box = ",".join(f"{value:g}" for value in (*(mast - 0.05), *(mast + 0.05)))
    left = {}
    for name, more in (("a", ()), ("b", ("--body", box))):
        succeed("volumes", marked, "--out", tmp_path / name, "--voxel", 0.1, "--occupancy", 0.1, "--stop", 1, *more)
        occupancy = read_octomap(tmp_path / name / "occupancy.ot")
        left[name] = (occupancy.states(transform_points(mast[None], poses[0])) == 1).all()
    assert left["a"] and not left["b"]
