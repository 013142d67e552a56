# SPDX-License-Identifier: Apache-2.0
"""Rigs on the command line: made, looked at, run, gone on with, scored, refused."""

from __future__ import annotations

import json
import shutil
from pathlib import Path

import numpy as np
import pytest
from command_line import ggslam, refuse, succeed

from ggslam.formats.trajectory import read_tum
from ggslam.jobs.progress import SilentObserver
from ggslam.jobs.run.pipeline import RunRequest, execute
from ggslam.jobs.view.viewed_run import ViewedRun
from ggslam.runs.folder import RunFolder
from ggslam.runs.recordings import SequenceRequest
from ggslam.slam.result import StepReport

FEW = ["--set", "mapping.iterations_per_frame=1", "--set", "identity.final_passes=1", "--refine", "0"]


@pytest.fixture(scope="module")
def done(rig: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A scored run of twelve instants of the rig."""
    out = tmp_path_factory.mktemp("rig") / "run"
    printed = succeed("run", rig, "--stop", 12, "--out", out, *FEW)
    assert "cameras of the rig" in printed and "timestamps do not increase" not in printed
    return out


def test_a_run_has_scores_and_poses_of_each_camera(done: Path) -> None:
    metrics = json.loads((done / "metrics.json").read_text())
    assert list(metrics["cameras"]) == ["front", "back"]
    for scores in metrics["cameras"].values():
        assert scores["images"]["held_out"]["frames"] == 1
        assert scores["images"]["held_out"]["psnr"] > 20
        assert scores["trajectory"]["ate_rmse_m"] < 0.02
    assert metrics["images"]["held_out"]["frames"] == 2
    of_rig, front, back = (
        read_tum(done / name) for name in ("trajectory.txt", "trajectories/front.txt", "trajectories/back.txt")
    )
    assert len(of_rig) == len(front) == len(back) == 12
    np.testing.assert_allclose(of_rig.T_world_camera, front.T_world_camera)
    np.testing.assert_allclose(back.timestamps - front.timestamps, 0.01, atol=1e-6)
    truth = read_tum(done / "ground_truth.txt")
    np.testing.assert_allclose(truth.timestamps, of_rig.timestamps)
    assert "held-out images of camera" in (done / "report.html").read_text()


def test_the_way_of_each_camera_is_a_line_of_its_own(done: Path) -> None:
    walks = ViewedRun(RunFolder.open(done)).walks
    assert [len(walk) for walk in walks] == [12, 12]
    steps = [float(np.linalg.norm(np.diff(walk, axis=0), axis=1).max()) for walk in walks]
    assert max(steps) < 0.08 < np.linalg.norm(walks[0][0] - walks[1][0])  # the cameras are 12 cm apart


@pytest.mark.long("six commands on one run")
def test_the_others_take_it(done: Path, rig: Path, tmp_path: Path) -> None:
    """Scores, reports, meshes, images: of each frame's own camera."""
    succeed("verify", done)
    first = (done / "metrics.json").read_text()
    succeed("eval", done)
    assert json.loads((done / "metrics.json").read_text())["cameras"] == json.loads(first)["cameras"]
    succeed("report", done)
    succeed("export", done, "--format", "mesh", "--out", tmp_path / "mesh.ply")
    succeed("export", done, "--format", "colmap", "--out", tmp_path / "colmap")
    assert len(list((tmp_path / "colmap" / "images").iterdir())) == 24
    succeed("render", done, "--frames", "2,3", "--out", tmp_path / "pictures")
    succeed("volumes", done, "--out", tmp_path / "volumes", "--voxel", "0.05")
    moved = shutil.copytree(rig, tmp_path / "moved")
    succeed("eval", done, "--sequence", moved)


class StopAt(SilentObserver):
    """Interrupts a run after a frame."""

    def __init__(self, frame: int) -> None:
        self._frame = frame

    def frame(self, report: StepReport) -> None:
        if report.frame.frame_index == self._frame:
            raise KeyboardInterrupt


@pytest.mark.parametrize("frame", [12, 13])
def test_a_run_goes_on_where_it_was_interrupted(rig: Path, tmp_path: Path, frame: int) -> None:
    """In the middle of an instant, or after it."""
    few = ["mapping.iterations_per_frame=1", "identity.enabled=false", "refine_iterations=0"]

    def request(out: str) -> RunRequest:
        return RunRequest(SequenceRequest(rig, stop=9), tmp_path / out, None, few, False, checkpoint_every=4)

    execute(request("whole"))
    assert isinstance(execute(request("cut"), StopAt(frame)).error, KeyboardInterrupt)
    succeed("run", "--resume", tmp_path / "cut")
    for name in ("trajectory.txt", "keyframes.json", "map.ply", "places.npz"):
        assert (tmp_path / "cut" / name).read_bytes() == (tmp_path / "whole" / name).read_bytes(), name
    assert len(RunFolder.open(tmp_path / "cut").keyframes().frames) == 18


def test_a_rig_is_looked_at(rig: Path) -> None:
    printed = succeed("inspect", rig, "--samples", 2)
    for words in ("rig: front, back", "24, 24 of them with frames of all cameras", "+10.0 ms after it",
                  "turned by 180.0 degrees from front"):  # fmt: skip
        assert words in printed, printed


def test_a_rig_is_made(tmp_path: Path) -> None:
    printed = succeed("synth", tmp_path / "made", "--rig", "left,30", "--frames", 2, "--width", 32, "--height", 24)
    assert "by each of left,30" in printed
    assert sorted(path.name for path in (tmp_path / "made").iterdir()) == ["left", "rig.yaml", "yaw30"]
    refuse(ggslam("synth", tmp_path / "bad", "--rig", "front,up"), "expected front, left, back, right", "'up'")
    refuse(ggslam("synth", tmp_path / "bad", "--rig", "front"), "two cameras or more")


def test_what_cannot_be_is_refused(rig: Path, tmp_path: Path) -> None:
    refuse(ggslam("run", rig, "--realtime", 10, "--out", tmp_path / "a"), "realtime_fps", "rig")
    refuse(ggslam("run", rig, "--device", "cuda", "--out", tmp_path / "a"), "device", "rig")
    assert not (tmp_path / "a").exists()
    text = (rig / "rig.yaml").read_text()
    (tmp_path / "rig.yaml").write_text(text.replace("recording: ", f"recording: {rig}/").replace("back\n", "nowhere\n"))
    refuse(ggslam("run", tmp_path / "rig.yaml", "--out", tmp_path / "a"), "rig.yaml", "nowhere")
    refuse(ggslam("run", rig, "--depth-scale", 1000, "--out", tmp_path / "a"), "--depth-scale", "rig.yaml")
