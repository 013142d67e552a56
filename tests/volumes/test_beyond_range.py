# SPDX-License-Identifier: Apache-2.0
"""What depth beyond the range, and no return where the sensor found nothing, prove: all before it is free. Exact
scenes: a box that is taken away in front of something that is too far to be fused."""

from __future__ import annotations

import numpy as np
import pytest
from analytic_scenes import Box, Plane, Union, looking_at, render_depth, small_camera

from ggslam.errors import InputError
from ggslam.volumes.esdf import DistanceField
from ggslam.volumes.mesh import extract_mesh
from ggslam.volumes.occupancy import FREE, OCCUPIED, UNKNOWN, OccupancyMap
from ggslam.volumes.occupancy_settings import OccupancySettings
from ggslam.volumes.settings import TsdfSettings
from ggslam.volumes.tsdf import TsdfMap
from ggslam.volumes.tsdf_torch import TorchTsdf

CAMERA = small_camera()
SHAPE = (CAMERA.height, CAMERA.width)
FRONT = np.eye(4)
SETTINGS = TsdfSettings(voxel=0.05)
AHEAD = np.array([[0.01, 0.01, z] for z in (0.5, 1.2, 1.4, 1.5, 1.7, 3.0, 6.0)])
EMPTY = {"8 m": 8.0, "7.2 m": 7.2, "nothing": np.inf}


def empty(name: str) -> np.ndarray:
    """Views of no surface in range."""
    return np.full(SHAPE, EMPTY[name], np.float32)


def box_at(z: float, background: np.ndarray) -> np.ndarray:
    depth = background.copy()
    depth[40:80, 60:100] = z
    return depth


@pytest.mark.parametrize("name", EMPTY)
@pytest.mark.parametrize("z", [1.5, 5.0, 6.95, 6.999])
def test_a_box_taken_away_goes_from_tsdf_and_field(name: str, z: float) -> None:
    tsdf = TsdfMap(SETTINGS)
    field = DistanceField(tsdf)
    for _ in range(10):
        tsdf.integrate(box_at(z, empty(name)), CAMERA, FRONT)
    field.update()
    before = field.query(np.array([[0.01, 0.01, z - 0.3]]))
    assert before.distance[0] == pytest.approx(0.3, abs=0.02) and len(extract_mesh(tsdf).triangles) > 100
    for _ in range(30):
        tsdf.integrate(empty(name), CAMERA, FRONT)
    field.update()
    after = field.query(np.array([[0.01, 0.01, z - 0.3]]))
    assert len(extract_mesh(tsdf, min_weight=0).triangles) == 0 and len(field.surface()[0]) == 0
    assert after.known.all() and after.distance[0] > 1.99


def test_free_space_ends_at_the_range_and_no_block_is_made_there() -> None:
    tsdf = TsdfMap(SETTINGS)
    tsdf.integrate(empty("nothing"), CAMERA, FRONT)
    field = DistanceField(tsdf)
    field.update()
    far = np.array([[0.01, 0.01, z] for z in np.arange(0.5, 9, 0.1)])
    known = field.query(far).known
    assert known[far[:, 2] < 7 - 0.4].all() and not known[far[:, 2] > 7].any()  # a block is 0.4 m
    assert (tsdf.blocks().coordinates[:, 2].max() + 1) * 0.4 <= 7 + 1e-6


@pytest.mark.parametrize("missing", [0.0, np.nan, -np.inf])
def test_pixels_without_measurement_free_nothing(missing: float) -> None:
    tsdf, occupancy = TsdfMap(SETTINGS), OccupancyMap(0.05)
    for _ in range(5):
        tsdf.integrate(box_at(1.5, empty("8 m")), CAMERA, FRONT)
        occupancy.insert_depth(box_at(1.5, empty("8 m")), CAMERA, FRONT)
    before = tsdf.read(tsdf.blocks().coordinates)
    for _ in range(20):
        tsdf.integrate(np.full(SHAPE, missing, np.float32), CAMERA, FRONT)
        occupancy.insert_depth(np.full(SHAPE, missing, np.float32), CAMERA, FRONT, free_depth=7.0)
    after = tsdf.read(tsdf.blocks().coordinates)
    assert all(np.array_equal(getattr(before, name), getattr(after, name)) for name in vars(before))
    assert occupancy.states(np.array([[0.01, 0.01, 1.51]]))[0] == OCCUPIED


def test_a_missing_pixel_beside_no_return_keeps_what_is_behind_it() -> None:
    tsdf = TsdfMap(SETTINGS)
    for _ in range(5):
        tsdf.integrate(box_at(1.5, empty("nothing")), CAMERA, FRONT)
    half = empty("nothing")
    half[:, 80:] = np.nan
    for _ in range(20):
        tsdf.integrate(half, CAMERA, FRONT)
    points = extract_mesh(tsdf).vertices
    columns = points[:, 0] / points[:, 2] * CAMERA.fx + CAMERA.cx
    assert len(points) and columns.min() > 78  # a voxel is 3 pixels wide


@pytest.mark.parametrize("name", EMPTY)
def test_surfaces_in_range_are_the_same_beside_depth_beyond(name: str) -> None:
    """Depth beyond the range adds free space and changes nothing where depth is in range."""
    scene = Union((Box((-0.4, -0.3, 1.5), (0.3, 0.3, 1.9)), Plane((0.0, 0.0, -1.0), -30.0)))
    tsdf, bare = TsdfMap(SETTINGS), TsdfMap(SETTINGS)
    for x in (-0.3, 0.0, 0.4):
        T = looking_at(np.array([x, -0.1, 0.0]), np.array([0.0, 0.0, 1.6]))
        depth = render_depth(scene, CAMERA, T)
        tsdf.integrate(np.where(depth > 7, np.float32(EMPTY[name]), depth), CAMERA, T)
        bare.integrate(np.where(depth > 7, np.float32(0), depth), CAMERA, T)
    one, two = extract_mesh(tsdf, 0), extract_mesh(bare, 0)
    assert len(two.triangles) > 200
    gap = np.linalg.norm(one.vertices[:, None] - two.vertices[None], axis=2)
    assert gap.min(0).max() < 0.15 * SETTINGS.voxel


def test_torch_does_the_same() -> None:
    settings = TsdfSettings(voxel=0.06, max_depth=4.0)
    tsdf, other = TsdfMap(settings), TorchTsdf(settings)
    rng = np.random.default_rng(0)
    room = Union((Box((-1.5, -1, -1), (1.5, 1, 4.6), True), Box((-0.3, -0.3, 3.6), (0.3, 0.3, 3.9))))
    gone = Box((-1.5, -1, -1), (1.5, 1, 4.6), True)
    camera = small_camera(90, 70)
    for k in range(8):
        T = looking_at(np.array([-0.6 + 0.15 * k, -0.3, 0.0]), np.array([0, 0, 2.0]))
        depth = render_depth(room if k < 4 else gone, camera, T)
        depth[rng.random(depth.shape) < 0.02] = np.nan
        depth[rng.random(depth.shape) < 0.02] = np.inf
        tsdf.integrate(depth, camera, T)
        other.integrate(depth, camera, T)
    same = other.to_native()
    blocks, found = tsdf.blocks(), same.blocks()
    for kind in (True, False):
        a, b = ({tuple(c) for c in x.coordinates[x.dense == kind]} for x in (blocks, found))
        assert len(a) > 30 and len(a ^ b) <= 0.01 * len(a)
    one, two = tsdf.read(blocks.coordinates), same.read(blocks.coordinates)
    seen = one.weight > 0
    assert ((two.weight > 0) == seen).mean() > 0.999
    assert (np.abs(one.value.astype(int) - two.value)[seen] <= 4).mean() > 0.998


def test_depth_in_millimetres_is_still_refused() -> None:
    tsdf = TsdfMap(SETTINGS)
    with pytest.raises(InputError, match="1500.*1000"):
        tsdf.integrate(np.full(SHAPE, 1500, np.float32), CAMERA, FRONT)
    assert len(tsdf) == 0


def test_voxels_too_small_to_free_the_range_fuse_what_is_in_range() -> None:
    settings = TsdfSettings(voxel=0.002, max_depth=100.0)
    depth = np.full(SHAPE, np.inf, np.float32)
    depth[55:65, 75:85] = 0.3
    tsdf = TsdfMap(settings)
    tsdf.integrate(depth, CAMERA, FRONT)
    points = extract_mesh(tsdf, 0).vertices
    assert len(points) > 100 and np.abs(points[:, 2] - 0.3).max() < 1e-3


# --- occupancy -------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("name", EMPTY)
def test_a_box_taken_away_goes_from_occupancy(name: str) -> None:
    occupancy = OccupancyMap(0.05, OccupancySettings.with_raised_odds())
    for _ in range(10):
        occupancy.insert_depth(box_at(1.5, empty(name)), CAMERA, FRONT, free_depth=7.0)
    assert occupancy.states(np.array([[0.01, 0.01, 1.51]]))[0] == OCCUPIED
    for _ in range(occupancy.settings.scans_until_free()):
        occupancy.insert_depth(empty(name), CAMERA, FRONT, free_depth=7.0)
    assert (occupancy.states(AHEAD) == FREE).all()
    if name == "nothing":
        assert len(occupancy.leaves("occupied").sizes) == 0
        assert occupancy.states(np.array([[0.01, 0.01, 7.1]]))[0] == UNKNOWN


def test_no_return_is_left_out_unless_a_range_is_known() -> None:
    occupancy = OccupancyMap(0.05)
    assert occupancy.insert_depth(empty("nothing"), CAMERA, FRONT).rays == 0
    assert occupancy.insert_depth(empty("nothing"), CAMERA, FRONT, max_range=2.0).rays > 0
    assert occupancy.states(np.array([[0.01, 0.01, 1.9], [0.01, 0.01, 2.2]])).tolist() == [FREE, UNKNOWN]


@pytest.mark.parametrize("quantize", [True, False])
def test_the_last_voxel_of_the_range_is_freed(quantize: bool) -> None:
    settings = OccupancySettings(quantize=quantize)
    occupancy = OccupancyMap(0.05, settings)
    far = np.array([[0.0, 0.0, 3.99]])
    for _ in range(5):
        occupancy.insert_depth(np.full(SHAPE, 3.99, np.float32), CAMERA, FRONT, max_range=4.2)
    assert occupancy.states(far)[0] == OCCUPIED
    for _ in range(settings.scans_until_free() + 1):
        occupancy.insert_depth(empty("8 m"), CAMERA, FRONT, max_range=4.0)
    assert occupancy.states(far)[0] == FREE
