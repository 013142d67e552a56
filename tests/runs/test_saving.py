# SPDX-License-Identifier: Apache-2.0
"""Runs made from Python, and what their results tell."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

import ggslam
from ggslam.errors import ConfigError, RunFolderError, SequenceError
from ggslam.objects.lookup import objects_at
from ggslam.runs.folder import RunFolder
from ggslam.scene.gaussian_map import GaussianMap
from ggslam.slam.result import SlamResult, StepReport

SETTINGS = ["mapping.iterations_per_frame=1", "mapping.first_frame_iterations=2", "identity.final_passes=0"]

Made = tuple[ggslam.Sequence, SlamResult, list[StepReport]]


@pytest.fixture(scope="module")
def made(room: Path) -> Made:
    """Every second of twelve frames, with masks."""
    sequence = ggslam.open_sequence(room, scale=0.5)[:12:2]
    slam = ggslam.Slam(sequence.camera, ggslam.load_config(None, SETTINGS), sequence.has_masks)
    reports = [slam.step(frame) for frame in sequence]
    return sequence, slam.finish(), reports


def test_a_run_folder_like_any_other(made: Made, tmp_path: Path) -> None:
    sequence, result, _ = made
    folder = ggslam.save_run(result, tmp_path / "run", sequence)
    assert folder.config() == result.config and len(folder.trajectory()) == 6
    assert {o.name for o in folder.object_table().objects} <= set(sequence.instance_names.values())
    scores = ggslam.evaluate_run(tmp_path / "run", lpips=False)
    assert scores.trajectory is not None and scores.trajectory.ate_rmse_m is not None
    assert scores.trajectory.ate_rmse_m < 0.02 and scores.trajectory.frames_compared == 6
    assert "wrote" in ggslam.export_run(folder, tmp_path / "map.ply")
    assert len(ggslam.render_run(folder, tmp_path / "pictures", frames=[0, 5], what=["color"])) == 2
    with pytest.raises(RunFolderError, match="there is a run already"):
        ggslam.save_run(result, tmp_path / "run")


def test_frames_that_nobody_keeps(made: Made, tmp_path: Path) -> None:
    _, result, _ = made
    folder = ggslam.save_run(result, tmp_path / "run")
    assert len(folder.gaussians()) == result.gaussian_count
    assert "wrote" in ggslam.export_run(folder, tmp_path / "mesh.ply", "mesh", voxel=0.1)
    with pytest.raises(RunFolderError, match="its frames were not kept"):
        ggslam.evaluate_run(folder)


def test_nothing_to_save(room: Path, tmp_path: Path) -> None:
    slam = ggslam.Slam(ggslam.open_sequence(room).camera)
    with pytest.raises(RunFolderError, match="no keyframe"):
        ggslam.save_run(slam.finish(), tmp_path / "run")
    assert not (tmp_path / "run").exists()


def test_steps_tell_poses(made: Made) -> None:
    _, result, reports = made
    tracked = np.stack([report.T_world_camera for report in reports])
    assert np.abs(tracked - result.trajectory()).max() < 0.02 and np.array_equal(tracked[0], np.eye(4))


def test_objects_of_a_result(made: Made) -> None:
    sequence, result, _ = made
    table = result.object_table(sequence.instance_names)
    largest = max(table.objects, key=lambda record: record.gaussians)
    rows = result.gaussians.object_id == largest.id
    places = result.gaussians.means[rows & (result.gaussians.opacities > 0.2)].numpy()
    assert len(table) > 3 and (result.objects_at(places) == largest.id).all()
    assert result.objects_at(np.array([0.0, 0.0, -50.0])).tolist() == [0]


def test_objects_at() -> None:
    import torch

    gaussians = GaussianMap()
    means = torch.tensor([[0.0, 0, 0], [1, 0, 0], [1.02, 0, 0]])
    ids = torch.tensor([3, 5, 7], dtype=torch.int32)
    gaussians.insert(
        means, torch.eye(4)[:3], torch.zeros(3, 3), torch.tensor([1.0, 1, -9]), torch.zeros(3, 3), object_id=ids
    )
    found = objects_at(gaussians, np.array([[0.01, 0, 0], [1.02, 0, 0], [0.5, 0, 0]]))
    assert found.dtype == np.uint16 and found.tolist() == [3, 5, 0]
    assert objects_at(gaussians, np.array([[0.5, 0, 0]]), radius=0.6).tolist() in ([3], [5])
    assert objects_at(gaussians, np.zeros((0, 3))).tolist() == [] and not objects_at(GaussianMap(), np.ones(3)).any()
    with pytest.raises(ValueError, match="expected finite numbers"):
        objects_at(gaussians, np.array([np.nan, 0, 0]))


def test_a_whole_run_of_a_part(room: Path, tmp_path: Path) -> None:
    part = ggslam.open_sequence(room, scale=0.5)[4:8]
    outcome = ggslam.run_recording(part, tmp_path / "run", overrides=SETTINGS, evaluate=False)
    assert [frame.source_index for frame in outcome.result.frames] == [4, 5, 6, 7]
    with pytest.raises(ConfigError, match="run_recording: .*scale"):
        ggslam.run_recording(part, tmp_path / "again", scale=0.5)
    with pytest.raises(ConfigError, match="open_sequence.*strid"):
        ggslam.run_recording(room, tmp_path / "again", strid=2)
    with pytest.raises(SequenceError, match="no such folder"):
        ggslam.run_recording(tmp_path / "nothing", tmp_path / "again")


def test_a_file_is_no_run(tmp_path: Path) -> None:
    container = tmp_path / "map.ggz"
    container.write_bytes(b"PK")
    with pytest.raises(RunFolderError, match="file.*`ggslam decode`"):
        RunFolder.open(container)


def test_unknown_exports(made: Made, tmp_path: Path) -> None:
    folder = ggslam.save_run(made[1], tmp_path / "run")
    with pytest.raises(ConfigError, match="`format`: .*ply.*'stl'"):
        ggslam.export_run(folder, tmp_path / "x", "stl")
    with pytest.raises(ConfigError, match="`objects`.*`format` ply, segmented, mesh, .*, usd.*pcd"):
        ggslam.export_run(folder, tmp_path / "x", "pcd", objects="all")
