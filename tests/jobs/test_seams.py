# SPDX-License-Identifier: Apache-2.0
"""Keyframes of earlier runs: where maps meet, and where a run starts in a map."""

from __future__ import annotations

import shutil
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np

from ggslam.jobs.merge.seams import keyframes_of
from ggslam.jobs.merge.sources import joint_config
from ggslam.mapping.cpu.mapper import CpuMapper
from ggslam.mapping.finished import load_finished
from ggslam.mapping.settings import MapperSettings
from ggslam.merging.objects import UnitedObjects
from ggslam.merging.settings import MergeSettings
from ggslam.native.loader import NativeContext
from ggslam.rendering.exposure import identity_exposure
from ggslam.runs.folder import RunFolder
from ggslam.runs.recordings import open_recording_of
from ggslam.runs.starting import start_in_map
from ggslam.scene.gaussian_map import GaussianMap
from ggslam.slam.config import Config
from ggslam.slam.slam import Slam


def test_keyframes_at_seams_keep_their_exposures(room_run: RunFolder) -> None:
    """Those that are trained on are compared with the map in their own."""
    record, sequence, dark = room_run.keyframes(), open_recording_of(room_run), identity_exposure() * [0.6, 1]
    known = [k.model_copy(update={"exposure": dark if number else None}) for number, k in enumerate(record.keyframes)]
    assert len(known) > 2
    source: Any = SimpleNamespace(
        record=record.model_copy(update={"keyframes": known}), sequence=sequence, first_frame=0, first_keyframe=0,
        known=SimpleNamespace(cameras=[sequence.camera] * len(known)),
    )  # fmt: skip
    seam = np.arange(len(known)) < 2
    poses = np.stack([k.T_world_camera for k in known])
    found, trained = keyframes_of([source], [poses], [seam], False, UnitedObjects(MergeSettings().uniting))
    assert trained == [0, 1]
    assert np.array_equal([k.exposure for k in found], [identity_exposure(), *[dark] * (len(known) - 1)])
    mapper = CpuMapper(GaussianMap(), MapperSettings(), NativeContext(1))
    load_finished(mapper, mapper.map, found)
    assert mapper._exposure_of(found[0]) is None and mapper._exposure_of(found[1]) is found[1].exposure


def test_a_joint_run_fits_its_colours_if_all_runs_do() -> None:
    def source(degree: int) -> Any:
        return SimpleNamespace(folder=SimpleNamespace(config=lambda: Config(sh_degree=degree)))

    gaussians = GaussianMap(2)
    assert joint_config([source(-1), source(-1)], gaussians).fits_view_colors
    assert joint_config([source(-1), source(1)], gaussians).sh_degree == 2


def test_a_run_that_starts_in_a_map_knows_its_exposures(room_run: RunFolder, tmp_path: Path) -> None:
    shutil.copytree(room_run.path, tmp_path / "run")
    record, dark = room_run.keyframes(), identity_exposure() * [0.6, 1]
    known = [k.model_copy(update={"exposure": dark}) for k in record.keyframes]
    record.model_copy(update={"keyframes": known}).write(tmp_path / "run")
    run = RunFolder.open(tmp_path / "run")
    slam = Slam(open_recording_of(run).camera, run.config(), has_masks=True)
    start_in_map(slam, run, growing=True)
    assert np.array_equal([k.exposure for k in slam.mapper.keyframes], [dark] * len(known))
