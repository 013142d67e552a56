# SPDX-License-Identifier: Apache-2.0
"""Runs whose map is in cells on disk: what is exported, rendered and scored is that of the whole map."""

from __future__ import annotations

import json
import shutil
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
import torch
from test_segmented_runs import done, refused, votes_for, write_run

from ggslam.errors import FormatError
from ggslam.formats.gaussian_ply import read_gaussian_ply, write_gaussian_parts, write_gaussian_ply
from ggslam.formats.gaussian_rows import GaussianRows, GaussianRowsTuning
from ggslam.formats.point_ply import read_points
from ggslam.jobs.export.map_files import OBJECT_EXTRAS
from ggslam.objects.segmented_map import ObjectVotes, SegmentedMapTuning
from ggslam.reporting.pictures import IdentityColors, IdentityPictureTuning
from ggslam.runs.folder import RunFolder
from ggslam.runs.map_index import MAP_INDEX, MapInParts, write_map_index
from ggslam.runs.objects_in_parts import ObjectsInParts
from ggslam.runs.verification import accept_files
from ggslam.submaps.gaussian_cells import GaussianCells
from ggslam.submaps.grid import GridStore
from ggslam.submaps.settings import SubmapSettings
from ggslam.system.tuning import overridden


@pytest.fixture(scope="module")
def stored(shared_segmented_room: Any, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A run in cells."""
    path = tmp_path_factory.mktemp("stored")
    folder = write_run(shared_segmented_room, path / "run")
    gaussians = folder.gaussians()
    gaussians.keep(torch.arange(len(gaussians)) % 4 == 0)
    cells = GaussianCells(GridStore.create(path / "grid", SubmapSettings(spacing=0.5)), gaussians)
    like = folder.gaussians()
    cells.move_out(gaussians, cells.cells_of(gaussians))
    parts = (part for _, part in cells.parts())
    write_gaussian_parts(folder.path / "map.ply", cells.count, parts, like, OBJECT_EXTRAS)
    write_map_index(folder.path / MAP_INDEX, cells)
    labels = folder.gaussians().object_id.numpy().astype(np.uint16)
    (folder.path / "votes.npz").write_bytes(votes_for(labels).to_bytes())
    cells.store.close()
    accept_files(folder.path)
    return folder.path


@pytest.fixture
def pair(stored: Path, tmp_path: Path) -> Iterator[tuple[RunFolder, RunFolder]]:
    """A run in cells, and the same run without their index."""
    for name in ("cells", "whole"):
        shutil.copytree(stored, tmp_path / name)
    (tmp_path / "whole" / MAP_INDEX).unlink()
    accept_files(tmp_path / "whole")
    with overridden(GaussianRowsTuning, rows_at_once=700), overridden(SegmentedMapTuning, rows_at_once=500):
        yield RunFolder.open(tmp_path / "cells"), RunFolder.open(tmp_path / "whole")


def files(folder: Path) -> dict[str, bytes]:
    return {str(path.relative_to(folder)): path.read_bytes() for path in folder.rglob("*") if path.is_file()}


def test_scores_are_those_of_the_whole_map(pair: tuple[RunFolder, RunFolder]) -> None:
    cells, whole = pair
    for folder in pair:
        done("eval", folder.path, "--no-lpips", "--every", 8)
    found, expected = (json.loads((folder.path / "metrics.json").read_text()) for folder in (cells, whole))
    assert found["segmentation"]["gaussians"]["labelled"] > 100 and found["segmentation"]["all"]["miou"] > 0.5

    def compare(a: Any, b: Any) -> None:
        if isinstance(a, dict):
            assert a.keys() == b.keys()
            for name in a:
                compare(a[name], b[name])
        else:
            assert a == (pytest.approx(b, rel=1e-4) if isinstance(b, float) else b)

    for name in ("images", "segmentation", "map"):
        compare(found[name], expected[name])


def test_pictures_are_those_of_the_whole_map(pair: tuple[RunFolder, RunFolder], tmp_path: Path) -> None:
    for folder in pair:
        what = "color,depth,ids,pca"
        done("render", folder.path, "--what", what, "--frames", "0,9", "--out", tmp_path / f"to_{folder.path.name}")
    names = sorted(files(tmp_path / "to_cells"))
    assert len(names) == 9 and names == sorted(files(tmp_path / "to_whole"))
    for name in names:
        one, other = (cv2.imread(str(tmp_path / to / name)).astype(int) for to in ("to_cells", "to_whole"))
        assert (np.abs(one - other) > 2).mean() < 0.001, name


def test_only_what_a_view_needs_is_read(pair: tuple[RunFolder, RunFolder], shared_segmented_room: Any) -> None:
    cells, whole = (ObjectsInParts.of(folder) for folder in pair)
    frame = shared_segmented_room.frames[0]
    camera, T_camera_world = frame.camera, np.linalg.inv(frame.T_world_camera)
    camera = replace(camera, fx=6 * camera.fx, fy=6 * camera.fy)
    seen = cells.in_view(camera, T_camera_world).gaussians
    rows, everything = cells.map.shown_rows(), whole.in_view(camera, T_camera_world).gaussians
    assert len(seen) == len(rows) < 0.9 * len(everything) and len(everything) == len(cells.map)
    assert torch.equal(seen.means, everything.means[torch.from_numpy(rows)])
    assert cells.in_view(camera, T_camera_world).gaussians is seen
    assert cells.counts == whole.counts and sum(cells.counts.values()) == len(everything)


def test_cells_are_kept_up_to_a_bound(pair: tuple[RunFolder, RunFolder]) -> None:
    folder, _ = pair
    known = folder.map_in_parts()
    size = known.rows.like.bytes_per_gaussian
    largest = int(known.index.counts.max())
    parts = MapInParts(folder.path / "map.ply", known.index, cache_bytes=2 * largest * size)
    every = parts.cells()
    assert torch.equal(parts.read(every).means, folder.gaussians().means)
    assert 0 < sum(map(len, parts._cached.values())) <= 2 * largest
    assert torch.equal(parts.read(every[-4:]).features, known.read(every[-4:]).features)


@pytest.mark.parametrize("options", [[], ["--plain"], ["--min-opacity", "0.7"], ["--objects", "all"]])
@pytest.mark.parametrize("kind", ["ply", "segmented"])
def test_exports_do_not_depend_on_blocks(
    pair: tuple[RunFolder, RunFolder], kind: str, options: list[str], tmp_path: Path
) -> None:
    cells, whole = pair
    for folder, block, name in ((cells, 700, "a"), (whole, 1 << 30, "b")):
        with overridden(GaussianRowsTuning, rows_at_once=block):
            (tmp_path / name).mkdir()
            out = tmp_path / name / ("objects" if options[:1] == ["--objects"] and kind == "ply" else "map.ply")
            done("export", folder.path, "--format", kind, *options, "--out", out)
    assert files(tmp_path / "a") == files(tmp_path / "b") and len(files(tmp_path / "a")) > (options != ["--plain"])


def test_exports_are_those_of_the_map_in_memory(pair: tuple[RunFolder, RunFolder], tmp_path: Path) -> None:
    folder, _ = pair
    gaussians = folder.gaussians()
    gaussians.opacity_logits[::3] = -1.0  # so that some are left out
    write_gaussian_ply(folder.path / "map.ply", gaussians, OBJECT_EXTRAS)
    gaussians = folder.gaussians()
    name = folder.object_table().objects[1].id
    done("export", folder.path, "--min-opacity", 0.5, "--out", tmp_path / "all.ply")
    done("export", folder.path, "--objects", name, "--min-opacity", 0.5, "--plain", "--out", tmp_path / "one")
    gaussians.keep(gaussians.opacities >= 0.5)
    write_gaussian_ply(tmp_path / "expected.ply", gaussians, OBJECT_EXTRAS)
    assert (tmp_path / "all.ply").read_bytes() == (tmp_path / "expected.ply").read_bytes()
    gaussians.keep(gaussians.object_id == name)
    write_gaussian_ply(tmp_path / "expected.ply", gaussians)
    found = next((tmp_path / "one").glob("*.ply"))
    assert len(gaussians) > 0 and found.read_bytes() == (tmp_path / "expected.ply").read_bytes()
    assert "0.99 opaque" in str(refused("export", folder.path, "--min-opacity", 0.99, "--out", tmp_path / "none.ply"))


def test_points_are_those_of_the_whole_map(pair: tuple[RunFolder, RunFolder], tmp_path: Path) -> None:
    clouds = []
    for folder in pair:
        done("export", folder.path, "--format", "points", "--voxel", 0.03, "--out", tmp_path / folder.path.name / "out")
        cloud = read_points(tmp_path / folder.path.name / "out" / "points.ply")
        order = np.lexsort(cloud.grid.T[::-1])
        clouds.append((cloud.grid[order], cloud.colors[order].astype(int), cloud.object_id[order]))
    (grid, colors, ids), (whole, whole_colors, whole_ids) = clouds
    assert np.array_equal(grid, whole) and np.array_equal(ids, whole_ids) and np.abs(colors - whole_colors).max() <= 1
    few = ["--discs", "--min-opacity", 0.999, "--out", tmp_path / "none"]
    error = refused("export", pair[0].path, "--format", "points", *few)
    assert "no points" in str(error) and not (tmp_path / "none").exists()


def test_whole_gaussians_are_coded_the_same(pair: tuple[RunFolder, RunFolder], tmp_path: Path) -> None:
    for folder, name in zip(pair, "ab", strict=True):
        done("encode", folder.path, tmp_path / f"{name}.bin", "--preset", "splat", "--slices", 6)
    assert (tmp_path / "a.bin").read_bytes() == (tmp_path / "b.bin").read_bytes()
    done("decode", tmp_path / "a.bin", tmp_path / "a.ply")
    back = read_gaussian_ply(tmp_path / "a.ply")
    assert len(back) == len(pair[0].map_in_parts())
    assert Counts(back.object_id.numpy()) == Counts(pair[0].gaussians().object_id.numpy())


class Counts(dict[int, int]):
    """How often each value occurs."""

    def __init__(self, values: np.ndarray) -> None:
        super().__init__(zip(*(column.tolist() for column in np.unique(values, return_counts=True)), strict=True))


def test_votes_and_colors_of_parts(pair: tuple[RunFolder, RunFolder]) -> None:
    folder, _ = pair
    path = folder.path / "votes.npz"
    assert np.array_equal(ObjectVotes.labels_in_file(path), ObjectVotes.from_file(path).labels())
    gaussians = folder.gaussians()
    with overridden(IdentityPictureTuning, fitted=300):
        whole = IdentityColors(gaussians.features.numpy()[gaussians.object_id.numpy() > 0])
        parts = ObjectsInParts.of(folder).identity_colors()
    image = gaussians.features.numpy()[:64].T.reshape(16, 8, 8)
    assert np.array_equal(parts.picture(image, np.ones((8, 8))), whole.picture(image, np.ones((8, 8))))
    path.write_bytes(path.read_bytes()[:-3000])
    with pytest.raises(FormatError, match=r"votes\.npz"):
        ObjectVotes.labels_in_file(path)


def test_damage_is_named_by_its_row(pair: tuple[RunFolder, RunFolder], tmp_path: Path) -> None:
    gaussians = pair[0].gaussians()
    gaussians.means[1500, 1] = torch.nan
    write_gaussian_ply(tmp_path / "map.ply", gaussians)
    with pytest.raises(FormatError, match=r"map\.ply.*'y'.*1500"):
        list(GaussianRows(tmp_path / "map.ply").blocks())


def test_other_encodings_are_read_whole(tmp_path: Path, pair: tuple[RunFolder, RunFolder]) -> None:
    names = [*"xyz", "f_dc_0", "f_dc_1", "f_dc_2", "opacity", *(f"scale_{i}" for i in range(3))]
    names += [f"rot_{i}" for i in range(4)]
    header = ["ply", "format ascii 1.0", "element vertex 2", *(f"property float {name}" for name in names)]
    numbers = ["1 2 3 0 0 0 1 -3 -3 -3 1 0 0 0", "4 5 6 0 0 0 1 -3 -3 -3 1 0 0 0"]
    (tmp_path / "text.ply").write_text("\n".join([*header, "end_header", *numbers, ""]))
    rows = GaussianRows(tmp_path / "text.ply")
    assert len(rows) == 2 and rows.read(1, 1).means.tolist() == [[4, 5, 6]] and len(rows.like) == 0
    with pytest.raises(FormatError, match=r"none\.ply"):
        GaussianRows(tmp_path / "none.ply")
    index = json.loads((pair[0].path / MAP_INDEX).read_text())
    index["cells"].pop()
    (pair[0].path / MAP_INDEX).write_text(json.dumps(index))
    with pytest.raises(FormatError, match=r"map\.ply.*9277.*map_cells\.json"):
        pair[0].map_in_parts()
