# SPDX-License-Identifier: Apache-2.0
"""No pass over the frames of a run writes into them; what OpenCV refuses all the same is told as our error."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import pytest
from command_line import ggslam
from read_only import locked, read_only_images

from ggslam.errors import OpenCvError, SequenceError
from ggslam.sequences import open_sequence
from ggslam.slam.slam import Slam
from ggslam.volumes.tsdf_torch import TorchTsdf

FEW = ["mapping.iterations_per_frame=1", "refine_iterations=4"]


@pytest.mark.parametrize(
    "settings",
    [["masks.source=recording"], ["masks.source=geometry"], ["tracker=features"], ["realtime_fps=15"]],
    ids=["masks of the recording", "objects by geometry", "edges and planes", "against the clock"],
)
def test_every_pass(room: Path, tmp_path: Path, settings: list[str]) -> None:
    """Tracking, movers, fixtures, shutter times, objects, loops, mapping, scores, pictures of the report."""
    words = [word for setting in [*FEW, *settings] for word in ("--set", setting)]
    with read_only_images() as delivered:
        done = ggslam("run", room, "--stop", 8, "--scale", 0.5, *words, "--out", tmp_path / "run")
    assert done.returncode == 0, done.stderr
    assert len(delivered) >= 8


def test_volumes_on_a_device(room: Path) -> None:
    frame = open_sequence(room).frame(0)
    with read_only_images():
        sequence = open_sequence(room, stop=2)
        fused = TorchTsdf()
        assert frame.T_world_camera is not None
        for view in sequence:
            fused.integrate(view.depth, view.camera, frame.T_world_camera, view.color, view.mask)
    assert len(fused)


def test_what_opencv_refuses(room: Path, monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    """Of a recording: the file and frame, exit code 2. In a step: the frame, exit code 1. Elsewhere: code 1."""

    def refuse(*given: object, **named: object) -> None:
        cv2.floodFill(locked(np.zeros((4, 4, 3), np.uint8)), np.zeros((6, 6), np.uint8), (0, 0), 0)

    reason = "OpenCV: floodFill: Overload resolution failed: - image marked as output argument"
    sequence = open_sequence(room)
    with monkeypatch.context() as patch:
        patch.setattr("ggslam.sequences.pixel_grid.ImageGeometry.color", refuse)
        with pytest.raises(SequenceError, match=f"room, frame 3: {reason}"):
            sequence.frame(3)
        done = ggslam("inspect", room)
        assert done.returncode == 0 and f"frame 0: {reason}" in " ".join(done.stdout.split())
        done = ggslam("run", room, "--out", tmp_path / "none")
        assert done.returncode == 2 and f"frame 0: {reason}" in " ".join(done.stderr.split())
    with monkeypatch.context() as patch:
        patch.setattr("ggslam.slam.filters.depth_edges.DepthEdges.clean", refuse)
        with pytest.raises(OpenCvError, match=f"frame 0: {reason}"):
            Slam(sequence.camera).step(sequence.frame(0))
        done = ggslam("run", room, "--stop", 3, "--out", tmp_path / "run")
        assert done.returncode == 1 and done.stderr.startswith(f"error: frame 0: {reason}")
    with monkeypatch.context() as patch:
        patch.setattr("ggslam.slam.color_poses.ColorPoses.align_last", refuse)
        done = ggslam("run", room, "--stop", 3, "--iterations", 1, "--refine", 0, "--out", tmp_path / "end")
        assert done.returncode == 1 and done.stderr.startswith(f"error: after the last frame: {reason}")
    with monkeypatch.context() as patch:
        patch.setattr("ggslam.sequences.inspection.inspect_sequence", refuse)
        done = ggslam("inspect", room)
        assert done.returncode == 1 and "this is a fault of ggslam" in done.stderr
        assert done.stderr.startswith(f"error: {reason}") and "Traceback" not in done.stderr
