# SPDX-License-Identifier: Apache-2.0
"""A generated room six times as large: points, scores, meshes and volumes as of the room, six times as coarse."""

from __future__ import annotations

import json
import shutil
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import yaml
from command_line import ggslam, refuse, succeed
from scipy.spatial import cKDTree

import ggslam as library
from ggslam.formats.point_cloud import read_point_cloud
from ggslam.formats.point_ply import read_points
from ggslam.formats.voxel_cloud import join_clouds
from ggslam.geometry.scene_size import scale_of_depth, surface_reach, voxel_times
from ggslam.jobs.progress import SilentObserver
from ggslam.jobs.run.pipeline import RunRequest, execute, resume
from ggslam.runs.map_points import map_points
from ggslam.runs.recordings import SequenceRequest
from ggslam.scene.poses import inverse, transform_points
from ggslam.slam.result import StepReport
from ggslam.volumes.settings import TsdfSettings

TIMES = 6.0


@pytest.fixture(scope="module")
def hall(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The room with every length six times as large: depth by its scale, poses in their file."""
    folder = tmp_path_factory.mktemp("hall") / "hall"
    succeed("synth", folder, "--frames", 12, "--width", 160, "--height", 120, "--no-noise")
    settings = yaml.safe_load((folder / "camera.yaml").read_text())
    settings["depth_scale"] /= TIMES
    (folder / "camera.yaml").write_text(yaml.safe_dump(settings))
    lines = [line.split() for line in (folder / "poses.txt").read_text().splitlines() if not line.startswith("#")]
    scaled = [[t, *(repr(TIMES * float(v)) for v in rest[:3]), *rest[3:]] for t, *rest in lines]
    (folder / "poses.txt").write_text("".join(" ".join(row) + "\n" for row in scaled))
    return folder


@pytest.fixture(scope="module")
def run(hall: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    out = tmp_path_factory.mktemp("large") / "run"
    succeed("run", hall, "--out", out, "--set", "loops.enabled=false")
    return out


@pytest.fixture(scope="module")
def truth(hall: Path) -> cKDTree:
    """Exact depth at the true poses, in the run's world, metres."""
    sequence = library.open_sequence(hall)
    poses = sequence.ground_truth
    assert poses is not None
    seen = []
    for frame in sequence:
        points = frame.camera.back_project(frame.depth)[frame.depth > 0].astype(float)
        seen.append(transform_points(points, inverse(poses[0]) @ poses[frame.index]))
    return cKDTree(np.concatenate(seen))


def times_of(hall: Path, frames: int) -> int:
    """Of the usual depth of the first frames."""
    sequence = library.open_sequence(hall)
    depths = [sequence.frame(i).depth for i in range(frames)]
    return voxel_times(scale_of_depth(float(np.median([np.median(d[d > 0]) for d in depths]))))


def test_the_rule() -> None:
    """Rooms up to a median depth of 6 m are as they are; then a whole number of times, a 4 m depth's."""
    times = {depth: voxel_times(scale_of_depth(depth)) for depth in (0.3, 2.0, 6.0, 6.1, 12.0, 14.2, 40.0)}
    assert times == {0.3: 1, 2.0: 1, 6.0: 1, 6.1: 2, 12.0: 3, 14.2: 4, 40.0: 10}
    assert (surface_reach(1), surface_reach(4)) == (30, 40)
    usual = TsdfSettings()
    assert usual.in_scene(1.5) == usual and usual.in_scene(0.2) == usual
    large = usual.in_scene(3.55)
    assert (large.voxel, large.max_depth, large.max_weight) == (4 * usual.voxel, 4 * usual.max_depth, 1.0)
    assert usual.in_scene(3.55, voxel=False).voxel == usual.voxel
    own = TsdfSettings(voxel=0.05, max_depth=9.0)
    assert (own.in_scene(3.55).voxel, own.in_scene(3.55).max_depth) == (0.05, 9.0)
    assert usual.in_scene(1e6).voxel == 1.0


@pytest.mark.long("a run")
def test_it_is_mapped_as_well_as_a_room(run: Path) -> None:
    """With a room's range of keyframes, 13 m, and a room's weight of depth it is 16 dB, with holes."""
    metrics = json.loads((run / "metrics.json").read_text())["images"]
    assert metrics["held_out"]["psnr"] > 29 and metrics["held_out"]["depth_l1_m"] < 0.02 * TIMES
    verdict = json.loads((run / "verdict.json").read_text())
    assert verdict["sharp"]["grade"] == "good" and verdict["geometry"]["value"] > 98


class Killed(BaseException):
    """Stands for a kill that lets nothing be tidied up."""


class KillAt(SilentObserver):
    """Kills a run after a frame."""

    def __init__(self, frame: int) -> None:
        self._frame = frame

    def frame(self, report: StepReport) -> None:
        if report.frame.frame_index == self._frame:
            raise Killed


@pytest.mark.long("three runs")
def test_runs_that_go_on_keep_to_its_size(hall: Path, tmp_path: Path) -> None:
    few = ["mapping.iterations_per_frame=2", "identity.enabled=false", "refine_iterations=10"]
    request = RunRequest(SequenceRequest(hall, stop=8), overrides=few, evaluate=False, checkpoint_every=2)
    whole = execute(replace(request, out=tmp_path / "whole"))
    with pytest.raises(Killed):
        execute(replace(request, out=tmp_path / "killed"), KillAt(4))
    resumed = resume(tmp_path / "killed")
    for name in ("map.ply", "trajectory.txt", "points.ply"):
        assert (resumed.folder.path / name).read_bytes() == (whole.folder.path / name).read_bytes(), name


@pytest.mark.long("a run, refined")
def test_refining_keeps_what_is_far(run: Path, truth: cKDTree, tmp_path: Path) -> None:
    succeed("refine", run, "--out", tmp_path / "refined", "--steps", 60)
    before, after = (join_clouds(map_points(folder)).points for folder in (run, tmp_path / "refined"))
    off = [np.median(truth.query(points)[0]) for points in (before, after)]
    assert off[1] < 1.2 * off[0] and len(after) > 0.95 * len(before)


@pytest.mark.long("a run")
def test_points_are_there_and_scored(hall: Path, run: Path, truth: cKDTree) -> None:
    cloud = read_points(run / "points.ply")
    assert cloud.voxel_size == pytest.approx(0.01 * times_of(hall, 12)) and times_of(hall, 12) >= 2
    off = truth.query(cloud.points)[0]
    assert np.median(off) < 0.02 * TIMES and len(cloud) > 10_000
    scores = json.loads((run / "metrics.json").read_text())["surface"]
    assert scores["median_m"] < 0.01 * TIMES and scores["measured"] > 0.9


@pytest.mark.long("a run")
def test_exports_choose_the_same_voxel(hall: Path, run: Path, tmp_path: Path) -> None:
    said = succeed("export", run, "--format", "points", "--out", tmp_path / "points")
    assert f"on a {0.01 * times_of(hall, 12):g} m grid" in said
    exported, own = (read_points(folder / "points.ply") for folder in (tmp_path / "points", run))
    np.testing.assert_array_equal(exported.points, own.points)


@pytest.mark.long("a run")
def test_volumes_reach_as_far_as_the_scene(hall: Path, run: Path, truth: cKDTree, tmp_path: Path) -> None:
    """All that was seen is within 5 % of six rooms' metre of the mesh's vertices; within a room's range nothing is."""
    succeed("volumes", run, "--out", tmp_path / "usual", "--no-objects")
    room = ("--set", "volumes.tsdf.max_depth=7.001")
    refuse(ggslam("volumes", run, "--out", tmp_path / "room", *room), "no depth from 0.1 to 7.001 m")
    usual = read_point_cloud(tmp_path / "usual" / "mesh.ply").points
    off, _ = truth.query(usual)
    assert np.median(off) < 0.02 * TIMES
    seen = cKDTree(usual).query(truth.data[::53])[0]
    assert np.mean(seen < 0.05 * TIMES) > 0.9
    said = json.loads((tmp_path / "usual" / "volumes.json").read_text())["settings"]["tsdf"]
    assert said["voxel"] == pytest.approx(0.02 * times_of(hall, 1))


@pytest.mark.long("a run")
def test_too_small_voxels_are_refused_with_some_that_work(run: Path, tmp_path: Path) -> None:
    out = tmp_path / "volumes"
    done = ggslam("volumes", run, "--voxel", 0.002, "--out", out)
    refuse(done, "voxels of 0.002 m are too small", "m works")
    works = done.stderr.rpartition(": ")[2].split()[0]
    assert 0.002 < float(works) < 0.5
    shutil.rmtree(out, ignore_errors=True)
    succeed("volumes", run, "--voxel", works, "--out", out)
    refuse(ggslam("export", run, "--format", "mesh", "--voxel", 0.002, "--out", tmp_path / "a.ply"), "m works")
    assert not (tmp_path / "a.ply").exists()
