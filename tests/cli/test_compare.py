# SPDX-License-Identifier: Apache-2.0
"""`ggslam compare` on a small run, an altered copy of it, clouds and meshes."""

from __future__ import annotations

import json
import shutil
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from kept import points_in_voxels_of
from typer.testing import CliRunner, Result

from ggslam.cli.main import app
from ggslam.errors import GgslamError
from ggslam.formats.ply import write_ply
from ggslam.formats.point_cloud import read_point_cloud, write_point_cloud
from ggslam.formats.trajectory import read_tum, write_tum
from ggslam.runs.map_points import map_points
from ggslam.runs.verification import accept_files
from ggslam.scene.poses import se3_exp

T_SHIFT = se3_exp(np.array([0.03, -0.01, 0.02, 0.01, 0.02, -0.01]))


def ggslam(*arguments: object) -> Result:
    """The command line within this process; an error of ours is in `exception`."""
    return CliRunner().invoke(app, [str(argument) for argument in arguments], env={"COLUMNS": "120"})


def compared(*arguments: object, out: Path) -> tuple[dict[str, Any], str]:
    result = ggslam("compare", *arguments, "--out", out / "found.json")
    assert result.exit_code == 0 and result.exception is None, (result.output, result.exception)
    return json.loads((out / "found.json").read_text()), result.output


def one_error(result: Result, *words: str) -> None:
    assert isinstance(result.exception, GgslamError) and result.exception.exit_code == 2, result
    assert all(word in str(result.exception) for word in words), str(result.exception)


@pytest.fixture(scope="module")
def run(room: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    out = tmp_path_factory.mktemp("compared") / "room"
    part = ["--stop", 6, "--scale", 0.5, "--iterations", 1, "--set", "masks.source=none", "--no-eval"]
    with points_in_voxels_of(0.01):  # by finer steps than it will be moved
        assert ggslam("run", room, "--out", out, *part).exception is None
    assert ggslam("eval", out, "--no-lpips", "--every", 4).exception is None
    cloud = read_point_cloud(out / "points.ply")
    write_point_cloud(out / "points.ply", cloud.points[:: len(cloud) // 60_000], {})
    accept_files(out)
    return out


@pytest.fixture(scope="module")
def shifted(run: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The run with its world moved by `T_SHIFT`, without scores."""
    other = Path(shutil.copytree(run, tmp_path_factory.mktemp("shifted") / "room"))
    (other / "metrics.json").unlink()
    cloud, trajectory = read_point_cloud(run / "points.ply"), read_tum(run / "trajectory.txt")
    write_point_cloud(other / "points.ply", cloud.points @ T_SHIFT[:3, :3].T + T_SHIFT[:3, 3], {})
    write_tum(other / "trajectory.txt", trajectory.timestamps, T_SHIFT @ trajectory.T_world_camera)
    accept_files(other)
    return other


def test_a_run_against_itself(run: Path, tmp_path: Path) -> None:
    found, text = compared(run, run, out=tmp_path)
    assert found["overlap"]["a_on_b"] == {"fitness": 1.0, "inlier_rmse_m": 0.0}
    assert [t["f1"] for t in found["geometry"]["thresholds"]] == [1, 1, 1]
    assert found["trajectory"]["ate_rmse_m"] < 1e-9 and found["common_poses"] == 6
    assert found["icp"]["moved_m"] < 1e-6 and found["a"]["metrics"] == found["b"]["metrics"] is not None
    for words in ("fitness", "F1", "over 6 common frames", "PSNR held out", "ATE RMSE"):
        assert words in text


@pytest.mark.long("ICP on the clouds of two runs, twice")
@pytest.mark.parametrize("align", ["icp", "trajectory"])
def test_a_moved_run_is_brought_back(run: Path, shifted: Path, tmp_path: Path, align: str) -> None:
    loose, text = compared(shifted, run, "--align", "none", "--thresholds", "0.005 0.02", out=tmp_path)
    tight, _ = compared(shifted, run, "--align", align, "--thresholds", "0.005 0.02", out=tmp_path)
    np.testing.assert_allclose(np.array(tight["T_b_a"]) @ T_SHIFT, np.eye(4), atol=2e-4)
    assert loose["T_b_a"] == np.eye(4).tolist() and loose["icp"]["moved_m"] > 0.02
    first, second = (found["geometry"]["thresholds"][0]["f1"] for found in (loose, tight))
    assert second > 0.999 > 0.5 > first
    assert tight["geometry"]["accuracy_m"] < 1e-3 < 0.004 < loose["geometry"]["accuracy_m"]
    assert loose["icp"]["a_on_b"]["fitness"] == pytest.approx(1.0, abs=1e-3)
    assert loose["trajectory"]["ate_rmse_m"] < 1e-6  # the shape of the path is the same
    assert loose["a"]["metrics"] is None and "after ICP" in text and "PSNR" in text


T_TRUE = se3_exp(np.array([2.0, -1.0, 0.5, 0.4, 1.2, -0.8]))
"""Of the first camera in a world that true poses may be told in."""


def _with_truth(run: Path, folder: Path, T: np.ndarray = T_TRUE) -> Path:
    """A run that kept true poses, which are its own in a world of which the first camera lies at `T`."""
    other = Path(shutil.copytree(run, folder))
    trajectory = read_tum(run / "trajectory.txt")
    write_tum(other / "ground_truth.txt", trajectory.timestamps, T @ trajectory.T_world_camera)
    accept_files(other)
    return other


@pytest.mark.long("clouds of runs are compared five times")
def test_true_poses_bring_worlds_together(run: Path, shifted: Path, tmp_path: Path) -> None:
    """A cloud in the world of the true poses, and a run that began elsewhere; by default, too."""
    known = _with_truth(run, tmp_path / "known")
    cloud = read_point_cloud(run / "points.ply").points
    write_point_cloud(tmp_path / "true.ply", cloud @ T_TRUE[:3, :3].T + T_TRUE[:3, 3], {})
    found, text = compared(known, tmp_path / "true.ply", "--align", "truth", out=tmp_path)
    np.testing.assert_allclose(found["T_b_a"], T_TRUE, atol=1e-6)
    assert found["geometry"]["thresholds"][0]["f1"] > 0.99 and "by the true poses" in text
    by_default, _ = compared(known, tmp_path / "true.ply", out=tmp_path)
    assert by_default["align"] == "truth" and by_default["T_b_a"] == found["T_b_a"]
    other = _with_truth(shifted, tmp_path / "other", T_TRUE @ np.linalg.inv(T_SHIFT))
    both, _ = compared(other, known, "--align", "truth", out=tmp_path)
    np.testing.assert_allclose(np.array(both["T_b_a"]) @ T_SHIFT, np.eye(4), atol=1e-6)
    # What a run exported lies in the run's own world, whatever its true poses say.
    write_point_cloud(tmp_path / "own.ply", cloud, {})
    own, text = compared(known, tmp_path / "own.ply", out=tmp_path)
    assert own["align"] == "none" and own["geometry"]["thresholds"][0]["f1"] == 1 and "by the true" not in text


def test_what_hardly_lies_together_is_said(tmp_path: Path) -> None:
    """Two clouds a hundred metres apart: numbers, and that they mean nothing."""
    points = np.random.default_rng(0).uniform(0, 1, (400, 3))
    for name, offset in (("a.ply", 0), ("b.ply", 100)):
        write_point_cloud(tmp_path / name, points + offset, {})
    _, text = compared(tmp_path / "a.ply", tmp_path / "b.ply", "--align", "none", out=tmp_path)
    assert "hardly anything of the two lies together" in text
    _, text = compared(tmp_path / "a.ply", tmp_path / "a.ply", "--align", "none", out=tmp_path)
    assert "hardly anything" not in text


def test_nonsense_is_refused(run: Path, tmp_path: Path) -> None:
    """No true poses, true poses of another trajectory, and a registration under which nothing lies on anything."""
    other = Path(shutil.copytree(run, tmp_path / "wrong"))
    (other / "ground_truth.txt").unlink()
    accept_files(other)
    one_error(ggslam("compare", run, other, "--align", "truth"), "wrong has no ground_truth.txt")
    times = read_tum(run / "trajectory.txt").timestamps
    poses = np.tile(np.eye(4), (len(times), 1, 1))
    poses[:, 0, 3] = 5.0 * (np.arange(len(times)) % 2)
    write_tum(other / "ground_truth.txt", times, poses)
    accept_files(other)
    one_error(ggslam("compare", other, run, "--align", "truth"), "wrong", "does not fit its true poses")
    cloud = read_point_cloud(run / "points.ply").points
    write_point_cloud(tmp_path / "a.ply", cloud, {})
    one_error(ggslam("compare", tmp_path / "a.ply", tmp_path / "a.ply", "--align", "truth"), "expected a run")
    fog = np.random.default_rng(0).uniform(cloud.min(0), cloud.max(0), (3000, 3))
    write_point_cloud(tmp_path / "fog.ply", fog, {})
    one_error(ggslam("compare", tmp_path / "fog.ply", run, "--align", "icp"), "fog.ply", "by ICP", "30% needed")


def test_a_run_against_a_cloud(run: Path, tmp_path: Path) -> None:
    cloud = read_point_cloud(run / "points.ply")
    half = cloud.points[cloud.points[:, 0] < np.median(cloud.points[:, 0])]
    write_point_cloud(tmp_path / "half.pcd", half.astype(np.float32), {})
    found, text = compared(run, tmp_path / "half.pcd", out=tmp_path)
    assert found["geometry"]["thresholds"][0]["recall"] == 1
    assert 0.4 < found["geometry"]["thresholds"][0]["precision"] < 0.9
    assert found["trajectory"] is None and "trajectories: not of both" in text
    one_error(ggslam("compare", run, tmp_path / "half.pcd", "--align", "trajectory"), "half.pcd", "no trajectory")


def test_a_mesh_is_sampled(tmp_path: Path) -> None:
    """A unit square as one polygon and as two triangles, 1.5 cm apart."""
    corners = np.array([(0, 0, 0), (1, 0, 0), (1, 1, 0), (0, 1, 0)], float)
    for name, height, faces in (("low", 0.0, [[0, 1, 2, 3]]), ("high", 0.015, [[0, 1, 2], [0, 2, 3]])):
        vertex = np.zeros(4, [("x", "f4"), ("y", "f4"), ("z", "f4")])
        vertex["x"], vertex["y"], vertex["z"] = corners[:, 0], corners[:, 1], height
        face = np.zeros(len(faces), [("vertex_indices", "i4", (len(faces[0]),))])
        face["vertex_indices"] = faces
        write_ply(tmp_path / f"{name}.ply", {"vertex": vertex, "face": face})
    found, _ = compared(tmp_path / "high.ply", tmp_path / "low.ply", out=tmp_path)
    assert found["a"]["points"] == found["b"]["points"] == 10_000
    assert found["geometry"]["thresholds"][0]["f1"] == 0 and found["geometry"]["thresholds"][2]["f1"] == 1
    assert 0.0149 < found["geometry"]["accuracy_m"] < 0.018
    aligned, _ = compared(tmp_path / "high.ply", tmp_path / "low.ply", "--align", "icp", out=tmp_path)
    assert aligned["T_b_a"][2][3] == pytest.approx(-0.015, abs=1e-6)


def test_faults_are_named(run: Path, tmp_path: Path) -> None:
    one_error(ggslam("compare", run, tmp_path / "nothing"), "nothing")
    one_error(ggslam("compare", tmp_path, run), str(tmp_path), "is an empty folder")
    (tmp_path / "letter.ply").write_text("dear")
    one_error(ggslam("compare", run, tmp_path / "letter.ply"), "letter.ply")
    one_error(ggslam("compare", run, run, "--thresholds", "a,b"), "--thresholds")
    one_error(ggslam("compare", run, run, "--max-distance", "-1"), "positive distances")
    write_point_cloud(tmp_path / "far.ply", np.eye(3) + 90, {})
    one_error(ggslam("compare", run, tmp_path / "far.ply", "--align", "icp"), "far.ply", "by ICP")
    result = ggslam("compare", run, tmp_path / "far.ply")
    assert result.exit_code == 0 and "too few points of A lie near B" in result.output
    vertex = np.zeros(3, [("x", "f4"), ("y", "f4"), ("z", "f4")])
    face = np.zeros(1, [("vertex_indices", "i4", (3,))])
    face["vertex_indices"] = [[0, 1, 7]]
    write_ply(tmp_path / "bad.ply", {"vertex": vertex, "face": face})
    one_error(ggslam("compare", run, tmp_path / "bad.ply"), "bad.ply", "there are 3")
    for name in ("run.json", "map.ply"):
        assert (run / name).is_file()  # nothing was changed


@pytest.mark.long("a cloud in voxels of 1 cm")
def test_a_run_without_points_is_sampled_again(run: Path, tmp_path: Path) -> None:
    other = Path(shutil.copytree(run, tmp_path / "other"))
    (other / "points.ply").unlink()
    found, _ = compared(other, run, out=tmp_path)
    assert found["a"]["points"] == sum(map(len, map_points(other))) > 10_000
    assert found["overlap"]["b_on_a"]["fitness"] > 0.99 and found["overlap"]["a_on_b"]["fitness"] > 0.99


def test_help_has_examples() -> None:
    text = ggslam("compare", "--help").output
    assert "Examples" in text and "--align" in text
