# SPDX-License-Identifier: Apache-2.0
"""The sample recording in assets/: what its maker makes, and good enough to try ggslam on."""

from __future__ import annotations

import json
from pathlib import Path

import cv2
import numpy as np
import pytest
from command_line import succeed

from ggslam.sequences import open_sequence
from ggslam.synthetic.writer import write_synthetic_sequence

SAMPLE = Path(__file__).parents[1] / "assets" / "sample"


@pytest.mark.long("the room is rendered anew")
def test_the_sample_is_the_generated_room(tmp_path: Path) -> None:
    sample, room = open_sequence(SAMPLE), open_sequence(
        write_synthetic_sequence(tmp_path / "room", frames=len(open_sequence(SAMPLE)), noise=False)
    )  # fmt: skip
    assert sample.camera == room.camera and sample.instance_names == room.instance_names and len(sample) >= 16
    for ours, true in zip(sample, room, strict=True):
        assert ours.T_world_camera is not None and true.T_world_camera is not None
        assert np.abs(ours.depth - true.depth).max() < 2e-4  # the room's depth is stored in tenths of a millimetre
        assert np.abs(ours.T_world_camera - true.T_world_camera).max() < 1e-8
        assert cv2.PSNR(ours.color, true.color) > 33
        assert ours.mask is not None and true.mask is not None and (ours.mask == true.mask).all()


@pytest.mark.long("runs the whole program on the sample")
def test_the_sample_runs(tmp_path: Path) -> None:
    succeed("run", SAMPLE, "--out", tmp_path / "run")
    folder = tmp_path / "run"
    metrics = json.loads((folder / "metrics.json").read_text())
    assert metrics["trajectory"]["ate_rmse_m"] < 0.002
    assert metrics["images"]["held_out"]["psnr"] > 30
