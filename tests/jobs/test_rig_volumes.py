# SPDX-License-Identifier: Apache-2.0
"""Volumes of a rig: all cameras in one volume, instant by instant."""

from __future__ import annotations

from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from command_line import succeed

from ggslam.jobs.volumes.live import LiveVolumes
from ggslam.jobs.volumes.point_rates import PointRates
from ggslam.runs.records.volumes import VolumesRecord
from ggslam.scene.frame import Frame
from ggslam.sequences import open_sequence
from ggslam.sequences.rig import by_instant
from ggslam.slam.result import StepReport, TrackedFrame
from ggslam.volumes.maps import VolumeMaps
from ggslam.volumes.occupancy import OccupancyMap
from ggslam.volumes.octomap_files import full_octomap
from ggslam.volumes.settings import TsdfSettings
from ggslam.volumes.tsdf import TsdfMap
from ggslam.volumes.tsdf_file import load_tsdf, tsdf_to_bytes
from ggslam.volumes.volume_settings import VolumeSettings

SETTINGS = VolumeSettings(tsdf=TsdfSettings(voxel=0.06, max_depth=4.0), esdf_every=1, decay_every=2)


@pytest.fixture(scope="module")
def frames(rig: Path) -> list[Frame]:
    return list(open_sequence(rig, stop=4).stream())


def test_the_volume_is_that_of_its_cameras_one_after_another(rig: Path, frames: list[Frame], tmp_path: Path) -> None:
    out = tmp_path / "out"
    said = succeed("volumes", rig, "--out", out, "--voxel", 0.06, "--occupancy", 0.2, "--stop", 4, "--no-objects")
    one_camera, occupancy = TsdfMap(TsdfSettings(voxel=0.06), points=False), OccupancyMap(0.2, SETTINGS.occupancy)
    assert len(frames) == 8 and len({frame.camera_number for frame in frames}) == 2
    for frame in frames:
        assert frame.T_world_camera is not None
        one_camera.integrate(frame.depth, frame.camera, frame.T_world_camera, frame.color)
        occupancy.insert_depth(frame.depth, frame.camera, frame.T_world_camera, free_depth=7.0)
    assert tsdf_to_bytes(load_tsdf(out / "tsdf.npz")) == tsdf_to_bytes(one_camera)
    assert (out / "occupancy.ot").read_bytes() == full_octomap(occupancy)
    count = sum(int((frame.depth > 0).sum()) for frame in frames)
    facts: Any = VolumesRecord.read(out)
    assert f"{count:,} points" in said and "points/s" in said and "ms an instant" in said
    assert facts.points["count"] == count and facts.points["per_s"] > 0


def test_weights_decay_and_distances_follow_once_an_instant(frames: list[Frame]) -> None:
    maps, slam = VolumeMaps(SETTINGS, esdf=True), Steps()
    seen: list[int] = []
    live = LiveVolumes(maps, lambda frame, T: seen.append(frame.index), objects=False)
    for together in by_instant(frames):
        slam.play(live, together)
    alone = TsdfMap(SETTINGS.tsdf)
    for number, together in enumerate(by_instant(frames)):
        for frame in together:
            assert frame.T_world_camera is not None
            alone.integrate(frame.depth, frame.camera, frame.T_world_camera, frame.color)
        if number % 2:
            alone.decay()
    assert seen == [frame.index for frame in frames]
    assert [sorted(row) for row in maps.times.rows] == [["esdf", "slam", "tsdf"]] * 4
    assert all(row["slam"] >= 0.5 for row in maps.times.rows)  # both cameras' shares of the step
    assert tsdf_to_bytes(maps.tsdf) == tsdf_to_bytes(alone)


def test_an_instant_whose_last_camera_is_lost_is_fused(frames: list[Frame]) -> None:
    maps, slam = VolumeMaps(SETTINGS), Steps()
    slam.play(LiveVolumes(maps, lambda frame, T: None, objects=False), frames[:2], lost=frames[1])
    assert len(maps.times.rows) == 1 and maps.points == int((frames[0].depth > 0).sum())


def test_rates_are_points_by_seconds() -> None:
    rates = PointRates(3_000_000, {"tsdf": 0.5, "occupancy": 1.0})
    assert rates.rate() == pytest.approx(2e6) and rates.rate("tsdf") == pytest.approx(6e6)
    assert rates.line() == "3,000,000 points, 2.0 million points/s (TSDF 6.0 million, occupancy 3.0 million)"
    assert PointRates(0, {"tsdf": 0.0}).rate() == 0


class Steps:
    """What `LiveVolumes` asks of a run of a rig at true poses."""

    def __init__(self) -> None:
        self.corrections: list[object] = []
        self.scale, self.cameras = 1.0, [None, None]
        self.mapper: Any = SimpleNamespace(keyframes=[], identity=None)
        self.frames: list[TrackedFrame] = []
        self._poses: dict[int, np.ndarray | None] = {}

    def pose_of(self, frame: TrackedFrame) -> np.ndarray:
        pose = self._poses[frame.frame_index]
        assert pose is not None
        return pose

    def play(self, live: LiveVolumes, together: list[Frame], lost: Frame | None = None) -> None:
        steps = []
        for frame in together:
            self._poses[frame.index] = frame.T_world_camera
            status = "lost" if frame is lost else "ok"
            steps.append(TrackedFrame(frame.index, frame.index, 0.0, 0, np.eye(4), 1.0, 0.0, status))
        self.frames += steps
        for frame, step in zip(together, steps, strict=True):
            live(self, frame, StepReport(step, False, 0, 0.0, 0.25))  # type: ignore[arg-type]
