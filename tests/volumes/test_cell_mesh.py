# SPDX-License-Identifier: Apache-2.0
"""The mesh of cells on disk, part by part, is that of everything in memory: triangles, seams, pieces, file."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from paged_corridor import LENGTH, corridor, fuse, views

from ggslam.formats.mesh_files import PlyPart, write_mesh, write_ply_mesh
from ggslam.formats.triangle_mesh import read_mesh
from ggslam.scene.poses import se3_exp
from ggslam.system.tuning import overridden
from ggslam.volumes.cell_mesh import CellMeshTuning
from ggslam.volumes.maps import Paging, VolumeMaps
from ggslam.volumes.mesh import Mesh
from ggslam.volumes.mesh_parts import MeshParts


def labelled_views() -> list:
    return [replace(view, labels=np.where(view.depth < 2.5, 3, 7).astype(np.uint16)) for view in views()[:30]]


@pytest.fixture(scope="module")
def whole() -> VolumeMaps:
    maps = fuse(labelled_views())
    maps.finish()
    return maps


@pytest.fixture(scope="module")
def paged(tmp_path_factory: pytest.TempPathFactory) -> VolumeMaps:
    maps = fuse(labelled_views(), Paging(tmp_path_factory.mktemp("paged") / "cells", lambda held: 1_000_000))
    maps.finish()
    assert maps.pager is not None and len(maps.pager) > 10
    return maps


def rows(mesh: Mesh) -> list[bytes]:
    """Triangles with all that their vertices have."""
    numbers = np.concatenate([mesh.vertices + 0.0, mesh.normals + 0.0, mesh.colors, mesh.labels[:, None]], 1)
    return sorted(row.tobytes() for row in numbers.astype(np.float64)[mesh.triangles])


@pytest.mark.parametrize(("side", "min_triangles"), [(1, 20), (2, 0), (2, 900), (4, 20)])
def test_parts_are_the_whole_mesh_but_for_order(
    side: int, min_triangles: int, whole: VolumeMaps, paged: VolumeMaps
) -> None:
    expected = whole.mesh(min_triangles)
    with overridden(CellMeshTuning, side=side):
        parts = paged.mesh_parts(min_triangles)
    assert len(list(parts)) > (10 if side < 4 else 2)
    joined = parts.whole()
    assert rows(joined) == rows(expected)
    assert (parts.vertices, parts.triangles) == (len(joined.vertices), len(joined.triangles))
    assert len(joined.vertices) == len(expected.vertices)  # none is there twice
    assert len(np.unique(joined.vertices, axis=0)) == len(np.unique(expected.vertices, axis=0))
    assert parts.objects == expected.objects() == [3, 7]
    for label in (3, 7):
        assert rows(parts.of_object(label)) == rows(expected.of_object(label))


def test_pieces_that_lie_in_several_boxes_count_as_one(whole: VolumeMaps, paged: VolumeMaps) -> None:
    """So that what a box has of a large surface is not taken for a speck: some boxes have less than the limit of it."""
    with overridden(CellMeshTuning, side=1):
        kept = paged.mesh_parts(900)
    assert min(len(part.mesh.triangles) for part in kept) < 900
    assert 0 < kept.triangles == len(whole.mesh(900).triangles) < len(whole.mesh().triangles)


def test_vertices_are_numbered_in_the_order_of_parts(paged: VolumeMaps) -> None:
    after = 0
    for part in paged.mesh_parts(20):
        new = part.numbers[part.first]
        assert np.array_equal(new, after + np.arange(len(new))) and (part.numbers[~part.first] < after).all()
        after += len(new)


def test_a_sample_is_spread_evenly(paged: VolumeMaps) -> None:
    parts = paged.mesh_parts(20)
    points, normals = parts.sample(500)
    assert 250 < len(points) <= 500 and len(normals) == len(points)
    counts = (
        np.histogram(points[:, 0], 7, (0, LENGTH))[0] / np.histogram(parts.whole().vertices[:, 0], 7, (0, LENGTH))[0]
    )
    assert counts.max() / counts.min() < 1.6
    assert np.abs(corridor().distance(points.astype(float))).max() < 0.2
    assert len(parts.sample(10**9)[0]) == parts.vertices


def test_a_file_written_in_parts_is_that_of_the_whole(paged: VolumeMaps, tmp_path: Path) -> None:
    parts = paged.mesh_parts(20)
    mesh = parts.whole()

    def pieces() -> list[PlyPart]:
        return [
            PlyPart(p.mesh.vertices[p.first], p.numbers[p.mesh.triangles], p.mesh.normals[p.first],
                    p.mesh.colors[p.first], p.mesh.labels[p.first]) for p in parts
        ]  # fmt: skip

    write_ply_mesh(tmp_path / "parts.ply", lambda: iter(pieces()), parts.vertices, parts.triangles)
    write_mesh(tmp_path / "whole.ply", mesh.vertices, mesh.triangles, mesh.normals, mesh.colors, mesh.labels)
    assert (tmp_path / "parts.ply").read_bytes() == (tmp_path / "whole.ply").read_bytes()
    found = read_mesh(tmp_path / "parts.ply")
    assert found is not None and len(found.triangles) == parts.triangles


def test_far_from_zero_all_parts_have_doubles(tmp_path: Path) -> None:
    """Also those that lie near enough for single precision: a file has one type."""
    near, far = np.eye(3, dtype=np.float64) * 900, np.eye(3, dtype=np.float64) * 123_456.789
    triangle = np.array([[0, 1, 2]])
    parts = [PlyPart(near, triangle), PlyPart(far, triangle + 3)]
    write_ply_mesh(tmp_path / "far.ply", lambda: iter(parts), 6, 2)
    found = read_mesh(tmp_path / "far.ply")
    assert found is not None and np.array_equal(found.vertices, np.concatenate([near, far]))


def test_in_another_frame_parts_are_moved(paged: VolumeMaps) -> None:
    T = se3_exp(np.array([0.3, -2.0, 1.0, 0.2, 0.1, -0.4]))
    moved = paged.mesh_parts(20).apply(lambda mesh: mesh.in_frame(T)).whole()
    expected = paged.mesh_parts(20).whole().in_frame(T)
    assert np.abs(moved.vertices - expected.vertices).max() < 1e-6
    assert np.array_equal(moved.triangles, expected.triangles)


def test_of_nothing_there_is_no_mesh(paged: VolumeMaps) -> None:
    none = paged.mesh_parts(10**9)
    assert (none.vertices, none.triangles, none.objects) == (0, 0, []) and not len(none.whole().vertices)
    empty = MeshParts.of(fuse([]).mesh())
    assert not len(empty.sample(5)[0]) and empty.triangles == 0
