# SPDX-License-Identifier: Apache-2.0
"""Volumes of a store, cell by cell, are those of everything at once, and their seams are closed."""

from __future__ import annotations

import io
import shutil
import sqlite3
from collections import Counter
from contextlib import closing
from dataclasses import dataclass, replace
from pathlib import Path
from unittest.mock import patch

import numpy as np
import pytest
from command_line import ggslam, refuse, succeed
from little_memory import with_little_memory
from small_runs import store_of

from ggslam.errors import ConfigError
from ggslam.formats.triangle_mesh import read_mesh
from ggslam.jobs.submaps.visit_records import records_of_store
from ggslam.jobs.tasks.engines import Engine
from ggslam.jobs.volumes.cell_volumes import mesh_from_bytes
from ggslam.jobs.volumes.store_volumes import ESDF, MESH, TSDF, _Work, make_store_volumes
from ggslam.runs.folder import RunFolder
from ggslam.runs.recordings import open_recorded
from ggslam.submaps.grid import GridStore
from ggslam.submaps.store_copy import copy_store
from ggslam.volumes.esdf import DistanceField
from ggslam.volumes.mesh import Mesh, extract_mesh
from ggslam.volumes.tsdf import TsdfMap
from ggslam.volumes.volume_settings import VolumeSettings

BASE = VolumeSettings()
COARSE = replace(BASE, tsdf=replace(BASE.tsdf, voxel=0.06), esdf=replace(BASE.esdf, max_distance=0.8))


@dataclass(frozen=True)
class Both:
    """Volumes by cells, and everything at once."""

    out: Path
    tsdf: TsdfMap


@pytest.fixture(scope="module")
def store(room_run: RunFolder, tmp_path_factory: pytest.TempPathFactory) -> Path:
    return store_of(room_run, tmp_path_factory, "room-small-cells", 1.3)


@pytest.fixture(scope="module")
def both(store: Path, tmp_path_factory: pytest.TempPathFactory) -> Both:
    out, tsdf = tmp_path_factory.mktemp("volumes") / "out", TsdfMap(COARSE.tsdf)
    make_store_volumes(store, out, settings=COARSE, esdf=True, engine=Engine(workers=1))
    with GridStore.open(store) as opened:
        (record,) = records_of_store(opened)
    sequence = open_recorded(record.sequence, record.run)
    for number, T in sorted(record.poses.items()):
        frame = sequence.frame(number, masks=False)
        tsdf.integrate(frame.depth, frame.camera, T, frame.color)
    return Both(out, tsdf)


def parts(out: Path, part: str) -> list[dict[str, np.ndarray]]:
    with GridStore.open(out) as results:
        keys = [key for key in results.cells() if part in results.cell(key).parts]
        return [dict(np.load(io.BytesIO(results.get(key, part)))) for key in keys]


def triangles_of(mesh: Mesh) -> Counter[bytes]:
    """Corners with their normals and colours, bit for bit, whatever their order."""
    corners = np.concatenate([mesh.vertices + 0.0, mesh.normals + 0.0, mesh.colors.astype(np.float32)], 1)
    return Counter(row.tobytes() for row in corners[mesh.triangles])


def test_blocks_are_those_of_all_frames_at_once(both: Both) -> None:
    found = parts(both.out, TSDF)
    assert len(found) > 8 and sum(len(part["dense"]) > 0 for part in found) > 6
    blocks = both.tsdf.blocks()
    for kind, chosen in (("dense", blocks.dense), ("free", ~blocks.dense)):
        own = np.concatenate([part[kind] for part in found])
        order, wanted = np.lexsort(own.T), blocks.coordinates[chosen]
        assert np.array_equal(own[order], wanted[np.lexsort(wanted.T)])
    dense = np.concatenate([part["dense"] for part in found])
    expected = both.tsdf.read(dense)
    for name in ("value", "weight", "color"):
        assert np.array_equal(np.concatenate([part[name] for part in found]), getattr(expected, name))


def test_seams_are_closed_and_the_mesh_is_the_whole_one(both: Both) -> None:
    whole = extract_mesh(both.tsdf)
    with GridStore.open(both.out) as results:
        keys = [key for key in results.cells() if MESH in results.cell(key).parts]
        meshes = [mesh_from_bytes(results.get(key, MESH), "") for key in keys]
    assert sum(len(mesh.triangles) > 0 for mesh in meshes) > 6
    together = sum((triangles_of(mesh) for mesh in meshes), Counter())
    assert together == triangles_of(whole)
    written = read_mesh(both.out / "mesh.ply")
    assert len(written.vertices) == len(np.unique(written.vertices, axis=0))
    kept = extract_mesh(both.tsdf, min_triangles=50)
    assert len(written.triangles) == len(kept.triangles) and len(written.vertices) == len(kept.vertices)


def test_distances_are_those_of_the_whole_field(both: Both) -> None:
    field = DistanceField(both.tsdf, COARSE.esdf)
    field.update()
    found = parts(both.out, ESDF)
    coordinates = np.concatenate([part["coordinates"] for part in found])
    assert len(coordinates) == len(field) and len(np.unique(coordinates, axis=0)) == len(field)
    distance = np.concatenate([part["distance"] for part in found])
    assert np.array_equal(distance, field.read(coordinates), equal_nan=True)


def test_what_cannot_be_made_of_a_store(store: Path, room_run: RunFolder, tmp_path: Path) -> None:
    refuse(ggslam("volumes", store, "--slice", 1), "of a grid store --out, --voxel")
    refuse(ggslam("volumes", store, "--address", "auto"), "--engine ray")
    refuse(ggslam("volumes", room_run.path, "--workers", 2), "are for grid stores")
    copy_store(store, tmp_path / "other.grid")
    refuse(ggslam("volumes", store, "--out", tmp_path / "other.grid"), "another grid store", "--out")
    shutil.rmtree(tmp_path / "other.grid" / "visits")
    refuse(ggslam("volumes", tmp_path / "other.grid"), "nothing is known of the recordings")
    assert not (tmp_path / "other.grid" / "volumes").exists()


@pytest.mark.parametrize("far", [100_000, 1_000_000, 2**31 - 5])
def test_cells_anywhere_size_nothing(store: Path, tmp_path: Path, far: int) -> None:
    """An index from elsewhere: the box around its cells and the cameras is counted before anything is made of it."""
    copy_store(store, tmp_path / "far.grid")
    with closing(sqlite3.connect(tmp_path / "far.grid" / "index.sqlite")) as index, index:
        for table in ("cells", "parts"):
            index.execute(f"UPDATE {table} SET x = x + {far}")
    before = "from ggslam.jobs.volumes.store_volumes import make_store_volumes"
    ended = with_little_memory(before, "make_store_volumes(path)", tmp_path / "far.grid", 256 << 20)
    assert (ended.kind, ended.exit_code) == ("ConfigError", 2) and ended.taken < 32 << 20
    assert "far.grid: its cells reach from" in ended.message and "is the index damaged?" in ended.message
    assert not (tmp_path / "far.grid" / "volumes").exists()
    refuse(ggslam("refine", tmp_path / "far.grid", "--steps", 1), "no part of its", "gaussians.npz")
    assert not (tmp_path / "far.grid" / "refining").exists()


def test_cells_and_cameras_that_are_both_far_away(store: Path) -> None:
    """Together they span few cells, whose blocks have no coordinates."""
    with GridStore.open(store) as opened:
        far = [(x + 2**30, y, z) for x, y, z in opened.cells()]
        (record,) = records_of_store(opened)
        shift = np.zeros((4, 4))
        shift[0, 3] = 2**30 * opened.grid.spacing
        moved = record.model_copy(update={"poses": {frame: T + shift for frame, T in record.poses.items()}})
        with (
            patch.object(GridStore, "cells", return_value=far),
            pytest.raises(ConfigError, match="room-small-cells.*1073741826"),
        ):
            _Work(opened, [moved], COARSE)


def test_from_the_command_line(store: Path, tmp_path: Path) -> None:
    """Other voxels than before take the place of what is there."""
    (tmp_path / "elsewhere").mkdir()
    (tmp_path / "out").symlink_to(tmp_path / "elsewhere")  # the user's own choice
    for voxel in (0.3, 0.4):
        said = succeed("volumes", store, "--out", tmp_path / "out", "--voxel", voxel, "--workers", 1)
        assert "cells" in said and read_mesh(tmp_path / "out" / "mesh.ply") is not None
        arrays = parts(tmp_path / "out", TSDF)[0]
        assert voxel in arrays["setting_values"] and not parts(tmp_path / "out", ESDF)


@pytest.mark.long("two workers that are begun")
def test_two_workers_make_the_same_and_go_on(store: Path, both: Both, tmp_path: Path) -> None:
    out = tmp_path / "out"
    make_store_volumes(store, out, settings=COARSE, esdf=True, engine=Engine(workers=2))
    for name in (TSDF, MESH, ESDF):
        for one, other in zip(parts(out, name), parts(both.out, name), strict=True):
            assert one.keys() == other.keys()
            assert all(np.array_equal(one[k], other[k], equal_nan=one[k].dtype.kind == "f") for k in one)
    assert (out / "mesh.ply").read_bytes() == (both.out / "mesh.ply").read_bytes()
    again = make_store_volumes(store, out, settings=COARSE, esdf=True)
    assert "fuse" not in again.seconds and (out / "mesh.ply").read_bytes() == (both.out / "mesh.ply").read_bytes()
