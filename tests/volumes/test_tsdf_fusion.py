# SPDX-License-Identifier: Apache-2.0
"""Fusion of depth images into the TSDF, against exact scenes."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest
from analytic_scenes import Box, Plane, Scene, Sphere, Union, looking_at, paint, render_depth, small_camera

from ggslam.native.loader import NativeContext, available_instruction_sets
from ggslam.volumes.settings import TsdfSettings
from ggslam.volumes.tsdf import FREE_VALUE, FULL_WEIGHT, TsdfMap

CAMERA = small_camera()
SETTINGS = TsdfSettings(voxel=0.03)
FRONT = np.eye(4)  # at the origin, looking along z


def wall(z: float) -> Plane:
    return Plane((0.0, 0.0, -1.0), -z)


def fused(scene: Scene, poses: list[np.ndarray], settings: TsdfSettings = SETTINGS) -> TsdfMap:
    tsdf = TsdfMap(settings)
    for T in poses:
        tsdf.integrate(render_depth(scene, CAMERA, T), CAMERA, T)
    return tsdf


def all_voxels(tsdf: TsdfMap) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Centres [n, 3], values in truncations [n] and weights [n] of the voxels that were seen."""
    coordinates = tsdf.blocks().coordinates
    voxels = tsdf.read(coordinates)
    seen = voxels.weight > 0
    return centres(coordinates, tsdf.settings.voxel)[seen], voxels.value[seen] / FREE_VALUE, voxels.weight[seen]


def centres(coordinates: np.ndarray, voxel: float) -> np.ndarray:
    k, j, i = np.meshgrid(*3 * [np.arange(8)], indexing="ij")
    within = np.stack([i.ravel(), j.ravel(), k.ravel()], 1) + 0.5
    return (8 * coordinates[:, None] + within) * voxel


def around(target: tuple[float, float, float], radius: float, n: int) -> list[np.ndarray]:
    angles = np.linspace(-0.6, 0.6, n)
    offsets = radius * np.stack([np.sin(angles), -0.3 + 0 * angles, -np.cos(angles)], 1)
    return [looking_at(np.array(target) + offset, np.array(target)) for offset in offsets]


def crossings(tsdf: TsdfMap) -> np.ndarray:
    """Where the interpolated distance is zero between two neighbouring voxels of one block along an axis, [n, 3]."""
    coordinates = tsdf.blocks().coordinates
    voxels = tsdf.read(coordinates)
    shape = (len(coordinates), 8, 8, 8)
    value = np.where(voxels.weight > 0, voxels.value / FREE_VALUE, np.nan).reshape(shape)
    points = centres(coordinates, tsdf.settings.voxel).reshape(*shape, 3)
    found = []
    for axis in (1, 2, 3):
        a, b = np.moveaxis(value, axis, 0)[:-1], np.moveaxis(value, axis, 0)[1:]
        p, q = np.moveaxis(points, axis, 0)[:-1], np.moveaxis(points, axis, 0)[1:]
        # A jump over more than the truncation is the back of a thin solid or the border of what was seen.
        sign = (a * b < 0) & (np.abs(a - b) < 1)
        share = (a[sign] / (a - b)[sign])[:, None]
        found.append(p[sign] + share * (q[sign] - p[sign]))
    return np.concatenate(found)


SCENES = {
    "sphere": (Sphere((0, 0, 2), 0.5), around((0.0, 0.0, 2.0), 1.5, 5)),
    "room": (Box((-1.4, -1, -1), (1.4, 1, 2.5), True), around((0.0, 0.1, 1.5), 1.4, 5)),
    "two planes": (Union((wall(2.5), Plane((0.0, -1.0, 0.0), -0.7))), around((0.0, 0.3, 2.0), 1.6, 5)),
}


@pytest.mark.parametrize("name", SCENES)
def test_the_surface_is_where_it_is(name: str) -> None:
    """Zero crossings lie within half a voxel of the surface."""
    scene, poses = SCENES[name]
    points = crossings(fused(scene, poses))
    assert len(points) > 1000
    error = np.abs(scene.distance(points))
    assert np.percentile(error, 99) < 0.5 * SETTINGS.voxel
    assert error.max() < SETTINGS.voxel


def test_free_space_is_carved_and_the_rest_untouched() -> None:
    tsdf = fused(wall(2.0), [FRONT])
    points, values, _ = all_voxels(tsdf)
    depth = points[:, 2]
    assert (values[depth < 2 - SETTINGS.truncation - 1e-3] == 1).all()
    assert depth.max() <= 2 + SETTINGS.truncation  # what is behind was not seen
    blocks = tsdf.blocks()
    near = np.abs(centres(blocks.coordinates, SETTINGS.voxel)[..., 2] - 2).min(1) < SETTINGS.truncation
    assert blocks.dense[near].all()
    unseen = (tsdf.read(blocks.coordinates).weight == 0).any(1)
    assert np.array_equal(blocks.dense[~near], unseen[~near])  # free blocks hold no voxels, unless parts are unknown
    assert (blocks.dense & ~near).any()
    u, v = np.abs(points[:, :2] / depth[:, None]).T * CAMERA.fx
    assert u.max() <= CAMERA.cx + 0.5 and v.max() <= CAMERA.cy + 0.5
    assert (~blocks.dense).sum() > 20


def test_weights_follow_distance_and_drop_off_behind() -> None:
    """1 / z^2, times 1 up to a voxel behind the surface and linearly down to 0 at the truncation."""
    points, values, weights = all_voxels(fused(wall(2.0), [FRONT]))
    s = SETTINGS
    near = np.abs(points[:, 2] - 2) < s.truncation - 1e-3
    sdf = 2.0 - points[near, 2]
    drop = np.minimum((sdf + s.truncation) / (s.truncation - s.voxel), 1)
    expected = np.round(FULL_WEIGHT / s.max_weight / points[near, 2] ** 2 * drop)
    assert np.abs(weights[near] - expected).max() <= 1
    assert np.abs(values[near] * s.truncation - sdf).max() < 1e-5


def test_weights_are_bounded_and_the_mean_is_weighted() -> None:
    s = dataclasses.replace(SETTINGS, max_weight=2.0, max_free_weight=0.5)
    tsdf = TsdfMap(s)
    counts = (3, 1)
    for z, n in zip((2.0, 2.03), counts, strict=True):
        for _ in range(n):
            tsdf.integrate(render_depth(wall(z), CAMERA, FRONT), CAMERA, FRONT)
    points, values, weights = all_voxels(tsdf)
    front = np.abs(points[:, 2] - 2 + 0.5 * s.voxel) < s.voxel / 2
    expected = (np.array(counts) @ [2.0, 2.03]) / sum(counts) - points[front, 2]
    assert np.abs(values[front] * s.truncation - expected).max() < 1e-4
    for _ in range(12):
        tsdf.integrate(render_depth(wall(2.0), CAMERA, FRONT), CAMERA, FRONT)
    points, values, weights = all_voxels(tsdf)
    assert weights.max() == FULL_WEIGHT
    assert weights[values == 1].max() == int(0.5 / 2 * FULL_WEIGHT)


def test_no_surface_between_a_near_and_a_far_plane() -> None:
    """Interpolation across an edge would put voxels of a surface where there is nothing."""
    near, far = Box((-3, -3, 1.0), (0.013, 3, 1.1)), wall(2.5)
    tsdf = fused(Union((near, far)), [FRONT])
    points, values, _ = all_voxels(tsdf)
    between = (points[:, 2] > 1 + SETTINGS.truncation + 1e-3) & (points[:, 2] < 2.5 - SETTINGS.truncation - 1e-3)
    assert between.sum() > 1000 and (values[between] == 1).all()


def frames_to_clear(value: np.ndarray, weight: np.ndarray, measured: np.ndarray, s: TsdfSettings) -> np.ndarray:
    """Frames until voxels that depth passes count as free: e <- e (1-c) w / ((1-c) w + m), w <- (1-c) w + m, until
    e = 1 - value <= 0.02; with c = `clearing`, w the weight, m = 1 / z^2 that of a measurement."""
    error, frames = 1 - value, np.zeros(len(value), int)
    while (error > 0.02).any():
        kept = (1 - s.clearing) * weight
        frames += error > 0.02
        error, weight = error * kept / (kept + measured), kept + measured
    return frames


@pytest.mark.parametrize("clearing", [0.5, 0.25])
def test_an_object_taken_away_clears_in_the_computed_number_of_frames(clearing: float) -> None:
    s = dataclasses.replace(SETTINGS, clearing=clearing)
    plate, back = Box((-0.2, -0.2, 1.5), (0.2, 0.2, 1.6)), wall(3.0)
    tsdf = fused(Union((plate, back)), 40 * [FRONT], s)
    points, values, weights = all_voxels(tsdf)
    held = (values < 0.98) & (points[:, 2] < 2) & (np.abs(points[:, :2]).max(1) < 0.15)
    measured = 1 / points[held, 2] ** 2
    n = frames_to_clear(values[held], weights[held] / FULL_WEIGHT * s.max_weight, measured, s).max()
    assert 5 < n < 40
    empty = render_depth(back, CAMERA, FRONT)

    def left() -> int:
        points, values, _ = all_voxels(tsdf)
        return int(((values < 1) & (points[:, 2] < 2) & (np.abs(points[:, :2]).max(1) < 0.15)).sum())

    dense = tsdf.dense_blocks
    freed = sum(tsdf.integrate(empty, CAMERA, FRONT).freed for _ in range(n - 2))
    assert left() > 0
    freed += sum(tsdf.integrate(empty, CAMERA, FRONT).freed for _ in range(4))
    assert left() == 0 and freed > 0 and tsdf.dense_blocks < dense


def test_what_appears_in_free_space_is_taken_over() -> None:
    tsdf = fused(wall(3.0), 60 * [FRONT])
    plate = Union((Box((-0.3, -0.3, 1.5), (0.3, 0.3, 1.6)), wall(3.0)))
    before = tsdf.revision
    for _ in range(12):
        tsdf.integrate(render_depth(plate, CAMERA, FRONT), CAMERA, FRONT)
    points, values, _ = all_voxels(tsdf)
    behind = (points[:, 2] - 1.5) / SETTINGS.voxel
    inside = (behind > 1) & (behind < 2.5) & (np.abs(points[:, :2]).max(1) < 0.2)
    assert inside.any() and (values[inside] < 0).all()
    assert (tsdf.blocks().revision > before).any()


def test_holes_do_not_carve() -> None:
    tsdf = fused(wall(2.0), [FRONT])
    blocks, before = tsdf.blocks(), all_voxels(tsdf)
    for bad in (0.0, -1.0, np.nan, -np.inf, 0.01):
        stats = tsdf.integrate(np.full((120, 160), bad, np.float32), CAMERA, FRONT)
        assert stats.blocks == 0
    half = render_depth(wall(2.0), CAMERA, FRONT)
    half[:, 80:] = 0
    empty = TsdfMap(SETTINGS)
    empty.integrate(half, CAMERA, FRONT)
    points, _, _ = all_voxels(empty)
    assert (points[:, 0] / points[:, 2] * CAMERA.fx + CAMERA.cx).max() < 80
    assert np.array_equal(tsdf.blocks().coordinates, blocks.coordinates)
    assert all(np.array_equal(a, b) for a, b in zip(before, all_voxels(tsdf), strict=True))


def test_bad_depth_does_not_touch_its_neighbours() -> None:
    depth = render_depth(wall(2.0), CAMERA, FRONT)
    holes = np.zeros(depth.shape, bool)
    holes[40:44, 60:66] = True
    bad = depth.copy()
    bad[holes] = np.resize([np.nan, -np.inf, -1.0, 0.0], holes.sum())
    clean = np.where(holes, 0, depth)
    a, b = TsdfMap(SETTINGS), TsdfMap(SETTINGS)
    a.integrate(bad, CAMERA, FRONT), b.integrate(clean, CAMERA, FRONT)
    assert all(np.array_equal(x, y) for x, y in zip(all_voxels(a), all_voxels(b), strict=True))


def test_colour_and_votes() -> None:
    scene, tsdf = wall(2.0), TsdfMap(SETTINGS)
    depth = render_depth(scene, CAMERA, FRONT)
    left = np.arange(160)[None].repeat(120, 0) < 80
    color = paint(scene, CAMERA, FRONT, lambda p: np.where(p[:, :1] < 0, [[200, 10, 30]], [[20, 100, 250]]))
    labels = np.where(left, 4, 0).astype(np.uint16)
    other = np.where(left, 9, 0).astype(np.uint16)
    for seen in (labels, other, labels, labels, other):  # 4 is ahead by one vote
        tsdf.integrate(depth, CAMERA, FRONT, color, seen)
    coordinates = tsdf.blocks().coordinates
    voxels, points = tsdf.read(coordinates), centres(coordinates, SETTINGS.voxel)
    band = (voxels.weight > 0) & (np.abs(points[..., 2] - 2) < SETTINGS.truncation - 1e-3)
    west, east = band & (points[..., 0] < -SETTINGS.voxel), band & (points[..., 0] > SETTINGS.voxel)
    assert (voxels.color[west] == [200, 10, 30]).all() and (voxels.color[east] == [20, 100, 250]).all()
    close = np.abs(points[..., 2] - 2) < 2 * SETTINGS.voxel - 1e-3
    assert (voxels.label[west & close] == 4).all() and (voxels.votes[west & close] == 1).all()
    assert (voxels.label[east] == 0).all() and (voxels.label[~close] == 0).all()
    for _ in range(2):
        tsdf.integrate(depth, CAMERA, FRONT, 255 - color, other)
    again = tsdf.read(coordinates)
    assert (again.label[west & close] == 9).all()
    expected = (5 * np.array([200, 10, 30]) + 2 * np.array([55, 245, 225])) / 7
    assert np.abs(again.color[west] - expected).max() <= 1
    for _ in range(60):
        tsdf.integrate(depth, CAMERA, FRONT, 255 - color)
    # Small shares are not rounded away: what is seen now wins in the end.
    assert np.abs(tsdf.read(coordinates).color[west].astype(int) - [55, 245, 225]).max() <= 4


def test_decay_forgets_what_is_not_frozen() -> None:
    s = dataclasses.replace(SETTINGS, decay=0.5)
    tsdf = fused(wall(2.0), 3 * [FRONT], s)
    frozen = fused(wall(2.0), 3 * [FRONT], s)
    frozen.freeze()
    before = all_voxels(tsdf)
    assert frozen.decay() == 0 and np.array_equal(all_voxels(frozen)[2], before[2])
    assert tsdf.decay(spare_in_view=True) == 0 and np.array_equal(all_voxels(tsdf)[2], before[2])
    tsdf.decay()
    points, values, weights = all_voxels(tsdf)
    assert abs(weights.max() - before[2].max() / 2) <= 1
    tsdf.decay()
    assert 0 < len(all_voxels(tsdf)[2]) < len(before[2])
    # Weights halve until they are below a thousandth of the largest.
    frames = int(np.log2(before[2].max() / (0.001 * FULL_WEIGHT))) + 2
    n = len(tsdf)
    erased = sum(tsdf.decay() for _ in range(frames))
    assert erased == n and len(tsdf) == 0 and len(frozen) == n


def test_revisions_name_the_blocks_that_changed() -> None:
    tsdf = fused(wall(2.0), 200 * [FRONT])
    before = tsdf.revision
    tsdf.integrate(render_depth(wall(2.0), CAMERA, FRONT), CAMERA, FRONT)
    assert not (tsdf.blocks().revision > before).any()  # the same again
    moved = Union((Box((-0.1, -0.1, 1.0), (0.1, 0.1, 1.2)), wall(2.0)))
    tsdf.integrate(render_depth(moved, CAMERA, FRONT), CAMERA, FRONT)
    blocks = tsdf.blocks()
    changed = centres(blocks.coordinates[blocks.revision > before], SETTINGS.voxel).mean(1)
    assert len(changed) and (np.abs(changed - [0, 0, 1.0]).max(1) < 0.4).all()


def test_threads_do_not_matter_and_instruction_sets_hardly() -> None:
    scene, poses = SCENES["sphere"]
    color = np.random.default_rng(0).integers(0, 255, (120, 160, 3), np.uint8)
    maps = {}
    for threads, isa in [(1, None), (2, None), (3, None), *((2, name) for name in available_instruction_sets())]:
        tsdf = TsdfMap(SETTINGS, NativeContext(threads, isa))
        for T in poses:
            tsdf.integrate(render_depth(scene, CAMERA, T), CAMERA, T, color, (color[..., 0] // 64).astype(np.uint16))
        maps[threads, isa] = tsdf
    first = maps[1, None]
    blocks = first.blocks()
    voxels = first.read(blocks.coordinates)
    for (_, isa), tsdf in maps.items():
        other = tsdf.read(blocks.coordinates)
        if isa is None:
            assert np.array_equal(tsdf.blocks().coordinates, blocks.coordinates)
            assert all(np.array_equal(getattr(voxels, name), getattr(other, name)) for name in vars(voxels))
        else:
            near = np.abs(voxels.value.astype(int) - other.value) <= 4
            assert (near & (np.abs(voxels.weight.astype(int) - other.weight) <= 2)).mean() > 0.999


def test_wrong_input_is_refused() -> None:
    tsdf, depth = TsdfMap(SETTINGS), np.ones((120, 160), np.float32)
    broken = FRONT.copy()
    broken[0, 3] = np.nan
    for pose, words in [
        (broken, "T_world_camera.*nan"),
        (np.eye(3), r"T_world_camera.*\[4, 4\]"),
        (np.diag([2.0, 1, 1, 1]), r"T_world_camera.* \[\[2\.0"),
    ]:
        with pytest.raises(ValueError, match=words):
            tsdf.integrate(depth, CAMERA, pose)
    far = FRONT.copy()
    far[0, 3] = 1e12
    with pytest.raises(ValueError, match=r"T_world_camera.*3e\+07.*1000000000000"):
        tsdf.integrate(depth, CAMERA, far)
    with pytest.raises(ValueError, match=r"depth.*float32 \[120, 160\].*float32 \[160, 120\]"):
        tsdf.integrate(depth.T, CAMERA, FRONT)
    with pytest.raises(ValueError, match="depth: .*uint16"):
        tsdf.integrate(depth.astype(np.uint16), CAMERA, FRONT)
    with pytest.raises(ValueError, match="color"):
        tsdf.integrate(depth, CAMERA, FRONT, color=np.zeros((120, 160), np.uint8))
    with pytest.raises(ValueError, match="labels"):
        tsdf.integrate(depth, CAMERA, FRONT, labels=np.zeros((120, 160), np.int64))
    assert len(tsdf) == 0


def test_blocks_far_from_the_origin_and_odd_image_sizes() -> None:
    for width, height in ((1, 1), (7, 5), (161, 3)):
        camera, T = small_camera(width, height), np.eye(4)
        T[:3, 3] = (-1e4, 2e4, 5e3)
        tsdf = TsdfMap(dataclasses.replace(SETTINGS, free_share=0.1))
        stats = tsdf.integrate(np.full((height, width), 2.0, np.float32), camera, T)
        points = centres(tsdf.blocks().coordinates[tsdf.blocks().dense], SETTINGS.voxel) + tsdf.origin
        assert stats.made == len(tsdf) > 0 and np.array_equal(tsdf.origin, T[:3, 3])
        assert np.abs(points[..., 2] - 5002).min() < SETTINGS.voxel


def test_a_view_of_very_many_blocks_is_the_sum_of_its_parts() -> None:
    """Voxels are updated in parts, of which a small view has only one."""
    settings, depth = TsdfSettings(voxel=0.0027), render_depth(wall(1.2), CAMERA, FRONT)
    whole, parts = TsdfMap(settings), TsdfMap(settings)
    stats = whole.integrate(depth, CAMERA, FRONT)
    assert stats.updated > 2**14
    coordinates = whole.blocks().coordinates
    edges = np.linspace(coordinates[:, 0].min(), coordinates[:, 0].max() + 1, 9).round().astype(int)
    for first, after in zip(edges[:-1], edges[1:], strict=True):
        within = np.array([first, -(10**5), -(10**5)]), np.array([after - 1, 10**5, 10**5])
        assert parts.integrate(depth, CAMERA, FRONT, within=within).updated < 2**14
    assert len(whole) == len(parts)
    found, same = whole.read(coordinates), parts.read(coordinates)
    np.testing.assert_array_equal(found.value, same.value)
    np.testing.assert_array_equal(found.weight, same.weight)
