# SPDX-License-Identifier: Apache-2.0
"""`export --up`: degrees between true up and the axis of the file that shall point up; colours turn along."""

from __future__ import annotations

import shutil
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
import torch
from command_line import ggslam, succeed
from scipy.spatial import cKDTree
from scipy.spatial.transform import Rotation
from splat_formats import SPLAT_FORMATS
from splat_maps import Splats, from_ply
from splat_rendering import Pinhole, decibels, look_at, render

from ggslam.formats.gaussian_ply import write_gaussian_ply
from ggslam.jobs.export.export_run import export_run
from ggslam.runs.folder import RunFolder
from ggslam.runs.map_index import MAP_INDEX
from ggslam.runs.records.run_json import RunRecord
from ggslam.runs.writing import OBJECT_FILES
from ggslam.scene.gaussian_map import GaussianMap

AXES = {"y": [0.0, 1, 0], "-y": [0.0, -1, 0], "z": [0.0, 0, 1]}


def rotation_of(found: np.ndarray, before: np.ndarray) -> np.ndarray:
    """R with found = R before, of points [N, 3] in the same order."""
    R, rssd = Rotation.align_vectors(found, before)
    assert rssd < 1e-3 * np.sqrt(len(found))
    return R.as_matrix()


@pytest.fixture(scope="module")
def tilted(room_run: RunFolder, tmp_path_factory: pytest.TempPathFactory) -> tuple[RunFolder, np.ndarray]:
    """A run whose map is a floor of 900 discs and clutter, and its up direction, 15 degrees from the cameras' own."""
    path = tmp_path_factory.mktemp("tilted") / "run"
    shutil.copytree(room_run.path, path)
    for name in (*OBJECT_FILES, MAP_INDEX):
        (path / name).unlink(missing_ok=True)
    poses = np.stack(list(room_run.keyframes().poses().values()))
    cameras = -poses[:, :3, 1].mean(0)
    side = np.cross(cameras, [0.3, 0.5, 1.0])
    tilt = Rotation.from_rotvec(np.radians(15) * side / np.linalg.norm(side))
    up = tilt.apply(cameras / np.linalg.norm(cameras))
    R = Rotation.align_vectors([up], [[0.0, 0, 1]])[0]
    flat = np.stack(np.meshgrid(*2 * [np.linspace(-2, 2, 30)], [-1.5]), -1).reshape(-1, 3)
    generator = torch.Generator().manual_seed(0)
    gaussians = GaussianMap(0, with_moments=False)
    turn = torch.from_numpy(np.roll(R.as_quat(), 1)).float().repeat(len(flat), 1)
    discs = torch.tensor([-3.0, -3.0, -7.0]).repeat(len(flat), 1)
    colors = torch.rand((len(flat), 3), generator=generator)
    gaussians.insert(torch.from_numpy(R.apply(flat)).float(), turn, discs, 2.0, colors)
    clutter = [torch.randn((300, width), generator=generator) for width in (3, 4, 3)]
    gaussians.insert(clutter[0], clutter[1], clutter[2] - 4, 2.0, torch.rand((300, 3), generator=generator))
    write_gaussian_ply(path / "map.ply", gaussians)
    RunRecord.read(path).model_copy(update={"files": None}).write(path)  # the manifest knows the old map
    return RunFolder.open(path), up


@pytest.mark.parametrize("axis", AXES)
def test_the_floor_is_level(axis: str, tilted: tuple[RunFolder, np.ndarray], tmp_path: Path) -> None:
    run, up = tilted
    said = succeed("export", run.path, f"--up={axis}", "--out", tmp_path / "map.ply")
    floor = from_ply(tmp_path / "map.ply").means[:900]
    normal = np.linalg.svd(floor - floor.mean(0), full_matrices=False)[2][2]  # a plane through what was written
    degrees = np.degrees(np.arccos(min(1.0, abs(float(normal @ AXES[axis])))))
    assert "by its floor" in said and degrees < 0.1
    assert ((from_ply(tmp_path / "map.ply").means[900:] - floor.mean(0)) @ AXES[axis]).mean() > 1.0  # the right way up
    R = rotation_of(floor, run.gaussians().means.numpy()[:900].astype(float))
    assert np.degrees(np.arccos(-up[1])) > 5 and R[0, 0] > 0.9  # what was right of the camera still is


@pytest.mark.parametrize("kind", [kind for kind in SPLAT_FORMATS if kind not in ("ply", "segmented")])
def test_every_format_is_turned_alike(kind: str, room_run: RunFolder, tmp_path: Path) -> None:
    known = SPLAT_FORMATS[kind]
    known.require()
    export_run(room_run, tmp_path / "map.ply", up="y")
    export_run(room_run, tmp_path / f"map{known.suffix}", kind, up="y")
    distance = cKDTree(from_ply(tmp_path / "map.ply").means).query(known.read(tmp_path / f"map{known.suffix}").means)[0]
    assert distance.max() < 2e-5 + 2 * known.position


@pytest.mark.parametrize("degree", [0, 3])
def test_colours_turn_along(degree: int, run_of: Callable[[int, bool], RunFolder], tmp_path: Path) -> None:
    run = run_of(degree, False)
    export_run(run, tmp_path / "map.ply", up="z")
    before, turned, camera = Splats.of(run.gaussians()), from_ply(tmp_path / "map.ply"), Pinhole.centred()
    pose, moved = look_at((0.5, -1.0, -5.0)), look_at((0.5, -1.0, -5.0))
    moved[:3, :3] = pose[:3, :3] @ rotation_of(turned.means, before.means.astype(float)).T
    assert decibels([render(turned, camera, moved)], [render(before, camera, pose)]) > 100


def test_what_has_its_own_up(room_run: RunFolder, tmp_path: Path) -> None:
    for axis, name, reason in (("z", "map.spz", "y upwards"), ("y", "map.pcd", "formats of Gaussians")):
        done = ggslam("export", room_run.path, "--up", axis, "--out", tmp_path / name)
        assert done.returncode == 2 and reason in done.stderr and not (tmp_path / name).exists()
