# SPDX-License-Identifier: Apache-2.0
"""The distance field against true distances, and its updates against computing it anew."""

from __future__ import annotations

import numpy as np
import pytest
from distance_scenes import (
    Scene,
    block_range,
    box,
    box_room,
    hollow_sphere,
    plane,
    rotation,
    sphere,
    union,
    voxel_centres,
    write_scene,
)
from scipy.ndimage import distance_transform_edt

from ggslam.errors import ConfigError, InputError
from ggslam.native.loader import NativeContext, available_instruction_sets
from ggslam.volumes.esdf import DistanceField, FieldSettings, SurfaceDiscs
from ggslam.volumes.settings import TsdfSettings
from ggslam.volumes.tsdf import FREE_VALUE, FULL_WEIGHT, VOXELS, TsdfMap

VOXEL = 0.05
Corners = tuple[tuple[float, float, float], tuple[float, float, float]]
CUBE: Corners = ((-1.6, -1.6, -1.6), (1.6, 1.6, 1.6))
TURN = rotation((1, 2, 3), 25)
LOW, HIGH = (-1.1, -1.0, -1.21), (1.2, 1.03, 1.3)
SCENES: dict[str, Scene] = {
    "sphere": sphere((0.01, 0.02, 0), 0.7),
    "hollow sphere": hollow_sphere((0, 0, 0), 1.2),
    "box room": box_room(LOW, HIGH),
    "turned room": box_room(LOW, HIGH, TURN),
    "two planes": union(plane((0, 0, -1.21), (0.1, 0.2, 1)), plane((0, 0, 1.03), (-0.1, 0.1, -1))),
}


def new_map(threads: int = 2, instruction_set: str | None = None) -> TsdfMap:
    return TsdfMap(TsdfSettings(voxel=VOXEL), NativeContext(threads, instruction_set))


def true_gradient(scene: Scene, points: np.ndarray, step: float = 1e-5) -> np.ndarray:
    return np.stack([(scene(points + step * e) - scene(points - step * e)) / (2 * step) for e in np.eye(3)], -1)


def is_smooth(scene: Scene, points: np.ndarray, reach: float) -> np.ndarray:
    """Whether no place with several nearest surface points is within `reach` along the axes and diagonals."""
    steps = np.stack(np.meshgrid(*3 * [[-1, 0, 1]]), -1).reshape(-1, 3)
    steps = steps[np.abs(steps).sum(1) > 0] * reach
    here = true_gradient(scene, points)
    turned = [np.einsum("na,na->n", here, true_gradient(scene, points + s)) for s in steps]
    return np.min(turned, axis=0) > 0.9


def judged(scene: Scene, points: np.ndarray, corners: Corners, settings: FieldSettings) -> np.ndarray:
    """Where the truth is in the map: in front, the nearest surface point mapped, and not too far."""
    d = scene(points)
    foot = points - d[:, None] * true_gradient(scene, points)
    inside = ((foot > np.array(corners[0]) + VOXEL) & (foot < np.array(corners[1]) - VOXEL)).all(axis=1)
    return inside & (d > 0) & (d < settings.max_distance - VOXEL)


def angles(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    return np.degrees(np.arccos(np.clip(np.einsum("na,na->n", a, b), -1, 1)))


@pytest.mark.parametrize("name", SCENES)
def test_distances_and_gradients_are_true(name: str) -> None:
    scene, tsdf = SCENES[name], new_map()
    blocks = block_range(*CUBE, VOXEL)
    write_scene(tsdf, scene, blocks)
    field = DistanceField(tsdf)
    field.update()
    points = voxel_centres(blocks, VOXEL).reshape(-1, 3)
    points = np.concatenate([points[::6], np.random.default_rng(0).uniform(*CUBE, (10_000, 3))])
    values, truth = field.query(points), scene(points)
    held = judged(scene, points, CUBE, field.settings)
    assert values.known[held].all() and held.sum() > 8_000
    error = np.abs(values.distance - truth)[held] / VOXEL
    assert error.mean() < 0.02 and error.max() < 0.75  # a voxel's diagonal is 1.73
    held[held] = is_smooth(scene, points[held], VOXEL)
    assert held.sum() > 5_000
    angle = angles(values.gradient, true_gradient(scene, points))[held]
    assert angle.mean() < 1.5 and angle.max() < 5
    assert np.abs(values.distance - truth)[held].max() < 0.1 * VOXEL


def test_behind_a_wall_the_distance_is_negative_and_ends_where_nothing_was_seen() -> None:
    tsdf = new_map()
    write_scene(tsdf, plane((0, 0, 0.02), (0, 0, 1)), block_range((-1, -1, -1), (1, 1, 1), VOXEL))
    field = DistanceField(tsdf)
    field.update()
    z = np.arange(-0.895, 0.895, 0.01)
    values = field.query(np.stack([0 * z, 0 * z, z], -1))
    assert np.array_equal(values.known, z >= -0.2)  # voxels with centres to 0.175, within the truncation of 0.2
    known = values.known
    assert np.allclose(values.distance[known], z[known] - 0.02, atol=1e-3 * VOXEL + 1e-4)
    assert np.allclose(values.gradient[known], [0, 0, 1], atol=2e-3)
    assert np.isnan(values.distance[~known]).all() and (values.gradient[~known] == 0).all()


def distance_to_discs(discs: SurfaceDiscs, points: np.ndarray) -> np.ndarray:
    """Distances [N] of points [N, 3] from the nearest of all discs, in double precision."""
    least = np.full(len(points), np.inf)
    normals, radii = discs.normals.astype(float), discs.radii.astype(float)
    for begin in range(0, len(points), 256):
        off = points[begin : begin + 256, None] - discs.points.astype(float)
        height = np.einsum("nsa,sa->ns", off, normals)
        aside = np.sqrt(np.maximum((off**2).sum(-1) - height**2, 0))
        least[begin : begin + 256] = np.hypot(height, np.maximum(aside - radii, 0)).min(axis=1)
    return least


def random_surface() -> tuple[TsdfMap, np.ndarray]:
    """Single voxels behind surfaces, strewn at random; all blocks."""
    rng = np.random.default_rng(1)
    tsdf, blocks = new_map(), block_range((-0.8, -0.8, -0.8), (0.8, 0.8, 0.8), VOXEL)
    value = np.full((len(blocks), VOXELS), FREE_VALUE)
    value[rng.random(value.shape) < 0.01] = -8000
    tsdf.write(blocks, value=value, weight=np.full(value.shape, FULL_WEIGHT))
    return tsdf, blocks


def test_the_distance_is_that_to_the_nearest_of_all_discs() -> None:
    tsdf, blocks = random_surface()
    field = DistanceField(tsdf)
    field.update()
    discs = field.discs()
    cell = np.floor(discs.points / VOXEL).astype(int)
    assert len(np.unique(cell, axis=0)) == len(cell) > 200
    points = voxel_centres(blocks, VOXEL).reshape(-1, 3)[::7]
    distance = np.abs(field.read(blocks).reshape(-1)[::7])
    assert np.abs(distance - distance_to_discs(discs, points)).max() < 1e-4 * VOXEL
    # And the points are those of the surface: none is farther from the nearest voxel with one than half an edge.
    grid = np.ones(3 * [32], bool)
    grid[tuple((cell + 16).T)] = False
    centre = distance_transform_edt(grid)[tuple((np.floor(points / VOXEL).astype(int) + 16).T)]
    assert np.abs(distance / VOXEL - centre).max() <= 0.5 + 0.7 + 1e-3


def same_as_anew(field: DistanceField) -> None:
    """Bit by bit from the points held, and within 1/16 voxel from those that the map has now."""
    blocks = field.coordinates()
    points = voxel_centres(blocks, VOXEL).reshape(-1, 3)[::5]
    updated, gradient = field.read(blocks), field.query(points).gradient
    assert field.recompute().recomputed_blocks == len(blocks)
    assert np.array_equal(updated, field.read(blocks), equal_nan=True)
    assert np.array_equal(gradient, field.query(points).gradient)
    fresh = DistanceField(field.tsdf, field.settings)
    fresh.update()
    assert {tuple(b) for b in blocks} == {tuple(b) for b in fresh.coordinates()}
    free = fresh.read(blocks)
    assert np.array_equal(np.isnan(updated), np.isnan(free))
    assert np.nanmax(np.abs(updated - free), initial=0) <= VOXEL / 16 + 1e-6


@pytest.mark.parametrize("seed", range(3))
def test_updates_give_the_same_as_computing_anew(seed: int) -> None:
    rng = np.random.default_rng(seed)
    tsdf = new_map()
    all_blocks = block_range((-2, -2, -2), (2, 2, 2), VOXEL)
    room = box_room((-1.7, -1.8, -1.9), (1.8, 1.75, 1.6), rotation((0, 0, 1), 10 * seed))
    balls = [sphere(tuple(rng.uniform(-1.3, 1.3, 3)), rng.uniform(0.1, 0.4)) for _ in range(3)]
    write_scene(tsdf, union(room, *balls), all_blocks[rng.random(len(all_blocks)) < 0.9])
    field = DistanceField(tsdf, FieldSettings(max_distance=rng.choice([0.4, 1.0, 3.0])))
    field.update()
    shares = []
    for step in range(6):
        if step % 3 == 0:
            balls.append(sphere(tuple(rng.uniform(-1.3, 1.3, 3)), rng.uniform(0.05, 0.3)))
        else:
            balls.pop(rng.integers(len(balls)))
        middle = rng.uniform(-1.5, 1.5, 3)
        near = np.linalg.norm((all_blocks + 0.5) * 8 * VOXEL - middle, axis=1) < rng.uniform(0.5, 1.2)
        if step == 4:
            tsdf.erase(all_blocks[near])
        else:
            write_scene(tsdf, union(room, *balls), all_blocks[near])
        stats = field.update()
        shares.append(stats.recomputed_blocks / stats.blocks)
        same_as_anew(field)
    assert min(shares) < 0.95


def test_an_obstacle_that_goes_leaves_no_trace() -> None:
    tsdf, settings = new_map(), FieldSettings(max_distance=1.5)
    blocks = block_range((-2, -2, -1.2), (2, 2, 1.2), VOXEL)
    floor = plane((0, 0, -1), (0, 0, 1))
    write_scene(tsdf, floor, blocks)
    field = DistanceField(tsdf, settings)
    field.update()
    before = field.read(blocks)
    write_scene(tsdf, union(floor, sphere((0.5, 0.3, 0.2), 0.3)), blocks)
    assert field.update().recomputed_blocks > 0
    above = np.array([[0.5, 0.3, 0.6]])
    assert field.query(above).distance[0] == pytest.approx(0.1, abs=0.01)
    write_scene(tsdf, floor, blocks)
    field.update()
    assert np.array_equal(field.read(blocks), before, equal_nan=True)
    assert field.query(above).distance[0] == pytest.approx(1.5)  # the floor is 1.6 m away


def test_blocks_that_are_erased_are_unknown_and_their_surfaces_gone() -> None:
    tsdf = new_map()
    blocks = block_range((-1.2, -1.2, -1.2), (1.2, 1.2, 1.2), VOXEL)
    write_scene(tsdf, union(plane((0, 0, -1), (0, 0, 1)), plane((0, 0, 0.9), (0, 0, -1))), blocks)
    field = DistanceField(tsdf)
    field.update()
    high = blocks[:, 2] == blocks[:, 2].max()
    tsdf.erase(blocks[high])
    stats = field.update()
    assert stats.changed_blocks == high.sum() and len(field) == (~high).sum()
    values = field.query(np.array([[0, 0, 0.6], [0, 0, 0.9]]))
    assert values.known.tolist() == [True, False]
    assert values.distance[0] == pytest.approx(1.6, abs=0.01)
    same_as_anew(field)
    tsdf.clear()
    assert field.update().blocks == 0 and not field.query(np.zeros((1, 3))).known[0]


def test_updates_touch_only_what_a_change_can_reach() -> None:
    tsdf = new_map()
    blocks = block_range((-4, -4, -0.8), (4, 4, 0.8), VOXEL)
    floor = plane((0, 0, -0.5), (0, 0, 1))
    write_scene(tsdf, floor, blocks)
    field = DistanceField(tsdf)
    assert field.update().recomputed_blocks == len(blocks)
    again = field.update()
    assert again.changed_blocks == again.recomputed_blocks == 0
    write_scene(tsdf, floor, blocks)  # the same once more
    again = field.update()
    assert again.changed_blocks == len(blocks) and again.changed_sites == again.recomputed_blocks == 0
    near = np.abs((blocks[:, :2] + 0.5) * 8 * VOXEL - 2).max(axis=1) < 0.6
    write_scene(tsdf, union(floor, sphere((2, 2, -0.4), 0.2)), blocks[near])
    stats = field.update()
    assert stats.changed_sites > 0 and 0 < stats.recomputed_blocks < 0.3 * len(blocks)


def test_threads_and_instruction_sets_agree() -> None:
    results = []
    blocks = block_range((-1.2, -1.2, -1.2), (1.2, 1.2, 1.2), VOXEL)
    names: list[str | None] = [*available_instruction_sets()]
    for threads, name in [(1, None), (2, None), *((2, name) for name in names)]:
        tsdf = new_map(threads, name)
        write_scene(tsdf, box((-0.5, -0.4, -0.3), (0.5, 0.4, 0.3), TURN), blocks)
        field = DistanceField(tsdf)
        field.update()
        results.append(field.read(blocks))
    assert np.array_equal(results[0], results[1], equal_nan=True)
    for other in results[2:]:
        # Surface points are found with fused operations, which round differently.
        assert np.array_equal(np.isnan(results[0]), np.isnan(other))
        assert np.nanmax(np.abs(results[0] - other)) < 1e-4 * VOXEL


def drifting_wall(tsdf: TsdfMap, blocks: np.ndarray, shift: float) -> None:
    write_scene(tsdf, union(plane((0, 0, -0.8 + shift), (0.1, 0.2, 1)), sphere((0.3, 0, 0.5), 0.3)), blocks)


def test_points_are_held_until_they_have_moved_by_a_sixteenth_of_a_voxel() -> None:
    tsdf, blocks = new_map(), block_range((-1.2, -1.2, -1.2), (1.2, 1.2, 1.2), VOXEL)
    drifting_wall(tsdf, blocks, 0)
    field = DistanceField(tsdf)
    field.update()
    before = field.read(blocks)
    drifting_wall(tsdf, blocks, 0.05 * VOXEL)
    stats = field.update()
    # Some come and go as the wall passes from one voxel's half of an edge to the other's.
    assert stats.changed_blocks > 0 and stats.changed_sites < 0.2 * len(field.surface()[0])
    same_as_anew(field)
    moved = np.abs(field.read(blocks) - before)
    assert np.nanmean(moved > 1e-6) < 0.25
    for step in range(2, 6):
        drifting_wall(tsdf, blocks, 0.05 * step * VOXEL)
        field.update()
        same_as_anew(field)
    assert np.nanmean(np.abs(field.read(blocks) - before) > 0.1 * VOXEL) > 0.2  # the points came after the wall


def test_an_update_that_has_little_time_does_the_nearest_first_and_ends_the_rest_later() -> None:
    tsdf, blocks = new_map(1), block_range((-4, -4, -1.2), (4, 4, 1.2), VOXEL)
    write_scene(tsdf, plane((0, 0, -1), (0, 0, 1)), blocks)
    field, whole = DistanceField(tsdf), DistanceField(tsdf)
    whole.update()
    here = np.array([-3.5, -3.5, 0.0])
    stats = field.update(budget_ms=1e-3, near=here)
    assert 0 < stats.recomputed_blocks < len(blocks)
    assert stats.stale_blocks == len(blocks) - stats.recomputed_blocks
    middles = (blocks + 0.5) * 8 * VOXEL
    known = field.query(middles).known
    away = np.linalg.norm(middles - here, axis=1)
    assert known.any() and not known.all() and away[known].max() <= away[~known].min() + 1e-9
    updates = 1
    while stats.stale_blocks:
        left, stats = stats.stale_blocks, field.update(budget_ms=1e-3, near=here)
        assert stats.stale_blocks < left
        updates += 1
        if updates == 20:
            assert field.update(near=here).stale_blocks == 0
            break
    assert np.array_equal(field.read(blocks), whole.read(blocks), equal_nan=True)
    assert not field.query(middles).stale.any()


@pytest.mark.parametrize("seed", range(3))
def test_what_was_left_over_through_many_changes_is_right_in_the_end(seed: int) -> None:
    rng = np.random.default_rng(seed)
    tsdf, all_blocks = new_map(), block_range((-1.6, -1.6, -1.6), (1.6, 1.6, 1.6), VOXEL)
    room = box_room((-1.3, -1.4, -1.5), (1.4, 1.35, 1.2), rotation((0, 0, 1), 10 * seed))
    ball, left = rng.uniform(-1, 1, 3), 0
    field = DistanceField(tsdf, FieldSettings(max_distance=rng.choice([0.4, 1.0, 3.0])))
    for step in range(25):
        ball = np.clip(ball + rng.uniform(-0.1, 0.1, 3), -1.2, 1.2)
        near = np.linalg.norm((all_blocks + 0.5) * 8 * VOXEL - ball, axis=1) < 0.9
        if step % 8 == 5:
            tsdf.erase(all_blocks[near & (rng.random(len(near)) < 0.3)])
        else:
            write_scene(tsdf, union(room, sphere(tuple(ball), 0.3)), all_blocks[near])
        left += field.update(budget_ms=rng.choice([1e-3, 2.0, 1e3]), near=rng.uniform(-1, 1, 3)).stale_blocks
    assert left > 100 and field.update().stale_blocks == 0
    same_as_anew(field)


def test_what_waits_for_its_update_is_marked() -> None:
    tsdf, blocks = new_map(1), block_range((-2, -2, -1.2), (2, 2, 1.2), VOXEL)
    floor = plane((0, 0, -1), (0, 0, 1))
    write_scene(tsdf, floor, blocks)
    field = DistanceField(tsdf)
    field.update()
    middles = (blocks + 0.5) * 8 * VOXEL
    before = field.query(middles).distance
    write_scene(tsdf, union(floor, sphere((0, 0, 0), 0.4)), blocks)
    stats = field.update(budget_ms=1e-3, near=np.array([2.0, 2, 0]))
    values = field.query(middles)
    assert stats.stale_blocks == values.stale.sum() > 0 and values.known[values.stale].all()
    assert np.array_equal(values.distance[values.stale], before[values.stale])
    field.update()
    after = field.query(middles)
    assert not after.stale.any() and (after.distance != before)[values.stale].any()
    same_as_anew(field)
    for wrong in (0.0, -1.0, np.nan):
        with pytest.raises(InputError, match="budget_ms"):
            field.update(budget_ms=wrong)
    with pytest.raises(InputError, match="near"):
        field.update(near=np.zeros(2))


def test_queries_at_strange_places_are_answered() -> None:
    tsdf = new_map()
    write_scene(tsdf, plane((0, 0, 0), (0, 0, 1)), block_range((-0.8, -0.8, -0.8), (0.8, 0.8, 0.8), VOXEL))
    field = DistanceField(tsdf)
    points = np.zeros((7, 3))
    points[:, 2] = [0.1, np.nan, 0, -1e300, 0, 0.7999, 5]
    points[2, 1], points[4, 0] = np.inf, 1e9
    assert not field.query(points).known.any()  # nothing computed yet
    field.update()
    values = field.query(points)
    assert values.known.tolist() == [True, False, False, False, False, True, False]
    assert values.distance[5] == pytest.approx(0.7999, abs=1e-4)  # the voxels above are unknown
    assert field.query(np.empty((0, 3))).known.shape == (0,)
    assert field.is_free(points[[0, 0, 5]], 0.05).tolist() == [True, True, True]
    assert field.is_free(points[[0, 5, 6]], 0.2).tolist() == [False, True, False]
    with pytest.raises(ValueError, match="radius"):
        field.is_free(points, 2.0)
    with pytest.raises(ValueError, match=r"points \[N, 3\].*\(3,\)"):
        field.query(np.zeros(3))
    with pytest.raises(ConfigError, match="max_distance"):
        FieldSettings(max_distance=0)
    with pytest.raises(ConfigError, match="max_distance"):
        DistanceField(TsdfMap(TsdfSettings(voxel=0.001)), FieldSettings(max_distance=2.1))


def test_maps_that_are_long_are_computed_in_parts() -> None:
    """Two rows of blocks 1.6 km apart, and a row 600 m long."""
    tsdf = new_map()
    row = np.stack([np.arange(1500), 0 * np.arange(1500), 0 * np.arange(1500)], -1)
    blocks = np.concatenate([row, row[:20] + [0, 4000, 0]])
    write_scene(tsdf, plane((0, 0, 0.1), (0, 0, 1)), blocks)
    field = DistanceField(tsdf)
    assert field.update().recomputed_blocks == len(blocks)
    middles = (blocks + [0.5, 0.5, 0.75]) * 8 * VOXEL
    values = field.query(middles)
    assert values.known.all() and np.allclose(values.distance, 0.2, atol=1e-3)
