# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

import numpy as np
import pytest
from agreement import agreement
from occupancy_reference import ReferenceMap, center_of

from ggslam.errors import ConfigError
from ggslam.native.loader import NativeContext, available_instruction_sets
from ggslam.scene.camera import Camera
from ggslam.volumes.occupancy import FREE, OCCUPIED, UNKNOWN, OccupancyMap
from ggslam.volumes.occupancy_settings import OccupancySettings, log_odds
from ggslam.volumes.octomap_files import full_octomap

Scans = list[tuple[np.ndarray, np.ndarray]]


def random_scans(number: int = 3, points: int = 120, seed: int = 0) -> Scans:
    random = np.random.default_rng(seed)
    return [
        (random.normal(0, 1.2, (points, 3)).astype(np.float32), random.uniform(-0.4, 0.4, 3).astype(np.float32))
        for _ in range(number)
    ]


def panel(distance: float, half_width: float, spacing: float = 0.02) -> np.ndarray:
    """Points of a square across the x axis."""
    y, z = np.meshgrid(*[np.arange(-half_width, half_width, spacing)] * 2)
    return np.stack([np.full(y.size, distance), y.ravel(), z.ravel()], -1).astype(np.float32)


@pytest.mark.parametrize("name", available_instruction_sets())
@pytest.mark.parametrize("quantize", [True, False])
@pytest.mark.parametrize("max_range", [None, 1.1])
def test_log_odds_of_the_reference(name: str, quantize: bool, max_range: float | None) -> None:
    occupancy = OccupancyMap(0.13, OccupancySettings(quantize=quantize, last_voxel=False), NativeContext(2, name))
    reference = ReferenceMap(0.13, quantize)
    for points, origin in random_scans():
        occupancy.insert(points, origin, max_range)
        reference.insert(points, origin.astype(np.float64), max_range or np.inf)
    summary = occupancy.summary()
    assert summary.occupied + summary.free == len(reference.values)
    centers = np.array([center_of(key, 0.13) for key in reference.values])
    np.testing.assert_array_equal(occupancy.log_odds(centers), list(reference.values.values()))


@pytest.mark.parametrize("name", available_instruction_sets())
@pytest.mark.parametrize("most_hits", [2, 5, 1000])
def test_points_of_a_voxel_count_as_hits(name: str, most_hits: int) -> None:
    """As in the reference, which adds them one by one; in any number of threads."""
    maps = [OccupancyMap(0.2, OccupancySettings(most_hits=most_hits), NativeContext(n, name)) for n in (1, 2)]
    reference = ReferenceMap(0.2, True, most_hits)
    for points, origin in random_scans(points=400):
        for occupancy in maps:
            occupancy.insert(points, origin)
        reference.insert(points, origin.astype(np.float64))
    centers = np.array([center_of(key, 0.2) for key in reference.values])
    np.testing.assert_array_equal(maps[0].log_odds(centers), list(reference.values.values()))
    assert full_octomap(maps[0]) == full_octomap(maps[1])


def test_blocks_that_points_make_sure_are_one_leaf() -> None:
    """Seen from within, a cube of 8^3 voxels full of points is occupied for sure after one scan, and takes no block."""
    grid = (np.stack(np.meshgrid(*[np.arange(8)] * 3), -1).reshape(-1, 3) + 0.5) * 0.1
    points = np.repeat(grid, 4, axis=0)
    once, often = OccupancyMap(0.1), OccupancyMap(0.1, OccupancySettings(most_hits=5))
    once.insert(points, grid[100]), often.insert(np.repeat(points, 2, axis=0), grid[100])
    assert often.leaves().log_odds == pytest.approx([log_odds(0.971)]) and often.summary().blocks == 0
    assert once.leaves().log_odds == pytest.approx([log_odds(0.7)])
    with pytest.raises(ConfigError, match="quantize"):
        OccupancySettings(most_hits=2, quantize=False)


def test_rays_along_the_axes_and_in_the_sensors_own_voxel() -> None:
    occupancy = OccupancyMap(0.5)
    counts = occupancy.insert(
        np.array([[2.25, 0.25, 0.25], [0.25, -1.75, 0.25], [0.3, 0.3, 0.3]]), np.array([0.25, 0.25, 0.25])
    )
    assert (counts.rays, counts.free, counts.occupied) == (2, 6, 3)  # the sensor's voxel is hit, so it is not free
    x = np.array([0.25, 0.75, 1.25, 1.75, 2.25, 2.75])
    line = np.stack([x, np.full(6, 0.25), np.full(6, 0.25)], -1)
    np.testing.assert_array_equal(occupancy.states(line), [OCCUPIED, FREE, FREE, FREE, OCCUPIED, UNKNOWN])


@pytest.mark.parametrize("threads", [2, 3])
def test_threads_do_not_change_the_map(threads: int) -> None:
    maps = [OccupancyMap(0.05, context=NativeContext(number)) for number in (1, threads)]
    for points, origin in random_scans(points=5000):
        for occupancy in maps:
            occupancy.insert(points, origin)
    assert full_octomap(maps[0]) == full_octomap(maps[1])


@pytest.mark.parametrize("quantize", [True, False])
@pytest.mark.parametrize("max_range", [None, 1.3])
def test_exactly_the_map_of_octomap(quantize: bool, max_range: float | None) -> None:
    pyoctomap = pytest.importorskip("pyoctomap")
    tree = pyoctomap.OcTree(0.05)
    occupancy = OccupancyMap(0.05, OccupancySettings(quantize=quantize, last_voxel=False))
    for points, origin in random_scans(number=6, points=4000):
        occupancy.insert(points, origin, max_range)
        tree.insertPointCloud(
            points.astype(float), origin.astype(float), max_range=max_range or -1.0, discretize=quantize
        )
    assert full_octomap(occupancy) == tree.write()


def test_values_are_clamped() -> None:
    occupancy = OccupancyMap(0.1)
    for _ in range(30):
        occupancy.insert(np.array([[1.05, 0.05, 0.05]]), np.array([0.05, 0.05, 0.05]))
    values = occupancy.log_odds(np.array([[0.55, 0.05, 0.05], [1.05, 0.05, 0.05]]))
    np.testing.assert_array_equal(values, np.float32([log_odds(0.1192), log_odds(0.971)]))


def test_blocks_of_one_value_collapse_and_come_back() -> None:
    occupancy = OccupancyMap(0.04)
    wall, origin = panel(2.0, 1.0), np.zeros(3)
    for _ in range(7):
        occupancy.insert(wall, origin)
    leaves = occupancy.leaves()
    corners = leaves.centers - leaves.sizes[:, None] / 2
    small = len(np.unique(np.floor(corners[leaves.sizes < 0.3] / 0.32 + 1e-3), axis=0))
    assert occupancy.summary().blocks == small  # larger leaves take no block
    assert occupancy.leaves("free").sizes.max() >= 0.64 - 1e-6

    middle = np.array([[1.0, 0.02, 0.02]])
    assert occupancy.states(middle) == FREE
    for _ in range(4):
        occupancy.insert(middle, origin)
    assert occupancy.states(middle) == OCCUPIED
    assert occupancy.log_odds(middle + [0.08, 0, 0])[0] == np.float32(log_odds(0.1192))  # the rest of its block stays


@pytest.mark.parametrize("settings", [OccupancySettings(), OccupancySettings.with_raised_odds()])
def test_a_removed_obstacle_becomes_free_in_the_computed_number_of_scans(settings: OccupancySettings) -> None:
    occupancy = OccupancyMap(0.05, settings)
    obstacle, wall, origin = panel(1.02, 0.15), panel(2.02, 0.6), np.zeros(3)
    for _ in range(10):
        occupancy.insert(np.concatenate([obstacle, wall]), origin)
    scans = settings.scans_until_free()
    centre = np.array([[1.025, 0.025, 0.025]])
    for _ in range(scans - 1):
        occupancy.insert(wall, origin)
    assert occupancy.states(centre) == OCCUPIED
    occupancy.insert(wall, origin)
    assert occupancy.states(centre) == FREE
    assert (occupancy.states(obstacle) != OCCUPIED).all()


def test_raised_settings_forget_sooner() -> None:
    assert OccupancySettings().scans_until_free() == 9
    assert OccupancySettings.with_raised_odds().scans_until_free() == 5


def test_depth_images_are_back_projected() -> None:
    camera = Camera(80, 60, 70.0, 72.0, 39.0, 30.0)
    depth = np.random.default_rng(3).uniform(1, 2, (60, 80)).astype(np.float32)
    depth[:5], depth[5, 0] = 0, np.nan
    T = np.eye(4)
    T[:3, :3] = [[0, 0, 1], [-1, 0, 0], [0, -1, 0]]
    T[:3, 3] = [0.3, -0.2, 0.7]
    of_depth, of_points = OccupancyMap(0.06), OccupancyMap(0.06)
    of_depth.insert_depth(depth, camera, T, max_range=1.8)
    points = camera.back_project(depth)[depth > 0].astype(np.float64) @ T[:3, :3].T + T[:3, 3]
    of_points.insert(points, T[:3, 3], max_range=1.8)
    assert agreement(of_points, of_depth).union > 0.995  # a point on a border may round to the other side
    assert of_depth.summary().occupied > 500


def test_summary_and_leaves_tell_what_states_tells() -> None:
    occupancy = OccupancyMap(0.1)
    for points, origin in random_scans(points=2000):
        occupancy.insert(points, origin)
    summary = occupancy.summary()
    grid = (np.stack(np.meshgrid(*[np.arange(-80, 80)] * 3, indexing="ij"), -1).reshape(-1, 3) + 0.5) * 0.1
    states = occupancy.states(grid)
    assert (summary.occupied, summary.free) == ((states == OCCUPIED).sum(), (states == FREE).sum())
    for box, part in ((summary.known_box, states != UNKNOWN), (summary.occupied_box, states == OCCUPIED)):
        assert box is not None
        np.testing.assert_allclose(box, [grid[part].min(0) - 0.05, grid[part].max(0) + 0.05], atol=1e-5)
    leaves = occupancy.leaves()
    np.testing.assert_array_equal(occupancy.log_odds(leaves.centers - 0.01), leaves.log_odds)
    assert np.round((leaves.sizes / 0.1) ** 3).sum() == summary.occupied + summary.free
    centers, sizes = occupancy.occupied_centers()
    assert np.round((sizes / 0.1) ** 3).sum() == summary.occupied
    assert (occupancy.states(centers - 0.01) == OCCUPIED).all()


def test_an_empty_map() -> None:
    occupancy = OccupancyMap(0.1)
    summary = occupancy.summary()
    assert (summary.occupied, summary.free, summary.known_box, summary.occupied_box) == (0, 0, None, None)
    assert len(occupancy.leaves().sizes) == 0
    np.testing.assert_array_equal(occupancy.states(np.array([[0, 0, 0], [np.nan, 0, 0], [1e9, 0, 0]])), [UNKNOWN] * 3)
    counts = occupancy.insert(np.empty((0, 3)), np.zeros(3))
    assert (counts.rays, counts.free, counts.occupied) == (0, 0, 0)


def test_agreement_of_two_small_maps() -> None:
    one, other = OccupancyMap(1.0), OccupancyMap(1.0)
    sensor = np.array([0.5, 0.5, 0.5])
    one.insert(np.array([[4.5, 0.5, 0.5]]), sensor)  # free: 0..3, occupied: 4
    other.insert(np.array([[2.5, 0.5, 0.5]]), sensor)  # free: 0, 1, occupied: 2
    found = agreement(one, other)
    assert found.known == pytest.approx(2 / 3)
    assert found.union == pytest.approx(2 / 5)
    assert found.occupied == 0.0
    np.testing.assert_array_equal(found.counts[1:], [[1, 2, 1], [1, 0, 0]])
    with pytest.raises(ValueError, match=r"1\.0.*0\.5"):
        agreement(one, OccupancyMap(0.5))


def test_the_quantised_map_agrees_with_the_unquantised_one() -> None:
    maps = [OccupancyMap(0.05, OccupancySettings(quantize=quantize)) for quantize in (False, True)]
    for occupancy in maps:
        occupancy.insert(panel(1.5, 0.8, 0.004), np.zeros(3))
    found = agreement(*maps)
    assert found.known > 0.99
    assert found.union > 0.9
    assert found.occupied == 1.0


def test_refuses_what_it_cannot_use() -> None:
    occupancy = OccupancyMap(0.1)
    occupancy.insert(np.zeros((1, 3)), np.zeros(3))  # its origin is the world's from now on
    with pytest.raises(ConfigError, match="origin"):
        occupancy.insert(np.zeros((1, 3)), np.array([1e5, 0, 0]))
    with pytest.raises(ConfigError, match="origin"):
        occupancy.insert(np.zeros((1, 3)), np.array([np.nan, 0, 0]))
    with pytest.raises(ConfigError, match="max_range"):
        occupancy.insert(np.zeros((1, 3)), np.zeros(3), max_range=-1.0)
    with pytest.raises(ValueError, match=r"\[N, 3\]"):
        occupancy.insert(np.zeros(3), np.zeros(3))
    with pytest.raises(ValueError, match="shape"):
        occupancy.insert_depth(np.zeros((2, 2)), Camera(3, 2, 1, 1, 1, 1), np.eye(4))
    with pytest.raises(ConfigError, match="resolution"):
        OccupancyMap(-1.0)
    with pytest.raises(ConfigError, match="probability_hit"):
        OccupancySettings(probability_hit=0.4)
    with pytest.raises(ConfigError, match="probability_occupied"):
        OccupancySettings(probability_occupied=0.99)
