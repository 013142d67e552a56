# SPDX-License-Identifier: Apache-2.0
"""The mesh of a TSDF."""

from __future__ import annotations

import numpy as np
import pytest
from volumes.field_maps import block_grid, box_room, field_map, plane, sphere, torus, voxel_centers

from ggslam.native.loader import NativeContext, available_instruction_sets
from ggslam.volumes.mesh import Mesh, extract_mesh
from ggslam.volumes.settings import TsdfSettings
from ggslam.volumes.tsdf import FREE_VALUE, FULL_WEIGHT, VOXELS, TsdfMap

VOXEL = 0.02


def edges(mesh: Mesh) -> tuple[np.ndarray, np.ndarray]:
    """Directed edges [3 F, 2] as (smaller, larger) vertex, and whether each runs from the larger one."""
    t = mesh.triangles
    directed = np.concatenate([t[:, [0, 1]], t[:, [1, 2]], t[:, [2, 0]]])
    return np.sort(directed, 1), directed[:, 0] > directed[:, 1]


def check_closed(mesh: Mesh) -> None:
    """Each edge has two triangles, which run along it in opposite directions; each vertex is used; areas are > 0."""
    pairs, backwards = edges(mesh)
    _, group, counts = np.unique(pairs, axis=0, return_inverse=True, return_counts=True)
    assert (counts == 2).all()
    assert (np.bincount(group.ravel(), backwards) == 1).all()
    check_sound(mesh)


def check_sound(mesh: Mesh) -> None:
    assert np.array_equal(np.unique(mesh.triangles), np.arange(len(mesh.vertices)))
    assert (areas_and_normals(mesh)[0] > 0).all()
    assert np.allclose(np.linalg.norm(mesh.normals, axis=1), 1, atol=1e-4)


def areas_and_normals(mesh: Mesh) -> tuple[np.ndarray, np.ndarray]:
    a, b, c = (mesh.vertices[mesh.triangles[:, k]].astype(np.float64) for k in range(3))
    cross = np.cross(b - a, c - a)
    return np.linalg.norm(cross, axis=1) / 2, cross


def euler(mesh: Mesh) -> int:
    return len(mesh.vertices) - len(np.unique(edges(mesh)[0], axis=0)) + len(mesh.triangles)


@pytest.mark.parametrize("free_blocks", [True, False])
def test_sphere_is_closed_and_where_it_should_be(free_blocks: bool) -> None:
    center = np.array([0.013, -0.021, 0.004])  # the sphere spans negative and positive blocks
    mesh = extract_mesh(field_map(sphere(0.3, tuple(center)), -3, 3, VOXEL, free_blocks))
    check_closed(mesh)
    assert euler(mesh) == 2
    offset = mesh.vertices - center
    distance = np.linalg.norm(offset, axis=1)
    assert np.abs(distance - 0.3).max() < 0.1 * VOXEL
    outwards = offset / distance[:, None]
    assert ((outwards * mesh.normals).sum(1) > np.cos(np.radians(3))).all()
    assert ((areas_and_normals(mesh)[1] * outwards[mesh.triangles[:, 0]]).sum(1) > 0).all()  # counter-clockwise
    assert mesh.geometry().area() == pytest.approx(4 * np.pi * 0.3**2, rel=0.01)


def test_torus_has_a_hole() -> None:
    mesh = extract_mesh(field_map(torus(0.3, 0.12), -3, 3, VOXEL))
    check_closed(mesh)
    assert euler(mesh) == 0


def test_room_is_seen_from_inside() -> None:
    mesh = extract_mesh(field_map(box_room((0.4, 0.31, 0.27)), -3, 3, VOXEL))
    check_closed(mesh)
    assert euler(mesh) == 2
    assert ((mesh.vertices * mesh.normals).sum(1) < 0).all()
    _, cross = areas_and_normals(mesh)
    assert ((mesh.vertices[mesh.triangles[:, 0]] * cross).sum(1) < 0).all()


def random_map(seed: int, zeros: bool = False) -> TsdfMap:
    """Random distances (all 256 cases appear, on both sides of every face), positive at the outer voxels."""
    rng = np.random.default_rng(seed)
    tsdf, blocks = TsdfMap(TsdfSettings(voxel=VOXEL)), block_grid(-1, 2)
    value = rng.integers(-1, 2, (len(blocks), VOXELS)) * 500 if zeros else rng.integers(
        -FREE_VALUE, FREE_VALUE + 1, (len(blocks), VOXELS)
    )  # fmt: skip
    place = voxel_centers(blocks, 1.0)
    value[((place < -7) | (place > 15)).any(-1)] = FREE_VALUE
    tsdf.write(blocks, value=value, weight=np.full(value.shape, FULL_WEIGHT))
    return tsdf


@pytest.mark.parametrize("seed, zeros", [(0, False), (1, False), (2, True)])
def test_random_fields_give_closed_meshes(seed: int, zeros: bool) -> None:
    """No two cells disagree on their face, whatever the case; distances of exactly zero do not make slivers."""
    mesh = extract_mesh(random_map(seed, zeros))
    assert len(mesh.triangles) > 10000
    check_closed(mesh)


def test_unseen_voxels_have_no_surface() -> None:
    tsdf, blocks = random_map(3), block_grid(-1, 2)
    weight = np.random.default_rng(4).choice([0, 3000, FULL_WEIGHT], (len(blocks), VOXELS), p=[0.03, 0.03, 0.94])
    tsdf.write(blocks, weight=weight)
    for min_weight, least in [(0.0, 1), (1.0, 65535 / 16)]:
        mesh = extract_mesh(tsdf, min_weight)
        check_sound(mesh)
        _, counts = np.unique(edges(mesh)[0], axis=0, return_counts=True)
        assert counts.max() == 2 and (counts == 1).any()
        unseen = np.floor(voxel_centers(blocks, 1.0)[weight < least]).astype(int)
        unknown = {tuple(v) for v in unseen}
        # The corners of a triangle's cell: from the lowest voxel that its vertices stand between.
        middle = mesh.vertices[mesh.triangles].mean(1) / VOXEL - 0.5
        corners = np.floor(middle)[:, None].astype(int) + np.stack(np.meshgrid(*3 * [[0, 1]]), -1).reshape(-1, 3)
        assert not any(tuple(v) in unknown for v in corners.reshape(-1, 3))


def test_every_cell_with_known_corners_has_its_surface() -> None:
    """Count of cut edges of cells whose corners are all known, by arrays."""
    tsdf, blocks = random_map(5), block_grid(-1, 2)
    weight = np.random.default_rng(6).choice([0, FULL_WEIGHT], (len(blocks), VOXELS), p=[0.05, 0.95])
    tsdf.write(blocks, weight=weight)
    place = np.floor(voxel_centers(blocks, 1.0)).astype(int) + 8
    inside, seen = np.zeros((24, 24, 24), bool), np.zeros((24, 24, 24), bool)
    inside[tuple(place.reshape(-1, 3).T)] = (tsdf.read(blocks).value < 0).ravel()
    seen[tuple(place.reshape(-1, 3).T)] = (weight > 0).ravel()
    known = np.ones((23, 23, 23), bool)
    for x, y, z in np.ndindex(2, 2, 2):
        known &= seen[x : 23 + x, y : 23 + y, z : 23 + z]
    padded = np.pad(known, 1)
    expected = 0
    for axis in range(3):
        a, s = np.moveaxis(inside, axis, 0), np.moveaxis(padded, axis, 0)[1:-1]
        used = s[:, :-1, :-1] | s[:, 1:, :-1] | s[:, :-1, 1:] | s[:, 1:, 1:]
        expected += ((a[1:] != a[:-1]) & used).sum()
    assert len(extract_mesh(tsdf).vertices) == expected


def test_border_to_the_unknown_is_open() -> None:
    mesh = extract_mesh(field_map(plane(np.array([0.1, 0.2, 1]), 0.03), -2, 2, VOXEL))
    _, counts = np.unique(edges(mesh)[0], axis=0, return_counts=True)
    assert counts.max() == 2
    assert euler(mesh) == 1  # one disk
    assert np.abs(mesh.vertices @ (np.array([0.1, 0.2, 1]) / np.sqrt(1.05)) - 0.03).max() < 0.01 * VOXEL


def test_colors_are_mixed_and_black_counts_for_none() -> None:
    tsdf = field_map(sphere(0.3), -3, 3, VOXEL)
    blocks = tsdf.blocks()
    at = blocks.coordinates[blocks.dense]
    mesh = extract_mesh(tsdf)
    expected = 1 + 253 * (mesh.vertices / (6 * 8 * VOXEL) + 0.5)
    assert np.abs(mesh.colors - expected).max() < 1.6
    voxels = tsdf.read(at)
    tsdf.write(at, color=np.where(voxels.value[..., None] < 0, 0, voxels.color))
    bare = extract_mesh(tsdf)
    assert np.abs(bare.colors - expected).max() < 1.6 + 253 / 48  # colour of the voxel in front, up to a voxel away
    assert (bare.colors > 1).all()


def test_meshes_of_objects_make_up_the_whole() -> None:
    tsdf = field_map(sphere(0.3), -3, 3, VOXEL)
    blocks = tsdf.blocks()
    at = blocks.coordinates[blocks.dense]
    points = voxel_centers(at, VOXEL)
    tsdf.write(at, label=np.select([points[..., 0] > 0.1, points[..., 0] < -0.1], [7, 300], 0))
    mesh = extract_mesh(tsdf)
    assert mesh.objects() == [7, 300]
    parts = [mesh.of_object(label) for label in (0, 7, 300)]
    assert sum(len(part.triangles) for part in parts) == len(mesh.triangles)
    for part in parts:
        check_sound(part)
    assert (parts[1].vertices[:, 0] > 0.1 - 2 * VOXEL).all() and (parts[2].vertices[:, 0] < -0.1 + 2 * VOXEL).all()
    assert len(mesh.of_object(5).triangles) == 0


def test_small_pieces_are_left_out() -> None:
    large, small = sphere(0.2, (-0.15, 0, 0)), sphere(0.05, (0.3, 0, 0))
    tsdf = field_map(lambda p: np.minimum(large(p), small(p)), -3, 3, VOXEL)
    whole = extract_mesh(tsdf)
    assert euler(whole) == 4
    kept = extract_mesh(tsdf, min_triangles=500)
    check_closed(kept)
    assert euler(kept) == 2 and kept.vertices[:, 0].max() < 0.06
    assert len(extract_mesh(tsdf, min_triangles=100_000).vertices) == 0


def test_threads_and_instruction_sets_do_not_matter() -> None:
    meshes = []
    for threads, isa in [(1, None), (2, None), *((2, name) for name in available_instruction_sets())]:
        meshes.append(extract_mesh(field_map(torus(0.3, 0.12), -3, 3, VOXEL, context=NativeContext(threads, isa))))
    for other in meshes[1:]:
        for name in ("vertices", "normals", "colors", "labels", "triangles"):
            assert np.array_equal(getattr(meshes[0], name), getattr(other, name)), name


def test_mesh_follows_the_map() -> None:
    tsdf = field_map(sphere(0.3), -3, 3, VOXEL)
    assert len(extract_mesh(tsdf).triangles) > 0
    tsdf.write_free(block_grid(-3, 3), np.full(216, FULL_WEIGHT))
    assert len(extract_mesh(tsdf).triangles) == 0
    tsdf.clear()
    assert len(extract_mesh(tsdf).vertices) == 0
