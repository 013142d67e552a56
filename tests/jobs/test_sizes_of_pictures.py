# SPDX-License-Identifier: Apache-2.0
"""Pictures of other sizes than a map was trained at."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from ggslam.formats.gaussian_ply import write_gaussian_ply
from ggslam.jobs.render.artist import Artist
from ggslam.rendering.cpu import CpuRasterizer
from ggslam.rendering.types import LOW_PASS, low_pass_at
from ggslam.reporting.pictures import color_to_uint8
from ggslam.runs.folder import RunFolder
from ggslam.runs.map_file import open_map
from ggslam.runs.records.sequence import SequenceRecord
from ggslam.scene.poses import inverse


@pytest.mark.parametrize("zoom", [0.5, 1.0, 2.0])
def test_runs_are_drawn_as_trained_and_files_by_the_rules_of_3dgs(
    room_run: RunFolder, zoom: float, tmp_path: Path
) -> None:
    gaussians, record = room_run.gaussians(), room_run.keyframes()
    pose, camera = record.keyframes[0].T_world_camera, room_run.sequence().camera.scale(zoom)
    write_gaussian_ply(tmp_path / "map.ply", gaussians)
    for folder, low_pass in ((room_run, low_pass_at(zoom)), (open_map(tmp_path / "map.ply"), LOW_PASS)):
        view = CpuRasterizer(low_pass=low_pass).forward(gaussians, camera, inverse(pose), features=False)
        picture = Artist(folder, ["color"]).pictures(camera, pose)["color"]
        assert np.abs(picture.astype(int) - color_to_uint8(view.image.numpy())).max() <= 1


def test_every_camera_of_a_rig_is_drawn_as_it_was_trained(
    room_run: RunFolder, monkeypatch: pytest.MonkeyPatch
) -> None:
    camera, pose = room_run.sequence().camera, room_run.keyframes().keyframes[0].T_world_camera
    cameras = [camera, camera.scale(0.5)]
    monkeypatch.setattr(SequenceRecord, "cameras", lambda self: cameras)
    artist = Artist(room_run, ["color"])
    for one in cameras:
        view = CpuRasterizer(low_pass=LOW_PASS).forward(room_run.gaussians(), one, inverse(pose), features=False)
        picture = artist.pictures(one, pose)["color"]
        assert np.abs(picture.astype(int) - color_to_uint8(view.image.numpy())).max() <= 1
