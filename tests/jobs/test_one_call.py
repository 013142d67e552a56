# SPDX-License-Identifier: Apache-2.0
"""What commands do, in one call from Python: the same results, and mistakes named as arguments."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

import ggslam

SAMPLE = Path(__file__).parents[2] / "assets" / "sample"


@pytest.fixture(scope="module")
def run(tmp_path_factory: pytest.TempPathFactory) -> Path:
    place = tmp_path_factory.mktemp("one_call")
    outcome = ggslam.run_recording(SAMPLE, place / "run", stop=8, evaluate=False, overrides=["refine_iterations=0"])
    return outcome.folder.path


def test_a_recording_is_found_in_its_own_map(run: Path, tmp_path: Path) -> None:
    report = ggslam.localize_recording(run, SAMPLE, tmp_path / "found", stop=8, stride=2)
    summary = report.summary()
    assert summary["located_share"] == 1 and summary["frames"] == 4
    truth = ggslam.RunFolder.open(run).trajectory().T_world_camera[::2]
    found = ggslam.read_trajectory(tmp_path / "found" / "trajectory.txt").T_world_camera
    assert np.abs(found[:, :3, 3] - truth[:, :3, 3]).max() < 0.01


def test_the_mesh_of_a_run_lies_on_its_map(run: Path, tmp_path: Path) -> None:
    outcome = ggslam.fuse_volumes(run, tmp_path / "a", voxel=0.04, objects=False)
    assert {path.name for path in outcome.files} >= {"mesh.ply"} and outcome.error is None
    assert ggslam.compare_maps(tmp_path / "a" / "mesh.ply", run, "none").surface[0].median_m < 0.015
    ggslam.fuse_volumes(SAMPLE, tmp_path / "b", voxel=0.04, objects=False, stop=8)  # a recording with poses
    assert (tmp_path / "b" / "mesh.ply").is_file()


def test_a_run_refined_is_nearer_to_its_images(run: Path, tmp_path: Path) -> None:
    outcome = ggslam.refine_run(run, tmp_path / "finer")
    assert outcome.after > outcome.before + 1 and outcome.folder.path == tmp_path / "finer"


@pytest.mark.parametrize("call", (ggslam.localize_recording, ggslam.fuse_volumes))
def test_wrong_arguments_are_named(call: object, run: Path, tmp_path: Path) -> None:
    arguments = (run, SAMPLE, tmp_path / "x") if call is ggslam.localize_recording else (SAMPLE, tmp_path / "x")
    with pytest.raises(ggslam.ConfigError, match="no such argument of open_sequence in strid"):
        call(*arguments, strid=2)  # type: ignore[operator]
    assert not (tmp_path / "x").exists()
