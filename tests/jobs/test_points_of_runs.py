# SPDX-License-Identifier: Apache-2.0
"""A run's points: how far they lie from the exact surface, and what metrics.json says of it."""

from __future__ import annotations

import json
import shutil
from pathlib import Path

import cv2
import numpy as np
import pytest
from command_line import ggslam, refuse, succeed
from kept import points_in_voxels_of
from scipy.spatial import cKDTree

import ggslam as library
from ggslam.formats.point_ply import read_points
from ggslam.formats.voxel_cloud import VoxelCloud, join_clouds
from ggslam.runs.folder import RunFolder
from ggslam.runs.map_points import map_points
from ggslam.scene.camera import Camera
from ggslam.scene.poses import inverse, transform_points


@pytest.fixture(scope="module")
def exact(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A generated room with exact depth."""
    folder = tmp_path_factory.mktemp("exact") / "room"
    size = ["--frames", 16, "--width", 160, "--height", 120, "--no-noise"]
    succeed("synth", folder, *size)
    return folder


@pytest.fixture(scope="module")
def run(exact: Path, tmp_path_factory: pytest.TempPathFactory) -> RunFolder:
    out = tmp_path_factory.mktemp("points") / "run"
    with points_in_voxels_of(0.01):
        succeed("run", exact, "--out", out, "--no-eval")
    return RunFolder.open(out)


def surface(recording: Path, run: RunFolder) -> np.ndarray:
    """Exact depth at the true poses, in the run's world."""
    sequence = library.open_sequence(recording)
    truth = sequence.ground_truth
    assert truth is not None
    seen = []
    for frame in sequence:
        points = frame.camera.back_project(frame.depth)[frame.depth > 0].astype(float)
        seen.append(transform_points(points, inverse(truth[0]) @ truth[frame.index]))
    return np.concatenate(seen)


@pytest.mark.long("a run")
def test_points_lie_on_the_exact_surface(exact: Path, run: RunFolder) -> None:
    """Discs of the same map lie several times as far off, and there are several times as many."""
    truth = cKDTree(surface(exact, run))
    cloud, discs = (join_clouds(map_points(run.path, 0.02, discs=discs)) for discs in (False, True))
    off, discs_off = truth.query(cloud.points)[0], truth.query(discs.points)[0]
    assert np.median(off) < 0.005 and np.quantile(off, 0.95) < 0.02
    assert np.median(discs_off) > 3 * np.median(off) and len(discs) > 2 * len(cloud)
    sample = truth.data[:: len(truth.data) // 20_000]
    covered = cKDTree(cloud.points).query(sample)[0]
    assert (covered < 0.03).mean() > 0.95


def seen(cloud: VoxelCloud, camera: Camera, T_world_camera: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Which point each pixel shows, the nearest one, int64 [n], and the pixels that show one, bool [H, W]."""
    points = transform_points(cloud.points, inverse(T_world_camera))
    row, column, inside = camera.project(points, 0.05)
    order = np.flatnonzero(inside)[np.argsort(-points[inside, 2], kind="stable")]
    shown = np.full((camera.height, camera.width), -1)
    shown[row[order], column[order]] = order
    return shown[shown >= 0], shown >= 0


@pytest.mark.long("a run")
def test_points_have_the_colours_and_ids_of_what_is_seen(exact: Path, run: RunFolder) -> None:
    sequence, poses = library.open_sequence(exact), run.keyframes().poses()
    errors = []
    for discs in (False, True):
        cloud = join_clouds(map_points(run.path, 0.02, discs=discs))
        assert cloud.object_id is not None
        squares, right = [], []
        for index in (2, 7, 12):
            frame = sequence.frame(index)
            rows, shows = seen(cloud, frame.camera.scale(0.5), poses[index])
            image = cv2.resize(frame.color, shows.shape[::-1], interpolation=cv2.INTER_AREA)
            mask = frame.load_mask()
            assert mask is not None
            mask = cv2.resize(mask, shows.shape[::-1], interpolation=cv2.INTER_NEAREST)
            squares.append(np.mean((cloud.colors[rows].astype(float) - image[shows]) ** 2))
            right.append(np.mean(cloud.object_id[rows] == mask[shows]))
        errors.append((10 * np.log10(255**2 / np.mean(squares)), np.mean(right)))
    (decibels, ids), (of_discs, _) = errors
    assert decibels > 22 and decibels > of_discs + 3 and ids > 0.92


@pytest.mark.long("a run")
def test_the_two_files_are_one_cloud(run: RunFolder) -> None:
    metric, grid = read_points(run.path / "points.ply"), read_points(run.path / "points_grid.ply")
    np.testing.assert_array_equal(metric.grid, grid.grid)
    np.testing.assert_allclose(metric.origin, grid.origin)
    assert grid.offsets is None and metric.offsets is not None
    assert np.abs(metric.points - grid.points).max() <= 0.5 * metric.voxel_size * 1.001
    assert len(np.unique(grid.grid, axis=0)) == len(grid)


@pytest.mark.long("a run, scored")
def test_metrics_tell_how_far_points_are_off(exact: Path, run: RunFolder, tmp_path: Path) -> None:
    copy = Path(shutil.copytree(run.path, tmp_path / "run"))
    assert "of the measured surface" in succeed("eval", copy, "--no-lpips")
    scores = json.loads((copy / "metrics.json").read_text())["surface"]
    assert scores["points"] <= len(read_points(copy / "points.ply")) and 0.95 < scores["measured"] <= 1
    assert scores["median_m"] < 0.005 and scores["p95_m"] < 0.03
    assert scores["f1_2cm"] > 0.9 and scores["f1_1cm"] < scores["f1_2cm"]


def test_runs_without_points_are_scored_without_them(run: RunFolder, tmp_path: Path) -> None:
    copy = Path(shutil.copytree(run.path, tmp_path / "run"))
    (copy / "points.ply").unlink()
    succeed("eval", copy, "--no-lpips", "--every", 8)
    metrics = json.loads((copy / "metrics.json").read_text())
    assert metrics["surface"] is None and any("points.ply" in note for note in metrics["notes"])


def test_discs_are_asked_for(run: RunFolder, tmp_path: Path) -> None:
    some = ["--min-opacity", 0.5, "--out", tmp_path / "a.pcd"]
    refuse(ggslam("export", run.path, *some), "--discs")
    refuse(ggslam("export", run.path, "--out", tmp_path / "a.ply", "--discs"), "points, pcd")
    succeed("export", run.path, "--discs", *some)
    assert (tmp_path / "a.pcd").is_file()
