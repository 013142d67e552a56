# SPDX-License-Identifier: Apache-2.0
"""Runs and what `ggslam export` makes of them, for all tests of this folder."""

from __future__ import annotations

import shutil
from collections.abc import Callable
from functools import cache
from pathlib import Path

import pytest
from foreign_readers import command_of, splat_transform_command
from splat_formats import SPLAT_FORMATS
from splat_maps import small_map

from ggslam.formats.gaussian_ply import write_gaussian_ply
from ggslam.jobs.export.export_run import export_run
from ggslam.objects.segmented_map import SegmentedMap
from ggslam.objects.table import ObjectTable
from ggslam.runs.folder import RunFolder
from ggslam.runs.map_index import MAP_INDEX
from ggslam.runs.records.run_json import RunRecord
from ggslam.runs.writing import OBJECT_FILES, write_objects
from ggslam.scene.identity import IdentityClassifier

NAMES = {1: "mug", 3: "chair \u00e4"}


@pytest.fixture(scope="session")
def splat_transform() -> list[str]:
    """PlayCanvas' program."""
    return splat_transform_command()


@pytest.fixture(scope="session")
def usd_convert_gsplat() -> list[str]:
    """NVIDIA's program (pip install usd-convert-gsplat usd-core)."""
    return command_of("usd-convert-gsplat", "GGSLAM_USD_CONVERT_GSPLAT")


@pytest.fixture(scope="session")
def run_of(room_run: RunFolder, tmp_path_factory: pytest.TempPathFactory) -> Callable[[int, bool], RunFolder]:
    """Gives runs by degree of spherical harmonics, with or without objects; their maps fill pictures."""

    @cache
    def make(degree: int, with_objects: bool) -> RunFolder:
        path = tmp_path_factory.mktemp("degrees") / f"{degree}{'_objects' * with_objects}"
        shutil.copytree(room_run.path, path)
        for name in (*OBJECT_FILES, MAP_INDEX):
            (path / name).unlink(missing_ok=True)
        if with_objects:
            classifier = IdentityClassifier.from_file(room_run.path / "classifier.npz")
            gaussians = small_map(degree, 500, -1.8, channels=room_run.gaussians().feature_channels)
            table = ObjectTable.build(gaussians, classifier, "masks", NAMES)
            write_objects(path, SegmentedMap(gaussians, classifier, table))
        else:
            write_gaussian_ply(path / "map.ply", small_map(degree, 500, -1.8))
        RunRecord.read(path).model_copy(update={"files": None}).write(path)  # the manifest knows the old map
        return RunFolder.open(path)

    return make


@pytest.fixture(scope="session")
def exported(
    run_of: Callable[[int, bool], RunFolder], tmp_path_factory: pytest.TempPathFactory
) -> Callable[[str, int, bool], Path]:
    """Gives files by format, degree and whether the run has objects."""

    @cache
    def make(kind: str, degree: int, with_objects: bool) -> Path:
        known = SPLAT_FORMATS[kind]
        known.require()
        path = tmp_path_factory.mktemp("exported") / f"map{known.suffix}"
        export_run(run_of(degree, with_objects), path, kind)
        return path

    return make
